"""A kernel is compiled once for arrays that differ only in whether they can be written to."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import NamedTuple

import numpy as np
import pytest
from numba.core import types
from numba.core.errors import TypingError

from marey.compiled.kernel_dispatch import KernelDispatcher, writable_type
from marey.compiled.kernels import kernel
from marey.lanes import add_row, put_combination, take_larger

REFUSED = (TypingError, AttributeError)
"""What Numba raises for a kernel that writes to a read-only array; the second, an error of its own, for `+=`."""


class Weighted(NamedTuple):
    values: np.ndarray
    factor: float


@kernel
def product(values, factor):
    return values[0] * factor


@kernel
def total(values, weighted):
    return product(values, 2) + product(values, 3) + product(weighted.values, weighted.factor)


@kernel
def first_row(values):
    return values[0]


@kernel
def fill(values, number):
    for i in range(values.size):
        values[i] = number


@kernel
def fill_rows(rows):
    for row in rows:
        fill(number=1.0, values=row.reshape(-1)[1:])


@kernel
def add_to(values):
    values += 1.0


@kernel
def add_to_part(weighted):
    part = weighted.values
    add_to(part[1:])


@kernel
def sort(values):
    values.sort()


@kernel
def add_by_intrinsic(values, row):
    add_row(values, 0, 1.0, row)


@kernel
def combine_by_intrinsic(out, factors, rows):
    put_combination(out, 0, factors, rows, 0, 1)


@kernel
def empty_by_intrinsic(order, other):
    take_larger(order, other, 0, np.float32(0.0))


@kernel
def root(values):
    result = np.sqrt(values).sum() + np.dot(values, values)
    copy = np.zeros(len(values))
    copy[0] = result
    return result


def read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def test_read_only_arrays_share_the_machine_code_of_others():
    for values in (np.ones(3), read_only(np.ones(3))):
        for part in (np.ones(2), read_only(np.ones(2))):
            assert total(values, Weighted(part, 4.0)) == 9.0
    assert len(total.signatures) == 1


def test_a_literal_is_compiled_as_a_variable():
    values = types.Array(types.float64, 1, "C")
    for number in (types.literal(2), types.literal(3), types.int64):
        _, _, kinds, _ = product.get_call_template((values, number), {})
        assert kinds == (values, types.int64)
    assert product.signatures.count((values, types.int64)) == 1
    assert not any(isinstance(kind, types.Literal) for _, kind in product.signatures)


def test_an_array_that_is_not_written_to_is_found():
    assert root(read_only(np.ones(3))) == 6.0
    assert root.written == {(types.Array(types.float64, 1, "C"),): frozenset()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("written", "arguments"),
    [
        (fill, (read_only(np.zeros(3)), 1.0)),
        (fill_rows, (read_only(np.zeros((2, 3))),)),
        (add_to, (read_only(np.zeros(3)),)),
        (add_to_part, (Weighted(read_only(np.zeros(3)), 1.0),)),
        (sort, (read_only(np.zeros(3)),)),
    ],
)
def test_a_read_only_array_stays_protected(written, arguments):
    for _ in range(2):
        with pytest.raises(REFUSED):
            written(*arguments)


def test_a_call_of_known_types_does_not_return_to_the_dispatcher(monkeypatch):
    calls = [(total, (read_only(np.ones(3)), Weighted(np.ones(2), 4.0))), (first_row, (read_only(np.ones((2, 3))),))]
    before = [called(*arguments) for called, arguments in calls]
    compile_kernel, compiled = KernelDispatcher.compile, []

    def noted(self, sig):
        compiled.append(self)
        return compile_kernel(self, sig)

    monkeypatch.setattr(KernelDispatcher, "compile", noted)
    again = [called(*arguments) for called, arguments in calls]
    assert compiled == []
    for one, other in zip(before, again, strict=True):
        np.testing.assert_array_equal(one, other)
    first_row(read_only(np.ones((2, 3), np.float32)))
    assert compiled == [first_row]


def test_threads_that_call_at_the_same_time_insert_one_entry(monkeypatch):
    def summed(values, others):
        return values[0] + others[0]

    summed, arguments = kernel(summed), (read_only(np.ones(3)), np.ones(3))
    summed(np.ones(3), np.ones(3))
    together, compiled = Barrier(4), KernelDispatcher.compile

    def wait_and_compile(self, sig):
        together.wait()
        return compiled(self, sig)

    with monkeypatch.context() as patch, ThreadPoolExecutor(4) as pool:
        patch.setattr(KernelDispatcher, "compile", wait_and_compile)
        assert list(pool.map(lambda _: summed(*arguments), range(4))) == [2.0] * 4
    monkeypatch.setattr(KernelDispatcher, "compile", lambda *_: pytest.fail("the types are known"))
    assert summed(*arguments) == 2.0


def test_an_intrinsic_writes_to_what_it_states():
    add_by_intrinsic(np.zeros(8), (1.0,) * 8)
    assert add_by_intrinsic.written[add_by_intrinsic.signatures[0]] == {0}
    rows = np.arange(16, dtype=np.float32)
    rows.flags.writeable = False
    combined = np.zeros(8, np.float32)
    combine_by_intrinsic(combined, (np.float32(1.0), np.float32(2.0), np.float32(0.0), np.float32(0.0)), rows)
    np.testing.assert_array_equal(combined, 3 * np.arange(8) + 2)
    assert list(combine_by_intrinsic.written.values()) == [{0}], "a read-only array needs no specialisation of its own"


def test_an_intrinsic_that_states_nothing_writes_to_all():
    empty_by_intrinsic(np.zeros(8, np.float32), np.ones(8, np.float32))
    assert list(empty_by_intrinsic.written.values()) == [{0, 1}]


def test_numbers_computed_from_an_array_are_no_part_of_it():
    @kernel
    def ends(values):
        return values[0], values[-1]

    @kernel
    def span(values):
        low, high = ends(values)
        gaps = np.zeros(1)
        gaps[0] = high - low
        return gaps

    assert span(read_only(np.array([1.0, 2.0, 4.0]))) == [3.0]
    assert span.written[span.signatures[0]] == frozenset()


def test_a_copy_of_an_array_is_no_part_of_it():
    @kernel
    def sorted_and_selected(values, numbers):
        copy, part = values.copy(), values[numbers]
        copy[0], part[0] = part[0], copy[0]
        return copy, part

    values, numbers = read_only(np.array([1.0, 2.0, 4.0])), np.array([2, 0])
    copy, part = sorted_and_selected(values, numbers)
    np.testing.assert_array_equal(copy, [4.0, 2.0, 4.0])
    np.testing.assert_array_equal(part, [1.0, 1.0])
    assert sorted_and_selected.written[sorted_and_selected.signatures[0]] == frozenset()


def test_what_a_kernel_returns_of_its_argument_stays_protected_in_its_caller():
    @kernel
    def tail(values):
        return values[1:]

    @kernel
    def clear_tail(values):
        part = tail(values)
        part[0] = 0.0

    clear_tail(np.ones(3))
    with pytest.raises(REFUSED):
        clear_tail(read_only(np.ones(3)))


def test_a_returned_part_of_a_read_only_array_is_read_only():
    assert first_row(np.ones((2, 3))).flags.writeable
    assert not first_row(read_only(np.ones((2, 3)))).flags.writeable


def test_arrays_that_may_be_written_to_are_known_of_loaded_machine_code():
    def doubled(values):
        values *= 2.0

    kernel(doubled)(np.ones(3))
    again = kernel(doubled)
    again(np.ones(3))
    assert sum(again.stats.cache_hits.values()) == 1
    with pytest.raises(REFUSED):
        again(read_only(np.ones(3)))


def test_the_layout_of_an_array_is_kept():
    transposed = types.Array(types.float64, 2, "F", readonly=True)
    assert writable_type(transposed) == types.Array(types.float64, 2, "F")
    assert writable_type(types.int64) is types.int64
    pair = types.Tuple((transposed, types.int64))
    assert writable_type(pair) == types.Tuple((types.Array(types.float64, 2, "F"), types.int64))
