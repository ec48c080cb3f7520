"""Labels made by a process with several devices, as JSON on standard output; `label` starts it, with four."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = ("success", "present", "camera_from_mesh", "confidence", "covariance", "diameter", "mask", "note")


def label(frames: int) -> dict:
    """The frames of `labelled_frames`, labelled with the settings that are chosen where there are four devices."""
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4",
        "JAX_PLATFORMS": "cpu",
        "JAX_NUMPY_DTYPE_PROMOTION": "strict",
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / "build" / "xla-cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
        "PYTHONPATH": os.pathsep.join(str(ROOT / part) for part in (".", "kernels", "tests")),
    }
    command = [sys.executable, "-W", "error", __file__, str(frames)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def main(count: int) -> None:
    import jax
    from builders.labelled_frames import as_batch, labeller, make_frames

    many = labeller(threads=1)
    made = many(as_batch(make_frames(count)))
    programs = {}
    for (name, *_), program in many._estimator(False)._compiled.items():
        assert name not in programs, f"{name} was compiled twice"
        programs[name] = [len(one.device_set) for one in jax.tree.leaves(program.output_shardings)]
    columns = {name: made[name].tolist() for name in COLUMNS}
    print(json.dumps({"buckets": many.buckets, "programs": programs, "columns": columns}))


if __name__ == "__main__":
    main(int(sys.argv[1]))
