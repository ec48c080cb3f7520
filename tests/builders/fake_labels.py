"""Shards labelled without any estimate: numbers made of the pixels, so that runs can be compared to the last byte.

Run as a script, ``python fake_labels.py FOLDER``, it labels a folder several times, each time killed and continued,
whenever something was about to get its name on disc, or to be flushed to it. Prints how often it was killed.
"""

import hashlib
import os
import signal
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from ipjax.files.images.run_lengths import encode_rle
from ipjax.files.objects.record import ObjectInfo
from ipjax.labelling.records import empty_labels
from ipjax.labelling.shards.plan import LabelledObject
from ipjax.labelling.shards.working import Report, Worker
from ipjax.labelling.sources.frame_folder import FrameFolder
from ipjax.transforms import Similarity

NUMBERS = (3, 5)
INFOS = tuple(
    ObjectInfo(
        name=f"obj_{number:06d}",
        encoder="none",
        mesh_scale=0.01,
        vertices=np.array([[0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3], [-0.3, -0.3, -0.3]]),
        faces=np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 3]]),
    )
    for number in NUMBERS
)


def write_frames(folder: Path, count: int = 7) -> Path:
    """A folder of frames of noise; the depth image of frame 2 is damaged."""
    rng = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(count):
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(folder / "rgb" / f"{number}.png")
        depth = rng.integers(500, 900, (24, 32)).astype(np.uint16)
        Image.fromarray(depth).save(folder / "depth" / f"{number}.png")
    (folder / "depth" / "2.png").write_bytes(b"no image")
    (folder / "camera.json").write_text('{"fx": 30, "fy": 30, "cx": 15.5, "cy": 11.5, "depth_scale": 1}')
    return folder


def label(batch: dict) -> dict:
    """As `ipjax.labelling.batch.Labeller` does, with numbers made of the frame's pixels."""
    made = {"id": np.array(batch["id"], object), **empty_labels(len(batch["id"]), 2)}
    for row, rgb in enumerate(batch["rgb"]):
        rng = np.random.default_rng(int.from_bytes(hashlib.sha256(rgb.tobytes()).digest()[:4], "little"))
        made["size"][row], made["seconds"][row] = rgb.shape[:2], rng.random()
        for slot in range(2):
            at = row, slot
            mask = np.zeros(rgb.shape[:2], bool)
            mask[4:12, 6 + 8 * slot : 14 + 8 * slot] = True
            pose = Similarity(np.eye(3), np.array([*rng.uniform(-0.05, 0.05, 2), 0.7]), np.array(0.001))
            made["object"][at], made["success"][at], made["present"][at] = slot, True, rng.random() < 0.6
            made["camera_from_mesh"][at], made["covariance"][at] = pose.to_matrix(), np.diag(rng.random(6))
            made["diameter"][at], made["diameter_std"][at] = 0.1, 0.001
            made["confidence"][at], made["margin"][at] = rng.random(2)
            made["mask"][at], made["box"][at] = encode_rle(mask)["counts"], (6 + 8 * slot, 4, 8, 8)
            made["outline_pixels"][at] = 80
    return made


def make_worker(folder: Path, frames: Path, *, batch: int = 2, shard_size: int = 4, previews: int = 3) -> Worker:
    """A worker on the frames of `write_frames`: two shards."""
    source = FrameFolder(frames, NUMBERS)
    manifest = {"batch": batch, "previews": previews, "shard_size": shard_size}
    objects = [LabelledObject(n, Path("none"), info) for n, info in zip(NUMBERS, INFOS, strict=True)]
    return Worker(folder, manifest, source, source.keys(), label, objects, parquet=False)


def run(folder: Path, frames: Path, part: tuple[int, int] = (0, 1), **options) -> Report:
    folder.mkdir(parents=True, exist_ok=True)
    return make_worker(folder, frames, **options).run(part)


def hash_labels(folder: Path) -> dict[str, str]:
    """Every file of a folder of labels with its content, but for the log of how long frames took."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "logs" not in path.relative_to(folder).parts
    }


def kill_before(moment: int) -> None:
    """End this process without warning before the ``moment``-th time something is flushed, or gets its name."""
    left = [moment]

    def counting(function):
        def call(*arguments, **more):
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **more)

        return call

    for name in ("replace", "rename", "unlink", "mkdir", "fsync"):
        setattr(os, name, counting(getattr(os, name)))


def main(folder: Path) -> int:
    """Kill runs again and again, each time after a few more steps, and compare what they end in; how often."""
    frames, rng, total = write_frames(folder / "frames"), np.random.default_rng(1), 0
    if (child := os.fork()) == 0:  # here nothing is labelled: a process that has used JAX cannot be forked
        run(folder / "undisturbed", frames)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    expected = hash_labels(folder / "undisturbed")
    for number in range(2):
        labels = folder / f"killed {number}"
        for killed in range(100):
            child = os.fork()
            if child == 0:
                kill_before(int(rng.integers(2, 12 + 12 * killed)))
                run(labels, frames)
                os._exit(0)
            rng.integers(2, 12 + 12 * killed)  # the child's draw was its own
            if os.WIFEXITED(os.waitpid(child, 0)[1]):
                total += killed
                break
        assert hash_labels(labels) == expected, labels
    return total


if __name__ == "__main__":
    print(main(Path(sys.argv[1])))
