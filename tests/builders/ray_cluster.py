"""Frames labelled on a local cluster of Ray, with an actor that dies: `label` starts a process that does it.

Ray's own processes and warnings stay out of the tests' process so.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

NO_CLUSTER = 77  # the exit status where Ray cannot start any
ROOT = Path(__file__).resolve().parents[2]
COLUMNS = ("id", "error", "success", "camera_from_mesh", "confidence", "covariance", "mask", "note", "scene")


def label(frames: int, marker: Path) -> tuple[dict, str]:
    """The frames of `labelled_frames` by two actors, and what Ray said.

    The last frame has no depth. One of the actors dies within its second batch, and leaves the file ``marker``. The
    test is skipped where no cluster can be started, for it needs ports and shared memory.
    """
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / "build" / "xla-cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
        "PYTHONPATH": os.pathsep.join(str(ROOT / part) for part in (".", "kernels", "tests")),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    }
    command = [sys.executable, __file__, str(frames), str(marker)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    if run.returncode == NO_CLUSTER:
        pytest.skip(f"Ray starts no cluster here: {run.stderr.strip().splitlines()[-1]}")
    assert run.returncode == 0, f"{run.stdout}\n{run.stderr}"
    return json.loads(run.stdout.splitlines()[-1]), run.stderr


def main(count: int, marker: Path) -> None:
    import ray
    from builders.labelled_frames import CONFIG, as_batch, labelled_objects, make_frames, named_encoder

    from ipjax.labelling.batch import Labeller
    from ipjax.labelling.ray import label_dataset

    def load():
        """Called in the actor: one of its batches, too, does not end well."""
        undisturbed, calls = Labeller.__call__, []

        def disturbed(self, batch):
            made = undisturbed(self, batch)
            calls.append(batch)
            if len(calls) == 2:
                try:
                    marker.open("x").close()
                except FileExistsError:
                    return made
                os._exit(1)
            return made

        Labeller.__call__ = disturbed
        return named_encoder(), labelled_objects()

    batch = as_batch(make_frames(count))
    batch["depth"][-1] = 0
    rows = [{name: column[row] for name, column in batch.items()} | {"scene": 7} for row in range(count)]
    options = {"num_cpus": 3, "object_store_memory": 10**8, "_memory": 2 * 10**9}
    try:
        ray.init(include_dashboard=False, log_to_driver=False, **options)
    except Exception as error:  # whatever it is that this machine lacks
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(NO_CLUSTER)
    frames = ray.data.from_items(rows, override_num_blocks=4)
    labels = label_dataset(frames, load, workers=2, memory=5 * 10**8, batch=2, config=CONFIG, keep=["scene"])
    found = labels.take_all()
    ray.shutdown()
    as_json = lambda value: value.tolist() if hasattr(value, "tolist") else value
    print(json.dumps([{name: as_json(row[name]) for name in COLUMNS} for row in found]))


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
