"""Compiled kernels are kept on disk as long as they and all that they use have the same content."""

import json
import os
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaWarning

from marey.compiled.kernel_cache import KEPT_UNUSED_DAYS, KernelCache, kernel_folder
from marey.compiled.kernel_digest import UnknownContentError, kernel_digest
from marey.compiled.kernels import kernel
from marey.lanes import add_row

LENGTHS = '''
"""Lengths."""

import numpy as np
from marey.compiled.kernels import kernel

FACTOR = 2.0
TABLE = np.array([1.0, 0.5])

@kernel
def scaled(x):
    """Scale a length."""
    return FACTOR * x  # in metres

@kernel
def shifted(x):
    return x + TABLE[1]
'''

AREAS = '''
from typing import NamedTuple
from marey.compiled.kernels import kernel
from shapes import lengths
from shapes.lengths import scaled

class Size(NamedTuple):
    wide: float
    high: float

@kernel(inline="always")
def product(size):
    return scaled(size.wide) * lengths.shifted(size.high)

@kernel(error_model="numpy")
def area(size):
    """Compute an area."""
    return product(size) / size.high
'''

RUN = """
import json
from shapes import areas
result = areas.area(areas.Size(wide=3.0, high=4.0))
stats = areas.area.stats
print(json.dumps([result, sum(stats.cache_misses.values()), sum(stats.cache_hits.values())]))
"""

SERVER = """
import json, os, sys, traceback
import numba
numba.njit(lambda x: x + 1.0)(1.0)
for line in sys.stdin:
    request = json.loads(line)
    child = os.fork()
    if child == 0:
        os.environ.update(request["environment"])
        sys.path.insert(0, request["folder"])
        try:
            with open(request["output"], "w") as sys.stdout:
                exec(request["code"], {"__name__": "__main__"})
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    os.waitpid(child, 0)
    print(flush=True)
"""
"""A process that has imported Numba, which takes most of a second; it forks a process for each code that it runs."""


