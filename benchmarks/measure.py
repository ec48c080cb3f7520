"""Timing: all functions of a row are compiled first, then run in turns, so that other load affects them alike."""

import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax


def compile_fresh(function: Callable, *arguments) -> tuple[Callable, float, int]:
    """The compiled function, the seconds that tracing and compiling it took, and the bytes of its temporary arrays."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    memory = compiled.memory_analysis()
    return compiled, seconds, int(memory.temp_size_in_bytes) if memory is not None else -1


def time_in_turns(
    calls: dict[str, Callable[[], Any]], repeats: int, seconds: float = 20.0, rest: float = 0.0
) -> dict[str, list[float]]:
    """Seconds of every call, run one after another ``repeats`` times; fewer (at least 3) once ``seconds`` are spent.

    With ``rest``, each timed call follows a pause of that many seconds and untimed calls for as long. Libraries with
    threads of their own need it: threads that have just worked go on spinning (OpenBLAS's do) and take the
    cores from the next call, and those that wake up share a core for about as long.
    """
    for call in calls.values():
        jax.block_until_ready(call())
    times: dict[str, list[float]] = {name: [] for name in calls}
    begin = time.perf_counter()
    for turn in range(repeats):
        if turn >= 3 and time.perf_counter() - begin > seconds:
            break
        for name, call in calls.items():
            if rest:
                time.sleep(rest)
                warm = time.perf_counter() + rest
                while time.perf_counter() < warm:
                    jax.block_until_ready(call())
            start = time.perf_counter()
            jax.block_until_ready(call())
            times[name].append(time.perf_counter() - start)
    return times


def summarise(times: list[float]) -> dict[str, float | int]:
    """Median, quartiles and the fastest, in milliseconds."""
    low, middle, high = statistics.quantiles(times, n=4) if len(times) > 1 else [times[0]] * 3
    return {
        "median_ms": middle * 1e3,
        "quartile_1_ms": low * 1e3,
        "quartile_3_ms": high * 1e3,
        "fastest_ms": min(times) * 1e3,
        "runs": len(times),
    }


def describe_device() -> dict[str, str | int]:
    """What the figures were measured on."""
    device = jax.devices()[0]
    name = device.device_kind
    if device.platform == "cpu":
        name = platform.processor() or platform.machine()
        info = Path("/proc/cpuinfo")
        if info.exists():
            models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line]
            name = models[0] if models else name
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0
    return {
        "platform": device.platform,
        "device": name,
        "cores": cores,
        "jax": jax.__version__,
        "python": platform.python_version(),
        "system": platform.system(),
    }


def commit() -> str:
    """The commit of this checkout, with a mark where files differ from it; "unknown" outside of one."""
    try:
        named = _git("rev-parse", "--short=10", "HEAD").strip()
        return f"{named}-dirty" if changed_files() else named
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def changed_files() -> list[str]:
    """Files that differ from the commit. Pages of results, and README's figures, are made from it and do not count."""
    lines = _git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":!/benchmarks/results", ":!/README.md")
    return [line[3:] for line in lines.splitlines()]


def _git(*arguments: str) -> str:
    folder = Path(__file__).parent
    return subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout
