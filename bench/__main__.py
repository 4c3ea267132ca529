"""The runner of the benchmarks: `python -m bench list`, `run` and `report`."""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType

from bench.declaration import GROUPS, Bench, find_benches
from bench.pages import write_pages
from bench.provenance import PROJECT, age, current_commit, is_dirty, machine
from bench.recording import Record, Run, read_records, record_path, write_record


def main(words: Sequence[str] | None = None) -> int:
    """Parse the command line and run one of the three commands; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    listing = commands.add_parser("list", help="List the benchmarks, what they measure, and the age of their records.")
    listing.add_argument("group", nargs="?", choices=GROUPS)
    running = commands.add_parser(
        "run", help="Run a benchmark, print its figures and write its record.", add_help=False
    )
    running.add_argument("name", help="a name of `python -m bench list`")
    commands.add_parser("report", help="Write the pages under docs/accuracy from the records.")
    given, rest = parser.parse_known_args(words)
    if given.command == "run":
        return run_bench(given.name, rest)
    if rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if given.command == "list":
        list_benches(given.group)
    else:
        for path in write_pages():
            print(path.relative_to(PROJECT))
    return 0


def list_benches(group: str | None) -> None:
    """Print one line per benchmark, and one per record."""
    records = read_records()
    for name, bench in find_benches().items():
        if group in (None, bench.group):
            print(f"{name:32} {bench.minutes:5g} min  {bench.measures}")
            for path, record in records.get(name, []):
                print(f"{'':42}  {path.stem}: {state(bench, record)}")


def state(bench: Bench, record: Record) -> str:
    """Describe a record's age in a few words."""
    if record.source:
        return record.source
    how = age(record.commit, [*bench.sources, bench.file], most=1)
    if not how.known:
        return f"{record.date}, commit {record.commit[:7]} is not in the history"
    return f"{record.date}, commit {record.commit[:7]}, {'old' if how.old else 'current'}"


def run_bench(name: str, words: Sequence[str]) -> int:
    """Run one benchmark with its own arguments, and write its record; the exit code."""
    bench = find_benches().get(name)
    if bench is None:
        print(f"There is no benchmark {name!r}: see `python -m bench list`.", file=sys.stderr)
        return 2
    module = bench.module()
    parser = parser_of(bench, module)
    given = parser.parse_args(words)
    if bench.data and not (given.shared / "data").is_dir():
        parser.error(f"{given.shared} has no folder `data`. Give the folder of recordings with --shared.")
    record = measure(bench, module, given, own_words(words))
    if not given.no_record:
        path = record_path(name, own_words(words))
        write_record(record, path)
        print(f"\n{path.relative_to(PROJECT)}, {record.seconds:.0f} s")
    return 0


def parser_of(bench: Bench, module: ModuleType) -> argparse.ArgumentParser:
    """The arguments of a benchmark: the runner's and its own."""
    parser = argparse.ArgumentParser(
        prog=f"python -m bench run {bench.name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        parents=[runner_parser()],
    )
    if hasattr(module, "arguments"):
        module.arguments(parser)
    return parser


def runner_parser() -> argparse.ArgumentParser:
    """The arguments of every run."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--shared", type=Path, default=PROJECT.parent / "shared", help="the folder of recordings")
    parser.add_argument("--out", type=Path, help="a folder that keeps the results; otherwise they are deleted")
    parser.add_argument("--note", default="", help="circumstances to record, such as other work on the machine")
    parser.add_argument("--no-record", action="store_true", help="only print the figures")
    return parser


def own_words(words: Sequence[str]) -> list[str]:
    """The arguments of the benchmark itself, without places on this machine: they name the record."""
    return [
        Path(word).name if Path(word).is_absolute() else word for word in runner_parser().parse_known_args(words)[1]
    ]


def measure(bench: Bench, module: ModuleType, given: argparse.Namespace, words: Sequence[str]) -> Record:
    """Run a benchmark on one thread; its figures, with what is needed to judge and to repeat them."""
    from threadpoolctl import threadpool_limits  # Imported here so that `list` and `report` need only Python.

    commit, dirty = current_commit(), is_dirty(["src", "bench", ":!bench/records"])
    with tempfile.TemporaryDirectory() as scratch:
        out = (given.out or Path(scratch)).resolve() / (commit[:7] + ("-dirty" if dirty else ""))
        out.mkdir(parents=True, exist_ok=True)
        run = Run(given, given.shared.resolve(), out)
        began = time.perf_counter()
        with threadpool_limits(1):
            module.run(run)
        seconds = time.perf_counter() - began
    return Record(
        bench=bench.name,
        command=" ".join(["python -m bench run", bench.name, *words]),
        commit=commit,
        dirty=is_dirty([*bench.sources, bench.file]),
        date=datetime.now(UTC).date().isoformat(),
        machine=machine(),
        seconds=round(seconds, 1),
        note=given.note,
        tables=tuple(run.tables),
    )


if __name__ == "__main__":
    sys.exit(main())