def environment_of(*folders: Path) -> dict[str, str]:
    """Variables of another process; Python itself must not take a changed file of the same second for the old one."""
    found = {**os.environ, "PYTHONPATH": os.pathsep.join([*map(str, folders), *sys.path])}
    found.pop("NUMBA_CACHE_DIR", None)
    # A fork beside other threads would be a warning, which is an error here.
    return found | {"PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}


class Processes:
    """Runs code in new processes that have imported Numba."""

    def __init__(self, folder: Path):
        self.output, self.errors = folder / "output.json", folder / "errors.txt"
        with self.errors.open("w") as stderr:
            self.server = subprocess.Popen(
                [sys.executable, "-W", "error", "-c", SERVER], env=environment_of(), text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr,
            )  # fmt: skip

    def run(self, code: str, folder: Path, **variables: str) -> str:
        """Return what the code prints, with modules in a folder."""
        self.output.unlink(missing_ok=True)
        request = {"code": code, "folder": str(folder), "output": str(self.output), "environment": variables}
        self.server.stdin.write(json.dumps(request) + "\n")
        self.server.stdin.flush()
        self.server.stdout.readline()
        printed = self.output.read_text() if self.output.exists() else ""
        assert printed, self.errors.read_text()
        return printed

    def close(self) -> None:
        self.server.communicate()


@pytest.fixture(scope="module")
def processes(tmp_path_factory) -> Iterator[Processes]:
    if not hasattr(os, "fork"):
        pytest.skip("this system has no fork")
    started = Processes(tmp_path_factory.mktemp("processes"))
    yield started
    started.close()


class Checkout:
    """A small package in a folder of its own, run with a cache shared by all checkouts of a test."""

    def __init__(self, folder: Path, cache: Path, processes: Processes | None = None):
        self.folder, self.cache, self.processes = folder, cache, processes
        (folder / "shapes").mkdir(parents=True)
        (folder / "shapes" / "__init__.py").touch()
        self.write("lengths", LENGTHS)
        self.write("areas", AREAS)

    def write(self, module: str, text: str) -> None:
        (self.folder / "shapes" / f"{module}.py").write_text(text, encoding="utf-8")

    def replace(self, module: str, old: str, new: str) -> None:
        text = LENGTHS if module == "lengths" else AREAS
        assert old in text
        self.write(module, text.replace(old, new))

    def run(self, code: str = RUN, **variables: str) -> tuple[float, int, int]:
        """Give the area, and how many signatures of its kernel were compiled and how many loaded."""
        variables |= {"MAREY_CACHE_DIR": str(self.cache)}
        if self.processes is not None:
            return tuple(json.loads(self.processes.run(code, self.folder, **variables)))
        environment = environment_of(self.folder) | variables
        shown = subprocess.run(
            [sys.executable, "-W", "error", "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert shown.returncode == 0, shown.stderr
        return tuple(json.loads(shown.stdout))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory, processes) -> tuple[Path, float]:
    """The cache that a first process leaves, and the area that it computed."""
    folder = tmp_path_factory.mktemp("first")
    area, misses, hits = Checkout(folder / "code", folder / "cache", processes).run()
    assert (area, misses, hits) == (6.0 * 4.5 / 4.0, 1, 0)
    return folder / "cache", area


@pytest.fixture
def checkout(tmp_path, compiled, processes) -> Checkout:
    """Another checkout of the same package, which shares the cache."""
    return Checkout(tmp_path / "elsewhere", compiled[0], processes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("areas", "area", "area"),
        ("areas", "Compute an area.", "Multiply both sides."),
        ("areas", '    """Compute an area."""\n', ""),
        ("areas", "@kernel(error_model", "# A comment.\n\n\n@kernel(error_model"),
        ("lengths", "# in metres", "# in the unit of x"),
        ("lengths", "FACTOR = 2.0", "OTHER = 3.0\nFACTOR = 1.0 + 1.0"),
    ],
    ids=["elsewhere", "docstring", "no docstring", "lines", "comment of a callee", "equal constant"],
)
def test_a_change_without_effect_keeps_the_machine_code(checkout, compiled, module, old, new):
    checkout.replace(module, old, new)
    assert checkout.run() == (compiled[1], 0, 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "old", "new", "area"),
    [
        ("lengths", "FACTOR * x", "3.0 * x", 9.0 * 4.5 / 4.0),
        ("lengths", "x + TABLE", "x - TABLE", 6.0 * 3.5 / 4.0),
        ("lengths", "FACTOR = 2.0", "FACTOR = 4.0", 12.0 * 4.5 / 4.0),
        ("lengths", "0.5]", "1.5]", 6.0 * 5.5 / 4.0),
        ("areas", "wide: float\n    high: float", "high: float\n    wide: float", 6.0 * 4.5 / 4.0),
        ("areas", '(error_model="numpy")', '(error_model="python")', 6.0 * 4.5 / 4.0),
        ("areas", "@kernel(inline", "@kernel(fastmath=True, inline", 6.0 * 4.5 / 4.0),
    ],
    ids=["callee", "callee of a module", "constant", "table", "fields", "options", "options of a callee"],
)
def test_a_change_of_anything_that_is_used_causes_a_compilation(checkout, compiled, module, old, new, area):
    checkout.replace(module, old, new)
    assert checkout.run() == (area, 1, 0)
    assert checkout.run() == (area, 0, 1)
    checkout.write(module, LENGTHS if module == "lengths" else AREAS)
    assert checkout.run() == (compiled[1], 0, 1)


@pytest.mark.slow
def test_a_damaged_entry_is_compiled_again(tmp_path, processes):
    checkout = Checkout(tmp_path / "code", tmp_path / "cache", processes)
    area, *_ = checkout.run()
    for entry in (tmp_path / "cache" / "kernels").glob("*.nbc"):
        entry.write_bytes(entry.read_bytes()[:100])
    assert checkout.run() == (area, 1, 0)
    assert checkout.run() == (area, 0, 1)


