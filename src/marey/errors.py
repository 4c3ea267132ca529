"""What went wrong, where, and what would be right."""

from pathlib import Path


class MareyError(Exception):
    """An error that a user can understand and mend."""


class FileProblem(MareyError):
    """A file that cannot be used: which one, what is wrong in it, and what would be right.

    Args:
        path: The file or folder.
        wrong: What is wrong, as the middle of a sentence ("has no camera 'cam03'").
        remedy: What the user can do, as a sentence.
    """

    def __init__(self, path: Path | str, wrong: str, remedy: str = ""):
        self.path = Path(path)
        self.wrong = wrong
        self.remedy = remedy
        super().__init__(f"{path}: {wrong}." + (f" {remedy}" if remedy else ""))


class SettingProblem(MareyError):
    """A setting or option whose value cannot be used."""


class MissingPackage(MareyError):
    """An optional package that is not installed."""


class MareyWarning(UserWarning):
    """Something in the data or the results that the user should check; see the `warnings` of each result."""
