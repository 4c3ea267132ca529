"""The program `marey`: its commands, and the messages and exit codes of errors."""

import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Annotated

import typer

import marey
from marey.cli import knee
from marey.cli.calibrate import calibrate
from marey.cli.cameras import cameras, init, sync
from marey.cli.capture import capture, demo, shape
from marey.cli.markers import markers
from marey.cli.motions import compare, device, retarget
from marey.cli.nonrigid import nonrigid
from marey.cli.surface import surface
from marey.cli.view import bench, view
from marey.cli.work import NOT_USABLE
from marey.errors import MareyError, SettingProblem
from marey.pipelines.verdict import NotUsable

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells use it."""
TERMINATED = 143
"""Exit code after the signal SIGTERM, as shells use it."""
WRONG_INPUT = 2
"""Exit code for input that cannot be used, as shells use it."""
_USERS_ERRNO = (
    *(errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EROFS, errno.ENOTDIR, errno.EDQUOT, errno.EFBIG),
    *(errno.ENAMETOOLONG, errno.EIO),
)
"""Errors of the system that the user can correct: missing rights, a full or damaged disk, a name that is too long."""
_SHOWN = 200
"""Largest length of a path in an error message [characters]; longer ones are shortened. Chosen by hand."""

app = typer.Typer(
    name="marey",
    help="Measure how a body moves and what shape it has, from what is visible at its surface.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_COMMANDS = (
    *(init, calibrate, cameras, sync, capture, surface, shape, demo),
    *(retarget, markers, nonrigid, compare, device, view, bench),
)
"""The commands in the order of the help."""
for command in _COMMANDS:
    app.command()(command)
app.add_typer(knee.app, name="knee")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"marey {marey.__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", metavar="", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Measure how a body moves and what shape it has, from what is visible at its surface."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and write errors that the user can correct in one line.

    Args:
        arguments: The arguments after the program's name; by default those of the process.

    Returns:
        The exit code: 0, 2 for wrong input, 3 for the verdict "not usable", 130 after Ctrl-C, 143 after SIGTERM.
        Errors of the program itself are raised.
    """
    given = sys.argv[1:] if arguments is None else arguments
    ended = threading.Event()
    try:
        _require_readable(given)
        with _terminable(ended):
            code = app(args=knee.with_seeds_joined(given), prog_name="marey", standalone_mode=False)
    except NotUsable as problem:
        print(str(problem), file=sys.stderr)
        return NOT_USABLE
    except MareyError as problem:
        return _report_error(str(problem))
    except typer.TyperException as problem:
        return _report_error(_usage_line(problem))
    except OSError as problem:
        if problem.errno not in _USERS_ERRNO:
            raise
        return _report_error(_system_line(problem))
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        code = TERMINATED if ended.is_set() else INTERRUPTED
        how = "Terminated" if ended.is_set() else "Interrupted"
        print(f"\n{how}. Run the same command again to resume.", file=sys.stderr)
    return code if isinstance(code, int) else 0


class _Terminated(KeyboardInterrupt):
    """The signal SIGTERM, which ends the work as Ctrl-C does."""


@contextmanager
def _terminable(ended: threading.Event) -> Iterator[None]:
    """End the work on SIGTERM as on Ctrl-C, so that checkpoints and locks are left in order.

    Args:
        ended: Is set by the signal.

    Yields:
        Nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def terminate(number: int, frame: FrameType | None) -> None:
        ended.set()
        raise _Terminated

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _require_readable(arguments: Sequence[str]) -> None:
    """Check that the arguments, and the current folder, are names that reports can contain.

    Raises:
        SettingProblem: One of them is not valid UTF-8.
    """
    for text in arguments:
        if not _is_unicode(text):
            raise SettingProblem(f"The argument {text!a} is not valid UTF-8. Rename this file or folder.")
    if any(not text.startswith("-") for text in arguments) and not _is_unicode(os.getcwd()):
        raise SettingProblem(f"The current folder {os.getcwd()!a} is not valid UTF-8. Rename it.")


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _system_line(problem: OSError) -> str:
    """Describe an error of the system that the user can correct."""
    name = str(problem.filename or "a file")
    shown = name if len(name) <= _SHOWN else f"{name[: _SHOWN // 2]}...{name[-_SHOWN // 2 :]}"
    remedy = "Check the permissions and the free space."
    if problem.errno == errno.ENAMETOOLONG:
        remedy = f"The path has {len(name)} characters: use a shorter one."
    return f"{shown}: {problem.strerror}. {remedy}"


def _usage_line(problem: Exception) -> str:
    text = problem.format_message() if hasattr(problem, "format_message") else str(problem)
    context = getattr(problem, "ctx", None)
    return f"{text.rstrip('.')}. See {context.command_path if context else 'marey'} --help."


def _report_error(text: str) -> int:
    print("marey: " + " ".join(text.split()), file=sys.stderr)
    return WRONG_INPUT


def main() -> None:
    """Run the program as the entry point of the command line."""
    sys.exit(run())
