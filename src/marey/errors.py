"""Errors and warnings that users can act on."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar


class MareyError(Exception):
    """An error that a user can understand and correct; all errors of marey's inputs and settings are of this kind.

    Example:
        >>> import marey
        >>> try:
        ...     marey.load_motion("nowhere")
        ... except marey.MareyError as error:
        ...     print(error)
        nowhere: does not exist. Give the folder with the results of `marey capture` or `marey shape`.
    """

    resumes: ClassVar[bool] = False
    """Whether what the run has computed is kept, so that the same command continues it."""


class FileProblem(MareyError):
    """A file that cannot be used: its path, what is wrong in it, and what would be right.

    Args:
        path: The file or folder.
        wrong: What is wrong, as the predicate of a sentence ("has no camera 'cam03'").
        remedy: What the user can do, as a sentence.

    Example:
        >>> import marey
        >>> problem = marey.FileProblem("cameras.toml", "has no camera 'cam03'", "Calibrate it.")
        >>> str(problem), problem.path.name
        ("cameras.toml: has no camera 'cam03'. Calibrate it.", 'cameras.toml')
    """

    def __init__(self, path: Path | str, wrong: str, remedy: str = ""):
        # Texts of files and libraries may have several lines, or characters that no terminal shows.
        wrong = " ".join("".join(c if c.isprintable() else " " for c in wrong).split())
        self.path = Path(path)
        self.wrong = wrong
        self.remedy = remedy
        super().__init__(f"{path}: {wrong}." + (f" {remedy}" if remedy else ""))


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Name a file in errors of methods, which do not know where their data come from.

    Args:
        path: The file.

    Yields:
        Nothing.

    Raises:
        FileProblem: A `MareyError` without a file, and of no other kind, occurred.
    """
    try:
        yield
    except MareyError as error:
        if type(error) is not MareyError:
            raise
        raise FileProblem(path, str(error).rstrip(".")) from error


class NotWritten(FileProblem):
    """A result that could not be written: a full disk, missing rights, or a file of the user that is in its place.

    What a run has computed is kept, so that the same command resumes once the cause is removed.

    Args:
        path: The file or folder that could not be written.
        wrong: The cause, for example "No space left on device".
        remedy: What the user can do, as a sentence.
    """

    resumes = True

    def __init__(self, path: Path | str, wrong: str, remedy: str = ""):
        remedy = remedy or "Free some space, correct the permissions, or choose another folder (--out)."
        super().__init__(path, f"cannot be written ({wrong})", f"{remedy} The same command then resumes.")


class DamagedCheckpoint(FileProblem):
    """A checkpoint of a run that was damaged after it was written.

    Args:
        path: The file of the checkpoint.
        frame: The frame that cannot be read.
    """

    resumes = True

    def __init__(self, path: Path | str, frame: int):
        super().__init__(path, f"is damaged at frame {frame}", "The same command continues at that frame.")


class WorkerKilled(MareyError):
    """A worker process that the operating system has ended, most often for lack of memory."""

    resumes = True

    def __init__(self) -> None:
        super().__init__(
            "A worker process was killed, probably for lack of memory. Use fewer workers (--workers). "
            "The same command then resumes."
        )


class SettingProblem(MareyError):
    """A setting or option whose value cannot be used.

    Example:
        >>> import marey
        >>> marey.open_trial(marey.example_folder(), frames=range(9, 3))
        Traceback (most recent call last):
        marey.errors.SettingProblem: The frames are range(9, 3); they should be consecutive, for example range(40, 100).
    """


class MissingPackage(MareyError):
    """An optional package that is not installed."""


class MareyWarning(UserWarning):
    """A part of the data or the results that the user should check; see the `warnings` of each result.

    Example:
        >>> import warnings
        >>> import marey
        >>> warnings.simplefilter("ignore", marey.MareyWarning)
    """
