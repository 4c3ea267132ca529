"""Kernels that only other kernels call have no machine code, and get it where Python calls them."""

import gc
import json
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from marey.compiled.kernel_cache import kernel_folder
from marey.compiled.kernel_dispatch import KernelDispatcher, without_collection
from marey.compiled.kernel_library import KernelLibrary, has_entry_point
from marey.compiled.kernels import kernel

HALVES = """
import json, sys
import numpy as np
from marey.compiled.kernels import kernel

@kernel
def halved(values):
    if values.size == 0:
        raise ValueError("nothing to halve")
    return values / 2

@kernel
def sum_of_halves(values):
    return halved(values).sum()

def called(name):
    function = {"halved": halved, "sum_of_halves": sum_of_halves}[name]
    return np.sum(function(np.arange(4.0)))

print(json.dumps([[called(name) for name in sys.argv[1].split()], sum(halved.stats.cache_misses.values())]))
"""
"""A kernel that returns an array, which needs constants of its own at its entry point, and one that calls it."""


@kernel
def thirds(values):
    if values.size == 0:
        raise ValueError("nothing to divide")
    return values / 3


@kernel
def sum_of_thirds(values):
    return thirds(values).sum()


@kernel
def product_of_thirds(values):
    return thirds(values).prod()


@numba.njit
def quarter(value):
    return value / 4


@kernel
def sum_of_quarters(values):
    total = 0.0
    for value in values:
        total += quarter(value)
    return total


@kernel
def fifth_of_first(values):
    return values[0] / 5


@kernel
def fifth_of_broadcast(values):
    return fifth_of_first(np.broadcast_to(values[:1], (3,)))


@numba.njit
def six_sums(values):
    return 6 * sum_of_thirds(values)


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory):
    """Begin without compiled kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_CACHE_DIR", str(tmp_path_factory.mktemp("kernels")))
        kernel_folder.cache_clear()
        yield
    kernel_folder.cache_clear()


def only_compiled(function):
    (found,) = function.overloads.values()
    return found


@pytest.mark.slow
def test_a_kernel_gets_machine_code_where_python_calls_it():
    values = np.arange(1.0, 4.0)
    assert sum_of_thirds(values) == 2.0
    assert has_entry_point(only_compiled(sum_of_thirds))
    assert not has_entry_point(only_compiled(thirds))
    np.testing.assert_array_equal(thirds(values), values / 3)
    assert has_entry_point(only_compiled(thirds))
    assert product_of_thirds(values) == np.prod(values / 3)
    for function in (thirds, sum_of_thirds, product_of_thirds):
        with pytest.raises(ValueError, match="nothing to divide"):
            function(np.empty(0))
    assert six_sums(values) == 12.0


@pytest.mark.slow
def test_functions_that_the_user_compiles_keep_their_entry_points():
    assert sum_of_quarters(np.arange(4.0)) == 1.5
    assert quarter(3.0) == 0.75

    @numba.njit
    def eighth(value):
        return np.full(1, value / 8)

    assert eighth(4.0) == 0.5
    assert not isinstance(only_compiled(eighth).library, KernelLibrary)


@pytest.mark.slow
def test_a_kernel_that_kernels_call_with_read_only_arrays_has_an_entry_point_for_them(monkeypatch):
    assert fifth_of_broadcast(np.ones(3)) == 0.2
    called_by_kernel = only_compiled(fifth_of_first).signature.args[0]
    assert not called_by_kernel.mutable
    frozen = np.broadcast_to(np.ones(1), (3,))
    assert numba.typeof(frozen) == called_by_kernel
    assert fifth_of_first(frozen) == 0.2
    with monkeypatch.context() as patch:
        patch.setattr(KernelDispatcher, "compile", lambda *_: pytest.fail("no entry point was found"))
        assert fifth_of_first(frozen) == 0.2


@pytest.mark.slow
def test_an_interrupted_translation_is_repeated(monkeypatch):
    @kernel
    def sixth(values):
        return values / 6

    with monkeypatch.context() as patch:
        patch.setattr(KernelLibrary, "finalize", interrupted)
        with pytest.raises(KeyboardInterrupt):
            sixth(np.ones(1))
    assert sixth(np.ones(1)) == 1 / 6


def interrupted(library):
    raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "compiled"),
    [
        ("sum_of_halves", "sum_of_halves halved", 0),
        ("sum_of_halves", "halved sum_of_halves", 0),
        ("sum_of_halves halved", "sum_of_halves halved", 0),
        ("halved", "sum_of_halves halved", 0),
    ],
)
def test_another_process_finds_a_kernel_in_every_state(tmp_path, first, second, compiled):
    code = tmp_path / "halves.py"
    code.write_text(HALVES, encoding="utf-8")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    for names, expected in ((first, 1), (second, compiled), (second, 0)):
        shown = subprocess.run(
            [sys.executable, str(code), names], env=environment, capture_output=True, text=True, check=False
        )
        assert shown.returncode == 0, shown.stderr
        assert json.loads(shown.stdout) == [[3.0] * len(names.split()), expected]


def test_unused_objects_are_collected_again_after_compilation():
    assert gc.isenabled()
    with without_collection():
        with without_collection():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()
