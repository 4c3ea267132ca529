"""Work in copies of the process gives the same results as sequential work."""

import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from marey.errors import FileProblem, WorkerKilled
from marey.fit.solver import processes
from marey.fit.solver.processes import map_in_processes, zip_in_processes
from marey.fit.solver.threads import one_thread, usable_threads
from marey.io.stages import FrameLog
from marey.process import limited_cores

pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
"""Some tests fork the process themselves, beside threads of other tests."""
copied = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")


def pending_children():
    """Return the processes that this one has started and that have not ended."""
    return [child for child in processes.multiprocessing.active_children() if child.is_alive()]


@copied
@pytest.mark.parametrize("count", [2, 5])
def test_results_come_in_the_order_of_the_items_from_as_many_processes_as_cores(count, rng):
    pauses = rng.uniform(0, 0.01, 30)

    def work(i):
        time.sleep(pauses[i])
        return i * i, os.getpid()

    with limited_cores(count):
        found = list(map_in_processes(work, range(30)))
    assert [square for square, _ in found] == [i * i for i in range(30)]
    pids = {pid for _, pid in found}
    assert len(pids) == count
    assert os.getpid() not in pids
    assert pending_children() == []


def test_few_items_and_one_core_need_no_process():
    here = os.getpid()
    assert list(map_in_processes(lambda i: i, [])) == []
    with limited_cores(4):
        assert list(map_in_processes(lambda _: os.getpid(), range(1))) == [here]
    with limited_cores(1):
        assert set(map_in_processes(lambda _: os.getpid(), range(5))) == {here}


@copied
def test_work_in_another_thread_or_inside_other_work_starts_no_process():
    found = []

    def task():
        found.append(set(map_in_processes(lambda _: os.getpid(), range(4))))

    thread = threading.Thread(target=task)
    with limited_cores(2):
        thread.start()
        thread.join()
        inside = list(map_in_processes(lambda _: (usable_threads(), os.getpid(), *map_in_processes(pid, [1])), [0, 1]))
    assert found == [{os.getpid()}]
    assert all(threads == 1 and own == nested for threads, own, nested in inside)


def pid(_):
    return os.getpid()


@copied
def test_arrays_keep_their_values_and_whether_they_are_read_only(rng):
    fixed = rng.normal(size=(3, 4))
    fixed.setflags(write=False)
    free = rng.normal(size=5)
    with limited_cores(2):
        for own, other, strided in map_in_processes(lambda _: (fixed, free, fixed.T[::2]), range(3)):
            np.testing.assert_array_equal(own, fixed)
            np.testing.assert_array_equal(other, free)
            np.testing.assert_array_equal(strided, fixed.T[::2])
            assert not own.flags.writeable
            assert other.flags.writeable


@copied
def test_what_work_changes_is_lost_and_items_are_given_only_a_few_ahead(tmp_path):
    changed = []

    def work(i):
        changed.append(i)
        (tmp_path / str(i)).touch()
        return i

    with limited_cores(2):
        found = map_in_processes(work, range(100))
        next(found)
        time.sleep(0.1)
        assert len(list(tmp_path.iterdir())) <= 2 * processes._AHEAD
        found.close()
    assert changed == []
    assert pending_children() == []


@copied
def test_an_error_in_a_process_is_that_of_the_work():
    def work(i):
        if i == 7:
            raise FileProblem("take.mp4", "is damaged", "Copy it again.")
        return i

    with limited_cores(2), pytest.raises(FileProblem, match=r"take\.mp4: is damaged"):
        list(map_in_processes(work, range(20)))
    assert pending_children() == []


@copied
def test_a_killed_process_is_reported():
    def work(i):
        if i == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return i

    with limited_cores(2), pytest.raises(WorkerKilled, match="lack of memory"):
        list(map_in_processes(work, range(20)))


