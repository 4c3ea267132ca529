"""The program `marey`, as `python -m marey` and as the command of an installation."""

import signal


def start() -> None:
    """Run the program; Ctrl-C while it is being loaded, or after its work, ends the process at once.

    Python's own handler would print a traceback of the modules that were being imported.
    """
    # A shell script that starts the program in the background lets it ignore Ctrl-C: this is left as it is.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from marey.cli.main import main

    main()


if __name__ == "__main__":
    start()
