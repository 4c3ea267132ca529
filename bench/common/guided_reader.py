"""One reader under atheris, in a process of its own: `python -m bench.common.guided_reader GROUP NAME DIR S SEED`.

What the reader did is counted in `counts.json` in the folder, and failing files are kept in `failing/` there.
"""

import contextlib
import json
import resource
import shutil
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import atheris
import numpy as np

_SOURCE = Path(__file__).parents[2] / "src"
_OTHERS = [
    ".".join(path.relative_to(_SOURCE).with_suffix("").parts)
    for path in (_SOURCE / "marey").rglob("*.py")
    if path.relative_to(_SOURCE).parts[1] != "io"
]
"""Modules that are not instrumented: compiled kernels, which some of them have, cannot be."""

with atheris.instrument_imports(include=["marey"], exclude=_OTHERS):
    from tests import file_samples, film_samples
    from tests.damaged_files import damaged

    from marey.errors import MareyError

_MEMORY = 6 * 2**30
"""Memory that a reader may use [bytes]."""
_SECONDS = 20
"""Longest time of one file [s]."""
_BY_STRUCTURE = 0.5
"""Share of the changes that respect the structure of a file, such as another value in a JSON tree."""
_BETWEEN = 0.5
"""Time between two writings of the counts [s]."""


class _Search:
    """A reader that receives one file after another."""

    def __init__(self, group: str, name: str, folder: Path):
        samples, groups = folder / "samples", file_samples.GROUPS | film_samples.GROUPS
        shutil.rmtree(samples, ignore_errors=True)
        samples.mkdir()
        self.sample, self.folder, self.name = groups[group](samples)[name], folder, name
        self.found, self.begun, self.written = Counter[str](), time.monotonic(), 0.0

    def __call__(self, content: bytes) -> None:
        """Read a file, and count what happens."""
        path = self.sample.path
        path.write_bytes(content)
        try:
            self.sample.read(path)
            self.found["read"] += 1
        except MareyError as problem:
            named = str(self.folder) in str(problem) and "\n" not in str(problem)
            self.found["reported"] += named
            if not named:
                self._keep(content, "a report without the file, or of several lines")
        except (Exception, SystemExit) as error:
            self._keep(content, type(error).__name__)
        now = time.monotonic()
        if now - self.written > _BETWEEN:
            self.write(now)

    def changed(self, content: bytes, largest: int, seed: int) -> bytes:
        """Damage a file in one place, by its structure if it has any left, or as libFuzzer does."""
        rng = np.random.default_rng(seed)
        if rng.random() < _BY_STRUCTURE:
            with contextlib.suppress(Exception):
                return damaged(self.sample.path, content, rng)[:largest]
        return bytes(atheris.Mutate(content, largest))

    def _keep(self, content: bytes, what: str) -> None:
        self.found[what] += 1
        if self.found[what] == 1:
            kept = self.folder / "failing"
            kept.mkdir(exist_ok=True)
            (kept / f"{self.name}-{what}".replace(" ", "_")).write_bytes(content)

    def write(self, now: float) -> None:
        """Write the counts."""
        beside = self.folder / "counts.new"
        beside.write_text(json.dumps({"found": dict(self.found), "seconds": now - self.begun}))
        beside.replace(self.folder / "counts.json")
        self.written = now


def main() -> None:
    """Search for the time that is given."""
    group, name, folder, seconds, seed = sys.argv[1:]
    search = _Search(group, name, Path(folder))
    whole = search.sample.path.read_bytes()
    corpus = Path(folder) / f"corpus-{name}".replace(" ", "_").replace("/", "_")
    corpus.mkdir(exist_ok=True)
    (corpus / "valid").write_bytes(whole)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    limits = [f"-max_total_time={seconds}", f"-timeout={_SECONDS}", f"-max_len={2 * len(whole) + 64}"]
    limits.append("-rss_limit_mb=0")
    places = [f"-artifact_prefix={folder}/ended-", f"-seed={seed}"]
    atheris.Setup([sys.argv[0], *limits, *places, str(corpus)], search, custom_mutator=search.changed)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
