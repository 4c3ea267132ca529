"""Benchmarks of several parts: `[PART]` on the command line; all parts without one."""

import argparse
from collections.abc import Callable, Mapping

from bench.recording import Run

Part = Callable[[Run], None]


def add_parts(parser: argparse.ArgumentParser, parts: Mapping[str, Part]) -> None:
    """Add the argument that chooses one part."""
    parser.add_argument("part", nargs="?", choices=[*parts], help="all without one")


def run_parts(run: Run, parts: Mapping[str, Part]) -> None:
    """Run the chosen part, or all in their order."""
    for name, part in parts.items():
        if run.arguments.part in (None, name):
            part(run)
