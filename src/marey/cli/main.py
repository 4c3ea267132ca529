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
from marey.cli.capture import capture, demo, shape, surface
from marey.cli.markers import markers
from marey.cli.motions import compare, device, export, gait, retarget
from marey.cli.nonrigid import nonrigid
from marey.cli.study import study
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
    *(retarget, markers, nonrigid, study, gait, compare, device, export, view, bench),
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
    received: list[int] = []
    try:
        with _stopping(received):
            code = _run(given)
    except BaseException as problem:
        # A library that is interrupted while it is imported raises an error of its own.
        if not received and not isinstance(problem, KeyboardInterrupt):
            return _reported(problem, given)
        code = INTERRUPTED
    if code == INTERRUPTED:
        code = TERMINATED if signal.SIGTERM in received else INTERRUPTED
        how = "Terminated" if code == TERMINATED else "Interrupted"
        print(f"\n{how}. Run the same command again to resume.", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _run(given: Sequence[str]) -> object:
    _require_readable(given)
    return app(args=knee.with_seeds_joined(given), prog_name="marey", standalone_mode=False)


def _reported(problem: BaseException, given: Sequence[str]) -> int:
    """Write an error that the user can correct in one line, and return the exit code; raise any other error."""
    if isinstance(problem, NotUsable):
        print(str(problem), file=sys.stderr)
        return NOT_USABLE
    if isinstance(problem, MareyError):
        return _report_error(str(problem))
    if isinstance(problem, typer.TyperException):
        return _report_error(_usage_line(problem, given))
    if isinstance(problem, OSError) and problem.errno in _USERS_ERRNO:
        return _report_error(_system_line(problem))
    raise problem


class _Stopped(KeyboardInterrupt):
    """The signal SIGTERM or SIGINT.

    Python ends a process by SIGINT, although it is caught, if KeyboardInterrupt itself is raised within `exec`, by
    which dataclasses are made during imports; a class of its own has no such effect.
    """


@contextmanager
def _stopping(received: list[int]) -> Iterator[None]:
    """End the work on SIGTERM and on Ctrl-C in one way, so that checkpoints and locks are left in order.

    Args:
        received: Receives the number of each signal.

    Yields:
        Nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise _Stopped

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    # None stands for a handler that Python did not install, and cannot install again; what is ignored stays ignored.
    replaced = {number: handler for number, handler in before.items() if handler not in (None, signal.SIG_IGN)}
    try:
        for number in replaced:
            signal.signal(number, stop)
        yield
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)


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


def _usage_line(problem: Exception, given: Sequence[str]) -> str:
    """Describe a fault of the arguments, and name the command whose help states what would be right."""
    text = problem.format_message() if hasattr(problem, "format_message") else str(problem)
    context = getattr(problem, "ctx", None)
    command = context.command_path if context else _command_path(given)
    return f"{text.rstrip('.') or 'Missing command'}. See {command} --help."


def _command_path(given: Sequence[str]) -> str:
    """Return the program's name and those of the command, and of its part, in the arguments."""
    names = {command.__name__ for command in _COMMANDS} | {"knee"}
    path = ["marey", *[word for word in given if word in names][:1]]
    if path[-1] == "knee":
        parts = {part.callback.__name__ for part in knee.app.registered_commands if part.callback}
        path += [word for word in given if word in parts][:1]
    return " ".join(path)


def _report_error(text: str) -> int:
    print("marey: " + " ".join(text.split()), file=sys.stderr)
    return WRONG_INPUT


def main() -> None:
    """Run the program as the entry point of the command line."""
    sys.exit(run())
