"""Runs of steps that are killed at every moment at which something gets its name on disc; run as a script.

It forks, so it is a process of its own: ``python killed_runs.py FOLDER``. Prints how many runs were killed.
"""

import hashlib
import os
import shutil
import signal
import sys
from pathlib import Path

import numpy as np

from ipjax.capture.reading.opening import open_capture
from ipjax.capture.steps.records import Job, Outcome, Step
from ipjax.capture.steps.running import run_steps
from ipjax.files.storage.folders import writing_folder
from ipjax.files.storage.writing import write_bytes, write_text


def write_numbers(folder: Path, seed: int = 0) -> None:
    """A capture of four frames of noise."""
    from PIL import Image

    rng = np.random.default_rng(seed)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for index in range(4):
        rgb = rng.integers(0, 255, (12, 16, 3), dtype=np.uint8)
        Image.fromarray(rgb).save(folder / "rgb" / f"{index}.png")
        Image.fromarray(rng.integers(500, 900, (12, 16)).astype(np.uint16)).save(folder / "depth" / f"{index}.png")
    (folder / "camera.json").write_text(
        '{"fx": 15, "fy": 15, "cx": 8, "cy": 6, "width": 16, "height": 12, "depth_scale": 1}'
    )


def make_steps(made: list[str]) -> tuple[Step, ...]:
    """Three steps, each of what the one before it made; they say in ``made`` that they were made.

    The second goes on with what it wrote when it was killed.
    """

    def count(job: Job) -> Outcome:
        made.append("count")
        total = sum(int(job.capture.read_frame(index).rgb.sum()) for index in range(len(job.capture)))
        write_text(job.work / "count.txt", str(total))
        write_text(job.work / "count.svg", "<svg/>")
        outputs = ["count.txt", "count.svg"]
        if job.settings["odd"]:
            write_text(job.work / "odd.txt", "odd")
            outputs.append("odd.txt")
        return Outcome(tuple(outputs), notes=(f"counted {total}",))

    def spread(job: Job) -> Outcome:
        made.append("spread")
        total = int((job.work / "count.txt").read_text())
        folder = job.work / "spread"
        folder.mkdir(exist_ok=True)
        for index in range(2):
            if not (folder / f"{index}.bin").exists():
                write_bytes(folder / f"{index}.bin", np.arange(50).tobytes() + bytes([total % 251, index]))
        return Outcome(("spread",), stop="too little" if job.settings["little"] else None)

    def publish(job: Job) -> Outcome:
        made.append("publish")
        with writing_folder(job.dataset, replace=True) as folder:
            for path in sorted((job.work / "spread").iterdir()):
                write_bytes(folder / path.name, path.read_bytes()[::-1])
        return Outcome((os.path.relpath(job.dataset, job.work),))

    fields = {"title": "", "does": "", "caption": "", "modules": ("ipjax.progress",)}
    heed = lambda *names: lambda settings: {name: settings[name] for name in names}
    return (
        Step("count", picture="count.svg", needs=(), results=("count.txt",), sometimes=("odd.txt",), extras=(),
             choose=heed("odd"), make=count, **fields),
        Step("spread", picture="none.svg", needs=("count",), results=("spread",), sometimes=(), extras=(),
             choose=heed("little"), make=spread, continues=True, **fields),
        Step("publish", picture="none.svg", needs=("spread",), results=(), sometimes=(), extras=(),
             choose=heed(), make=publish, into_dataset=True, **fields),
    )  # fmt: skip


def make_job(folder: Path, name: str, **settings: bool) -> Job:
    """A run over the capture in ``folder``/capture, whose results have this name."""
    capture = open_capture(folder / "capture")
    return Job(capture, folder / f"{name}.work", folder / name, {"odd": False, "little": False} | settings)


def hash_files(root: Path) -> dict[str, str]:
    """Every file of a folder, the log of runs left out, with what is in it."""
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != "log.jsonl"
    }


def kill_before(moment: int) -> None:
    """End this process without warning before the ``moment``-th time something gets its name, or loses it."""
    left = [moment]

    def counting(function):
        def call(*arguments, **more):
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **more)

        return call

    for name in ("replace", "rename", "unlink", "mkdir", "open"):
        setattr(os, name, counting(getattr(os, name)))


def main(folder: Path) -> int:
    """Kill runs at every moment, go on with each, and compare; returns how many were killed."""
    write_numbers(folder / "capture")
    whole = make_job(folder, "undisturbed/out")
    run_steps(make_steps([]), whole)
    for moment in range(1000):
        job = make_job(folder, "killed/out")
        child = os.fork()
        if child == 0:
            kill_before(moment)
            run_steps(make_steps([]), job)
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        run_steps(make_steps([]), job)
        assert hash_files(folder / "killed") == hash_files(folder / "undisturbed"), moment
        shutil.rmtree(folder / "killed")
        if os.WIFEXITED(status):
            return moment
    raise AssertionError("it never ended")


if __name__ == "__main__":
    print(main(Path(sys.argv[1])))