@pytest.mark.slow
def test_numba_without_the_classes_of_the_cache_uses_its_own(tmp_path):
    checkout = Checkout(tmp_path / "code", tmp_path / "cache")
    without = "import numba.core.caching; del numba.core.caching.CompileResultCacheImpl\n"
    named = "\nassert type(areas.area._cache) is numba.core.caching.FunctionCache"
    variables = {"NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    assert checkout.run(without + RUN + named, **variables)[1:] == (1, 0)
    assert checkout.run(without + RUN + named, **variables)[1:] == (0, 1)


@pytest.mark.slow
def test_numba_without_the_classes_of_the_cache_compiles_where_it_finds_no_folder(tmp_path):
    checkout = Checkout(tmp_path / "code", tmp_path / "cache")
    without = (
        "import numba.core.caching as c; c.CompileResultCacheImpl._locator_classes = [];del c.CompileResultCacheImpl\n"
    )
    assert checkout.run(without + RUN)[1:] == (1, 0)


@kernel
def weighted(values, weights):
    total = 0.0
    for i in range(values.size):
        total += values[i] * weights[i]
    return total


def test_a_kernel_is_numbas_function_with_the_lock_released(rng, own_folder):
    values, weights = rng.normal(size=50), rng.normal(size=50)
    assert weighted(values, weights) == numba.njit(weighted.py_func)(values, weights)
    assert weighted.targetoptions["nogil"]
    assert isinstance(weighted._cache, KernelCache)


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("MAREY_CACHE_DIR", str(tmp_path / "own"))
    kernel_folder.cache_clear()
    yield tmp_path / "own" / "kernels"
    kernel_folder.cache_clear()


def test_each_signature_has_an_entry_and_flush_deletes_them_all(own_folder):
    @kernel
    def doubled(x):
        return x + x

    assert list(own_folder.parent.glob("*")) == []
    assert (doubled(2), doubled(2.5)) == (4, 5.0)
    assert len(list(own_folder.glob("*.nbc"))) == 2
    assert doubled.stats.cache_path == str(own_folder)
    doubled.recompile()
    assert len(list(own_folder.glob("*.nbc"))) == 2
    doubled._cache.flush()
    assert list(own_folder.glob("*.nbc")) == []


def test_entries_that_were_not_used_for_long_are_deleted(own_folder):
    @kernel
    def halved(x):
        return x / 2

    own_folder.mkdir(parents=True)
    old, recent, foreign = (own_folder / name for name in ("old.nbc", "recent.nbc", "notes.txt"))
    for path, days in ((old, KEPT_UNUSED_DAYS + 1), (recent, KEPT_UNUSED_DAYS - 1), (foreign, 2 * KEPT_UNUSED_DAYS)):
        path.touch()
        os.utime(path, (time.time() - 86400 * days,) * 2)
    halved(3.0)
    assert not old.exists()
    assert recent.exists()
    assert foreign.exists()


def test_a_use_is_noted(own_folder):
    def tripled(x):
        return 3 * x

    kernel(tripled)(1.0)
    (entry,) = own_folder.glob("*.nbc")
    os.utime(entry, (0, 0))
    again = kernel(tripled)
    again(1.0)
    assert sum(again.stats.cache_hits.values()) == 1
    assert time.time() - entry.stat().st_mtime < 3600


def test_a_kernel_of_unknown_content_is_compiled_and_not_kept(own_folder):
    class Other:
        pass

    other = Other()

    @kernel
    def chosen(x):
        return x if other is None else -x

    with pytest.raises(UnknownContentError, match="Other"):
        kernel_digest(chosen.py_func, {})
    with pytest.warns(NumbaWarning, match="Cannot cache a kernel"), pytest.raises(numba.core.errors.TypingError):
        chosen(1.0)
    assert list(own_folder.glob("*.nbc")) == []


def test_a_folder_that_cannot_be_written_to_later_is_a_warning(own_folder, monkeypatch):
    def negated(x):
        return -x

    def fail(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.warns(NumbaWarning, match="No space left"):
        assert kernel(negated)(1.0) == -1.0
    assert [path.name for path in own_folder.iterdir()] == ["locks"]


def test_an_intrinsic_is_part_of_the_digest():
    def first(sums, row):
        add_row(sums, 0, 1.0, row)

    before = kernel_digest(first, {})
    kept = add_row._defn
    try:
        add_row._defn = lambda typing, sums, at, factor, row: None
        assert kernel_digest(first, {}) != before
    finally:
        add_row._defn = kept
    assert kernel_digest(first, {}) == before


def test_a_kernel_that_calls_itself_has_a_digest():
    assert len(kernel_digest(factorial.py_func, {})) == 64


@kernel
def factorial(n):
    return 1 if n < 2 else n * factorial(n - 1)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (lambda x: x + 1, lambda x: x + 1.0),
        (lambda x: x + 0.0, lambda x: x + -0.0),
        (lambda x: x.real, lambda x: x.imag),
        (lambda x: np.sin(x), lambda x: np.cos(x)),
        (lambda x, y=1: x + y, lambda x, y=2: x + y),
        (lambda x: [x + 1 for _ in (1,)], lambda x: [x + 2 for _ in (1,)]),
        (lambda x: x in {1, 2}, lambda x: x in {1, 3}),
    ],
)
def test_different_code_has_different_digests(first, second):
    second.__name__ = first.__name__
    second.__qualname__ = first.__qualname__
    assert kernel_digest(first, {}) != kernel_digest(second, {})


