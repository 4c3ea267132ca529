"""Compilation of a command's kernels before their first call, in processes of their own.

A kernel is compiled at its first call, when nothing else can go on. The kernels that a command calls are known before
(`kernel_lists`), and several processes compile them at the same time. The command loads each from the cache, or waits
until it is there. Where a process ends early, or a kernel is in no list, the command compiles the kernel itself.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from marey.compiled.kernel_lists import ListedKernel, listed_kernels

MOST_PROCESSES = 6
"""Largest number of processes that compile beside the caller.

Chosen by hand. Each takes up to 0.4 GB, and the kernel that takes longest needs a ninth of the time of all kernels of a
capture, so that more than nine processes would not end earlier.
"""


@contextmanager
def compiled_ahead(name: str, *, processes: int) -> Iterator[None]:
    """Compile the kernels of a list that are not in the cache, while the caller goes on.

    Args:
        name: Name of the list; see `marey.compiled.kernel_lists`.
        processes: Number of processes, the caller included. The caller compiles a kernel that it needs and that no
            other process has begun. With one process, nothing is compiled ahead.

    Yields:
        Nothing. Processes that still compile at the end are ended.
    """
    started: list[subprocess.Popen[bytes]] = []
    if processes > 1 and sys.executable and any(kernel.is_missing for kernel in listed_kernels(name)):
        from marey.compiled.kernel_cache import kernel_folder

        # Without -P, modules of the user's working directory would come before those of the program.
        command = [sys.executable, "-P", "-m", "marey.compiled.ahead", name, str(kernel_folder())]
        count, nowhere = min(processes - 1, MOST_PROCESSES), subprocess.DEVNULL
        started = [subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere) for _ in range(count)]
    try:
        yield
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait()


def compile_missing(kernels: list[ListedKernel]) -> int:
    """Compile the kernels that are not in the cache and that no other process compiles at the time.

    Args:
        kernels: The kernels of a list, the most urgent first.

    Returns:
        How many were compiled.
    """
    count = 0
    for kernel in kernels:
        if kernel.is_missing and kernel.dispatcher.is_free(kernel.arguments):
            kernel.dispatcher.compile(kernel.arguments)
            count += 1
    return count


def _compile_list(name: str, folder: str) -> None:
    """Compile the kernels of a list, if this process keeps them in the same folder as the one that has started it."""
    from marey.compiled.kernel_cache import kernel_folder

    if str(kernel_folder()) == folder:
        compile_missing(listed_kernels(name))


if __name__ == "__main__":
    _compile_list(*sys.argv[1:])
