"""The program `marey`: its commands, and the messages and exit codes of errors."""

import errno
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

import marey
from marey.cli import knee
from marey.cli.calibrate import calibrate
from marey.cli.cameras import cameras, init, sync
from marey.cli.capture import capture, demo, shape
from marey.cli.markers import markers
from marey.cli.motions import compare, retarget
from marey.cli.nonrigid import nonrigid
from marey.cli.surface import surface
from marey.cli.view import bench, view
from marey.errors import MareyError
from marey.pipelines.verdict import NotUsable

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells use it."""
WRONG_INPUT = 2
"""Exit code for input that cannot be used, as shells use it."""
NO_ANSWER = 3
"""Exit code of a run without a usable answer, whose cause is named."""
_USERS_ERRNO = (
    *(errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EROFS, errno.ENOTDIR, errno.EDQUOT, errno.EFBIG),
    errno.ENAMETOOLONG,
)
"""Errors of the system that the user can correct: missing rights, a full disk, a name that is too long."""

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
    *(retarget, markers, nonrigid, compare, view, bench),
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
        The exit code: 0, 2 for wrong input, 3 without a usable answer, 130 after Ctrl-C, and what a command states in
        its help. Errors of the program itself are raised.
    """
    try:
        given = knee.with_seeds_joined(sys.argv[1:] if arguments is None else arguments)
        code = app(args=given, prog_name="marey", standalone_mode=False)
    except NotUsable as problem:
        print(str(problem), file=sys.stderr)
        return NO_ANSWER
    except MareyError as problem:
        return _report_error(str(problem))
    except typer.TyperException as problem:
        return _report_error(_usage_line(problem))
    except OSError as problem:
        if problem.errno not in _USERS_ERRNO:
            raise
        text = f"{problem.filename or 'a file'}: {problem.strerror}. Check the permissions and the free space."
        return _report_error(text)
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        print("\nInterrupted. Run the same command again to resume.", file=sys.stderr)
    return code if isinstance(code, int) else 0


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
