"""Lists of kernels are read as they were written, and name kernels that exist."""

from collections.abc import Callable
from importlib.resources import files

import numba
import numpy as np
import pytest
from numba.core.types import BaseTuple, UniTuple

from marey.body.articulation.surface import FaceShares
from marey.compiled.kernel_dispatch import KernelDispatcher
from marey.compiled.kernel_lists import ListedKernel, list_text, listed_kernels, type_text

LISTS = sorted(path.name.removesuffix(".toml") for path in (files("marey.compiled") / "lists").iterdir())


TYPES = {
    "bool": True,
    "int64": 1,
    "float64": 1.0,
    "float32[::1]": np.zeros(3, np.float32),
    "uint8[:, :, ::1]": np.zeros((2, 2, 2), np.uint8),
    "float64[::1, :]": np.zeros((3, 2)).T,
    "int16[:, :]": np.zeros((4, 4), np.int16)[::2, ::2],
    "bool[::1]": np.zeros(3, bool),
    "(int64, int64, int64)": (1, 2, 3),
    "(int64, float64[::1])": (1, np.zeros(2)),
    "(float64,)": (1.0,),
    f"{FaceShares.__module__}.FaceShares(int64[::1], int64[:, ::1], float64[:, :, ::1])": FaceShares(
        np.zeros(2, int), np.zeros((2, 2), int), np.zeros((1, 1, 1))
    ),
}
"""Values by the type in the notation of the lists."""


@pytest.mark.parametrize("text", TYPES)
def test_a_type_is_read_as_it_was_written(text: str):
    kind = numba.typeof(TYPES[text])
    assert type_text(kind) == text
    entry = ListedKernel.parsed(f"marey.some.kernel({text}, int64)")
    assert entry.arguments == (kind, numba.types.int64)
    assert str(entry) == f"marey.some.kernel({text}, int64)"


def test_tuples_of_one_type_are_those_that_numba_makes():
    (kind,) = ListedKernel.parsed("a.b((int64, int64))").arguments
    assert isinstance(kind, UniTuple)
    assert isinstance(kind, BaseTuple)


@pytest.mark.parametrize("text", ["a.b", "a.b(word)", "a.b(1)", "a.b(float64[0 + 1].c)"])
def test_what_is_not_an_entry_is_an_error(text: str):
    with pytest.raises(ValueError, match="is not"):
        ListedKernel.parsed(text)


def test_a_type_that_a_list_cannot_contain_is_an_error():
    with pytest.raises(ValueError, match="unicode_type"):
        type_text(numba.types.unicode_type)


@pytest.mark.parametrize("name", LISTS)
def test_every_listed_kernel_exists_and_takes_so_many_arguments(name: str):
    kernels = listed_kernels(name)
    assert len(kernels) > 10
    assert len({str(kernel) for kernel in kernels}) == len(kernels)
    for kernel in kernels:
        assert isinstance(kernel.dispatcher, KernelDispatcher)
        assert kernel.dispatcher.py_func.__code__.co_argcount == len(kernel.arguments)


def test_a_written_list_is_read_again(monkeypatch: pytest.MonkeyPatch, tmp_path):
    kernels = listed_kernels("capture")
    (tmp_path / "lists").mkdir()
    (tmp_path / "lists" / "own.toml").write_text(list_text(reversed(kernels)))
    in_folder: Callable[[str], object] = lambda package: tmp_path  # noqa: E731
    monkeypatch.setattr("marey.compiled.kernel_lists.files", in_folder)
    assert listed_kernels("own") == kernels[::-1]
