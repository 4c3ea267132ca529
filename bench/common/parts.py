"""What benches of several parts share: `SHARED [PART]` on the command line; all parts where none is named."""

import argparse
from collections.abc import Callable
from pathlib import Path


def run_parts(about: str | None, parts: dict[str, Callable[[Path], None]], *, within: str = "") -> None:
    """Run the part that was asked for, or all in their order, each with the shared folder, or the one within it."""
    reader = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("shared", type=Path)
    reader.add_argument("part", nargs="?", choices=[*parts])
    asked = reader.parse_args()
    for name, part in parts.items():
        if asked.part in (None, name):
            print(f"\n{name}", flush=True)
            part(asked.shared / within)
