"""Work in threads gives the same results as sequential work."""

import threading
import time

import numpy as np
import pytest

from marey.fit.solver import threads
from marey.fit.solver.threads import map_in_threads, map_in_two_threads
from marey.process import limited_cores, usable_cores


def test_results_come_in_the_order_of_the_items_whatever_takes_longest(rng):
    pauses = rng.uniform(0, 0.01, 30)

    def work(i):
        time.sleep(pauses[i])
        return i * i

    assert list(map_in_threads(work, range(30))) == [i * i for i in range(30)]
    assert list(map_in_threads(work, [])) == []


def test_items_are_made_in_the_callers_thread_and_only_a_few_ahead():
    made = []

    def items():
        for i in range(100):
            made.append(threading.current_thread())
            yield i

    for n, _ in enumerate(map_in_threads(lambda i: i, items()), 1):
        assert len(made) <= n + 2 * usable_cores() + 1
    assert set(made) == {threading.current_thread()}
    assert len(made) == 100


def test_an_error_in_the_work_reaches_the_caller():
    def work(i):
        if i == 7:
            raise ValueError("seven")
        return i

    found = map_in_threads(work, range(50))
    with pytest.raises(ValueError, match="seven"):
        list(found)


def test_closing_the_iterator_cancels_the_work():
    progress = []
    found = map_in_threads(lambda i: progress.append(i), iter(range(1000)))
    next(found)
    found.close()
    assert len(progress) <= 3 * usable_cores() + 1


def test_work_inside_work_stays_in_its_thread():
    def work(i):
        return {threading.current_thread(), *map_in_threads(lambda _: threading.current_thread(), range(4))}

    assert all(len(threads) == 1 for threads in map_in_threads(work, range(6)))


def test_kernels_on_several_threads_give_the_same_numbers(rng):
    matrices = rng.normal(size=(40, 30, 30))
    again = list(map_in_threads(lambda m: m @ m.T, matrices))
    np.testing.assert_array_equal(again, [m @ m.T for m in matrices])


def test_two_threads_return_results_in_order_and_raise_errors():
    assert map_in_two_threads(lambda i: i * i, range(7)) == [i * i for i in range(7)]
    with pytest.raises(ZeroDivisionError):
        map_in_two_threads(lambda i: 1 / i, [1, 0])


def test_short_work_inside_a_worker_thread_stays_in_it():
    def outer(item):
        return set(map_in_two_threads(lambda _: threading.get_ident(), range(3))) == {threading.get_ident()}

    assert all(map_in_threads(outer, range(5)))


def test_one_thread_processes_all_items_in_the_caller_and_ends_with_its_block():
    here = threading.get_ident()
    with limited_cores(4):
        with threads.one_thread():
            assert set(threads.map_in_threads(lambda _: threading.get_ident(), range(9))) == {here}
            assert threads.usable_threads() == 1
        assert here not in set(threads.map_in_threads(lambda _: threading.get_ident(), range(9)))
        assert threads.usable_threads() == 4


@pytest.mark.parametrize("count", [1, 2, 8])
def test_as_many_items_are_in_work_as_cores_may_be_used(count):
    inside, most, lock = [0], [0], threading.Lock()

    def work(_):
        with lock:
            inside[0] += 1
            most[0] = max(most[0], inside[0])
        time.sleep(0.02)
        with lock:
            inside[0] -= 1

    with limited_cores(count):
        list(map_in_threads(work, range(4 * count)))
    assert most[0] == count
