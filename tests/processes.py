"""Other processes that run some lines of Python."""

import os
import subprocess
import sys


def started(code: str, *arguments: str, **variables: str) -> subprocess.Popen:
    """Start a process that runs code with arguments and further variables of the environment; its streams are pipes."""
    environment = {**os.environ, **variables, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
