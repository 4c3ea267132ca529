"""Detection of compilation: how long the process has compiled kernels or waited for them, and whether it does now."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any


class CompilationClock:
    """Measures the time that the process spends on compiling kernels, in any thread.

    Args:
        begun: Called when the process begins to compile.
    """

    def __init__(self, begun: Callable[[], None] = lambda: None):
        self._begun = begun
        self._lock = threading.Lock()
        self._open = 0
        self._since = 0.0
        self._spent = 0.0

    def start(self) -> None:
        """Record that the compilation of a kernel begins; kernels that it calls are compiled within it."""
        with self._lock:
            first = self._open == 0
            if first:
                self._since = time.perf_counter()
            self._open += 1
        if first:
            self._begun()

    def end(self) -> None:
        """Record that the compilation of a kernel ends."""
        with self._lock:
            self._open -= 1
            if self._open == 0:
                self._spent += time.perf_counter() - self._since

    @property
    def running(self) -> bool:
        """Whether a kernel is being compiled."""
        return self._open > 0

    @property
    def seconds(self) -> float:
        """Time spent on compilation so far [s]."""
        with self._lock:
            return self._spent + (time.perf_counter() - self._since if self._open else 0.0)


@contextmanager
def observed_compilation(clock: CompilationClock) -> Iterator[None]:
    """Let a clock observe the compilation of kernels.

    Args:
        clock: Is started and ended with the compilation of each kernel that is not found in the cache, and with each
            wait for another process that compiles one.

    Yields:
        Nothing.
    """
    from numba.core import event

    from marey.compiled import TRANSLATION, WAIT

    class Observer(event.Listener):
        """Passes Numba's events on to the clock."""

        def on_start(self, event: Any) -> None:
            """Start the clock."""
            clock.start()

        def on_end(self, event: Any) -> None:
            """End the clock."""
            clock.end()

    observer = Observer()
    with ExitStack() as installed:
        for kind in ("numba:compile", TRANSLATION, WAIT):
            installed.enter_context(event.install_listener(kind, observer))
        yield