@copied
def test_processes_end_with_their_caller():
    """The caller is killed while its copies work; they do not finish their items."""
    reading, writing = os.pipe()

    def work(_):
        time.sleep(3)
        os.write(writing, b"finished")

    caller = os.fork()
    if caller == 0:
        os.close(reading)
        with limited_cores(2):
            list(map_in_processes(work, range(4)))
        os._exit(0)
    os.close(writing)
    time.sleep(0.3)
    os.kill(caller, signal.SIGKILL)
    os.waitpid(caller, 0)
    # The pipe is closed when the last copy has ended; one that has finished its item would have written to it.
    assert os.read(reading, 1) == b""
    os.close(reading)


@copied
def test_a_process_that_may_not_start_others_shares_the_work_among_threads():
    context = processes.multiprocessing.get_context("fork")
    here, there = context.Pipe()

    def task():
        with limited_cores(2):
            there.send(set(map_in_processes(pid, range(4))) == {os.getpid()})

    process = context.Process(target=task, daemon=True)
    process.start()
    process.join()
    assert here.recv()


def streams(lengths, pids):
    def begin(k):
        pids.add(os.getpid())
        yield from ((k, i, os.getpid()) for i in range(lengths[k]))

    return [lambda k=k: begin(k) for k in range(len(lengths))]


@pytest.mark.parametrize("cores", [1, pytest.param(3, marks=copied)])
def test_streams_advance_together(cores):
    with limited_cores(cores):
        found = list(zip_in_processes(streams([40, 40, 40], set())))
    assert [[item[:2] for item in row] for row in found] == [[(k, i) for k in range(3)] for i in range(40)]
    own = {item[2] for row in found for item in row}
    assert len(own) == cores if cores > 1 else own == {os.getpid()}
    assert pending_children() == []


@copied
def test_a_long_stream_waits_until_it_is_read():
    made = processes.multiprocessing.Value("i", 0)

    def stream():
        for _ in range(1000):
            made.value += 1
            yield np.zeros(10_000)

    with limited_cores(2):
        found = zip_in_processes([stream, stream])
        next(found)
        time.sleep(0.1)
        assert made.value < 50
        found.close()


@copied
@pytest.mark.parametrize("at", [0, 3])
def test_an_error_in_a_stream_is_that_of_the_stream(at):
    def stream():
        for i in range(6):
            if i == at:
                raise FileProblem("take.mp4", f"is damaged at frame {i}")
            yield i

    seen = []
    with limited_cores(2), pytest.raises(FileProblem, match=f"damaged at frame {at}"):
        seen.extend(zip_in_processes([stream, lambda: iter(range(6))]))
    assert pending_children() == []


@copied
def test_a_stream_that_fails_in_its_process_alone_goes_on_in_the_caller():
    caller = os.getpid()

    def stream():
        for i in range(6):
            if i == 2 and os.getpid() != caller:
                raise ValueError
            yield i

    with limited_cores(2):
        assert list(zip_in_processes([stream, stream])) == [(i, i) for i in range(6)]


def test_one_thread_needs_no_process():
    with limited_cores(4), one_thread():
        assert set(map_in_processes(pid, range(5))) == {os.getpid()}


@copied
def test_copies_read_the_same_log_at_the_same_time(tmp_path):
    # The copies share the position in the file, so that none of them may use it.
    with FrameLog(tmp_path / "a.log") as log:
        for frame in range(40):
            log.append({"numbers": np.full(100 + frame, frame)})

        def equal(start: int) -> bool:
            order = [(start + 7 * k) % len(log) for k in range(500)]
            try:
                read = [(frame, log[frame]["numbers"], log.array(frame, "numbers")) for frame in order]
            except FileProblem:  # The caller would repeat the work alone, and hide the error.
                return False
            return all(np.array_equal(n, np.full(100 + f, f)) for f, *both in read for n in both)

        with limited_cores(4):
            assert all(map_in_processes(equal, range(4)))
