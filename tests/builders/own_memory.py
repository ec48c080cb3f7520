"""Processes whose peak memory is their own."""

import subprocess
from collections.abc import Sequence


def run(command: Sequence[str], timeout: float) -> subprocess.CompletedProcess[str]:
    """Run a command by way of a shell, so that `resource` reports its memory and not that of the tests.

    On Linux a process begins with the peak of the one that started it: the tests' own would hide what it takes.
    """
    by_shell = ["sh", "-c", '"$@"; exit $?', "sh", *command]
    return subprocess.run(by_shell, capture_output=True, text=True, timeout=timeout)
