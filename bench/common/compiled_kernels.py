"""The program under observation, in a process of its own: `python -m bench.common.compiled_kernels FILE WORDS...`.

It runs `marey WORDS...` and writes to FILE, as JSON: each kernel that was compiled with the types of its arguments, how
often, and the time of compilation, in seconds of the wall and of the processor. The time of a kernel that is compiled
within another one, and that of Numba's own functions, is part of it; the latter are not listed.
"""

import json
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from numba.core import event

from marey.cli import main
from marey.compiled import TRANSLATION


class Recorder(event.Listener):
    """Records what Numba compiles, in any thread."""

    def __init__(self) -> None:
        self.kernels: Counter[str] = Counter()
        self.wall_s, self.processor_s = 0.0, 0.0
        self._lock, self._own, self._open, self._since = threading.Lock(), threading.local(), 0, 0.0

    def on_start(self, event: Any) -> None:
        """Note the kernel, and the time if nothing was being compiled."""
        function = event.data["dispatcher"].py_func
        types = ", ".join(map(str, event.data["args"]))
        depth = getattr(self._own, "depth", 0)
        if depth == 0:
            self._own.begun = time.thread_time()
        self._own.depth = depth + 1
        with self._lock:
            # Neither what Numba compiles for its own functions nor the second part of a compilation.
            if function.__module__.startswith("marey.") and event.kind != TRANSLATION:
                self.kernels[f"{function.__module__}.{function.__qualname__}({types})"] += 1
            if self._open == 0:
                self._since = time.perf_counter()
            self._open += 1

    def on_end(self, event: Any) -> None:
        """Add the time if nothing is being compiled any more."""
        self._own.depth -= 1
        with self._lock:
            if self._own.depth == 0:
                self.processor_s += time.thread_time() - self._own.begun
            self._open -= 1
            if self._open == 0:
                self.wall_s += time.perf_counter() - self._since


def observe(path: Path, words: list[str]) -> int:
    """Run the program, and write what it compiled.

    Args:
        path: The JSON file.
        words: The words after `marey`.

    Returns:
        The exit code of the program.
    """
    recorder, begun = Recorder(), time.perf_counter()
    with event.install_listener("numba:compile", recorder), event.install_listener(TRANSLATION, recorder):
        code = main.run(words)
    found = {
        "whole_s": time.perf_counter() - begun, "wall_s": recorder.wall_s, "processor_s": recorder.processor_s,
        "kernels": recorder.kernels,
    }  # fmt: skip
    path.write_text(json.dumps(found))
    return code


if __name__ == "__main__":
    sys.exit(observe(Path(sys.argv[1]), sys.argv[2:]))