@pytest.fixture
def user(tmp_path, monkeypatch):
    """A user's home on Linux and folder of temporary files."""
    if sys.platform == "win32":
        pytest.skip("the permissions of these folders are POSIX's")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("NUMBA_CACHE_DIR", "MAREY_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    kernel_folder.cache_clear()
    yield tmp_path
    kernel_folder.cache_clear()


def private(folder: Path) -> bool:
    return stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_kernels_are_kept_in_the_users_cache(user, monkeypatch):
    assert kernel_folder() == user / "home" / ".cache" / "marey" / "kernels"
    assert private(kernel_folder())
    kernel_folder.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(user / "xdg"))
    assert kernel_folder() == user / "xdg" / "marey" / "kernels"
    kernel_folder.cache_clear()
    monkeypatch.setattr(sys, "platform", "darwin")
    assert kernel_folder() == user / "home" / "Library" / "Caches" / "marey" / "kernels"
    kernel_folder.cache_clear()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(user / "local"))
    assert kernel_folder() == user / "local" / "marey" / "Cache" / "kernels"


def test_the_folder_of_kernels_can_be_given(user, monkeypatch):
    monkeypatch.setenv("MAREY_CACHE_DIR", str(user / "given"))
    assert kernel_folder() == user / "given" / "kernels"
    kernel_folder.cache_clear()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(user / "numba"))
    assert kernel_folder() == user / "numba" / "marey"
    assert not (user / "home").exists()


def test_a_given_folder_that_cannot_be_written_to_is_named_in_a_warning(user, monkeypatch):
    (user / "file").touch()
    monkeypatch.setenv("MAREY_CACHE_DIR", str(user / "file"))
    with pytest.warns(UserWarning, match="MAREY_CACHE_DIR"):
        assert kernel_folder() == user / "home" / ".cache" / "marey" / "kernels"


def test_without_a_home_that_can_be_written_to_a_private_temporary_folder_is_shared_by_processes(user, monkeypatch):
    (user / "home").touch()
    folder = kernel_folder()
    assert folder.parent == user / "temporary"
    assert private(folder)
    kernel_folder.cache_clear()
    assert kernel_folder() == folder


def test_a_folder_that_others_can_write_to_is_not_used(user):
    kernel_folder().chmod(0o777)
    kernel_folder.cache_clear()
    shared = kernel_folder()
    assert shared.parent == user / "temporary"
    shared.rmdir()
    (user / "of-another").mkdir()
    shared.symlink_to(user / "of-another")
    kernel_folder.cache_clear()
    assert kernel_folder().parent == user / "temporary"
    assert kernel_folder() != shared
    assert private(kernel_folder())


@pytest.mark.slow
def test_a_kernel_runs_where_no_home_can_be_written_to(tmp_path):
    checkout = Checkout(tmp_path / "code", tmp_path / "cache")
    (tmp_path / "home").touch()
    (tmp_path / "temporary").mkdir()
    places = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": "", "MAREY_CACHE_DIR": ""}
    places["TMPDIR"] = str(tmp_path / "temporary")
    assert checkout.run(**places)[1:] == (1, 0)
    assert checkout.run(**places)[1:] == (0, 1)
