"""The workers of a study: processes of this computer, or those of an existing scheduler."""

import concurrent.futures
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from marey.errors import MareyError, SettingProblem
from marey.extras import import_optional
from marey.pipelines.progress import Progress
from marey.process import usable_cores

_ONE_THREAD = {
    name: "1"
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}  # fmt: skip
"""Environment of a worker: one thread in BLAS and Numba before they are loaded; `run_step` limits OpenCV."""
_CONFIG: dict[str, Any] = {
    # Nothing is kept in the memory of a worker, so there is nothing that it could move to the disk.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # A worker gets its next step when it has ended one: steps that wait at a worker that dies are not suspected.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.allowed-failures": 2,
    # A step may hold the lock of the interpreter while it compiles.
    "distributed.comm.timeouts.connect": "10s",
    "distributed.worker.daemon": False,
    # Looking at a step every 10 ms took 8 % of the processor time of five marker trials; it is shown nowhere.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.limit": "1h",
}
"""Settings of a local cluster."""
CONNECT_S = 10.0
"""Time after which a scheduler counts as not there [s]. Chosen by hand: a connection in a laboratory takes far less."""
_LOGGERS = ("distributed", "distributed.client")
"""Loggers that have a level of their own, and would write what messages of marey state already."""
_WAIT_S = 5.0
"""Time between two looks for the first worker of an existing scheduler [s]. Chosen by hand."""
_CLOSE_S = 10.0
"""Time for the workers of a local cluster to end before they are killed [s]. Chosen by hand."""


class SchedulerLost(MareyError):
    """The scheduler of a study ended, or the connection to it was lost."""


@contextmanager
def opened_client(
    scheduler: str | None, *, workers: int | None, memory_gb: float | None, progress: Progress
) -> Iterator[Any]:
    """Connect to the workers of a study.

    Args:
        scheduler: Address of an existing scheduler, such as `tcp://node01:8786`; None starts processes here.
        workers: Number of these processes; one per core by default.
        memory_gb: Memory of each of these processes, above which it is ended [GB]; by default an equal share of all.
        progress: Progress reporter.

    Yields:
        The client of `dask.distributed`.

    Raises:
        SettingProblem: A value is impossible, no scheduler answers, or its workers have several threads.
        SchedulerLost: The scheduler ended while it was waited for workers.
        MissingPackage: `distributed` is not installed.
    """
    _check(scheduler, workers, memory_gb)
    dask = import_optional("dask", extra="study", purpose="Studies")
    distributed = import_optional("distributed", extra="study", purpose="Studies")
    if scheduler is not None:
        with _connected(distributed, scheduler, progress) as client:
            yield client
        return
    count = workers or usable_cores()
    limit = f"{memory_gb}GB" if memory_gb else distributed.system.MEMORY_LIMIT // count
    with dask.config.set(_CONFIG):
        cluster = _local_cluster(distributed, count, limit)
        try:
            with distributed.Client(cluster, set_as_default=False) as client:
                yield client
        finally:
            cluster.close(timeout=_CLOSE_S)


def _local_cluster(distributed: Any, workers: int, limit: Any) -> Any:
    """Start the processes; only this computer can connect to them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about slow disks
        return distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=limit, env=_ONE_THREAD,
            silence_logs=logging.CRITICAL, worker_dashboard_address=None,
            # Without an address, its server for pages has the port 8787, and a second study warns that it is taken.
            dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
        )  # fmt: skip


def _check(scheduler: str | None, workers: int | None, memory_gb: float | None) -> None:
    if scheduler is not None and (workers is not None or memory_gb is not None):
        raise SettingProblem("--scheduler has workers of its own: leave out --workers and --memory.")
    if workers is not None and workers < 1:
        raise SettingProblem(f"workers (--workers) is {workers}; it should be at least 1.")
    if memory_gb is not None and not 0.2 <= memory_gb < 1e5:
        raise SettingProblem(f"memory (--memory) is {memory_gb} GB; it should be at least 0.2, and 2 for videos.")


@contextmanager
def _connected(distributed: Any, address: str, progress: Progress) -> Iterator[Any]:
    with _quiet_loggers():
        try:
            client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SettingProblem(
                f"No scheduler answers at {address} (--scheduler). Start one with `dask scheduler`, and give the "
                "address that it prints, such as tcp://node01:8786."
            ) from error
        with client:
            with scheduler_named(address):
                _require_workers(client, address, progress)
            yield client


@contextmanager
def _quiet_loggers() -> Iterator[None]:
    """Let `distributed` write nothing but what ends the program."""
    levels = {name: logging.getLogger(name).level for name in _LOGGERS}
    try:
        for name in levels:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


@contextmanager
def scheduler_named(address: str) -> Iterator[None]:
    """Name the scheduler if it is lost during a call of its client.

    Args:
        address: Address of the scheduler.

    Yields:
        Nothing.

    Raises:
        SchedulerLost: The connection to the scheduler was lost.
    """
    distributed = import_optional("distributed", extra="study", purpose="Studies")
    lost = (OSError, concurrent.futures.CancelledError, distributed.client.ClosedClientError)
    try:
        yield
    except lost as error:
        raise SchedulerLost(
            f"The scheduler at {address} has ended, or the connection to it was lost. Start it and its workers again, "
            "and run the same command with its address: it resumes, and does only what is missing."
        ) from error


def _require_workers(client: Any, address: str, progress: Progress) -> None:
    """Wait for the first worker, and check that every worker has one thread."""
    if not client.nthreads():
        progress.report(f"{address} has no workers yet. Waiting for the first one.")
        while not client.nthreads():
            try:
                client.wait_for_workers(1, timeout=_WAIT_S)
            except TimeoutError:
                continue
    threaded = [name for name, threads in client.nthreads().items() if threads != 1]
    if threaded:
        raise SettingProblem(
            f"The worker {threaded[0]} of {address} has several threads: start workers with `dask worker --nthreads 1`."
        )
