"""Lets things fall onto a table with MuJoCo, in a process of its own; started by `settling`, never imported.

MuJoCo reads MUJOCO_GL when it is imported and a wrong value can abort the process, so only a child imports it. It needs
NumPy and MuJoCo alone, to start fast. Arguments: the folder of the job. In: ``job.json`` and ``points{i}.npy``, the
corners of each thing's hull, about its middle. Out: ``settled.npz``: places, quaternions (w first), whether everything
rests, how deep things are in each other, and which fell; or a line on standard output that says why not.
"""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings declare their names at run time.)

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

STILL = 0.003  # metres per second, and rad per second times a thing's radius, below which it rests
QUIET = 0.25  # seconds for which it does


def build(folder: Path, job: dict) -> mujoco.MjModel:
    """A table whose top is z = 0, and a free body for each hull."""
    spec = mujoco.MjSpec()
    spec.option.timestep = job["step"]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations = 60
    contact = {"condim": 6, "friction": [job["friction"], 0.004, 0.002], "solref": [0.006, 1.0]}
    x, y = job["table"]
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[x / 2, y / 2, 0.02], pos=[0, 0, -0.02], name="table", **contact
    )
    for number in range(job["count"]):
        mesh = spec.add_mesh(name=f"hull{number}")
        mesh.uservert = np.load(folder / f"points{number}.npy").astype(np.float64).ravel().tolist()
        body = spec.worldbody.add_body(name=f"body{number}", pos=job["parked"][number])
        body.add_freejoint()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"hull{number}",
            density=job["density"],
            name=f"geom{number}",
            **contact,
        )
    return spec.compile()


def main(folder: Path) -> None:
    """Drop the things one after another, each when those before rest, and write where they come to lie."""
    job = json.loads((folder / "job.json").read_text())
    model = build(folder, job)
    data = mujoco.MjData(model)
    count = job["count"]
    radius = np.array([np.linalg.norm(np.load(folder / f"points{i}.npy"), axis=1).max() for i in range(count)])
    slots = [slice(7 * i, 7 * i + 7) for i in range(count)]
    speeds = [slice(6 * i, 6 * i + 6) for i in range(count)]

    def hold(waiting: range) -> None:
        for i in waiting:
            data.qpos[slots[i]] = [*job["parked"][i], 1, 0, 0, 0]
            data.qvel[speeds[i]] = 0

    quiet = 0.0
    for number in range(count):
        heights = [top(model, data, i) for i in range(number)]
        floor = max(heights, default=0.0)
        place = job["drop"][number]
        data.qpos[slots[number]] = [*place[:2], floor + radius[number] + 0.01, *place[2:]]
        data.qvel[speeds[number]] = 0
        quiet, waiting = 0.0, range(number + 1, count)
        for _ in range(int(job["longest"] / job["step"])):
            hold(waiting)
            mujoco.mj_step(model, data)
            moving = data.qvel.reshape(-1, 6)[: number + 1]
            speed = np.linalg.norm(moving[:, :3], axis=1) + radius[: number + 1] * np.linalg.norm(moving[:, 3:], axis=1)
            quiet = quiet + job["step"] if (speed < STILL).all() else 0.0
            if quiet > QUIET:
                break
    mujoco.mj_forward(model, data)
    deep = max((-float(contact.dist) for contact in data.contact[: data.ncon]), default=0.0)
    speed = np.linalg.norm(data.qvel.reshape(-1, 6)[:, :3], axis=1)
    # The compiler moves hulls inside of their bodies; the bodies' own frames stay those of the points given.
    np.savez(
        folder / "settled.npz",
        places=data.qpos.reshape(-1, 7)[:, :3],
        turns=data.qpos.reshape(-1, 7)[:, 3:],
        quiet=quiet > QUIET,
        deep=deep,
        speed=speed,
    )
    print("done", mujoco.__version__, flush=True)


def top(model: mujoco.MjModel, data: mujoco.MjData, number: int) -> float:
    """How high a thing reaches."""
    geom = number + 1
    mesh = model.geom_dataid[geom]
    start, size = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    turn = data.geom_xmat[geom].reshape(3, 3)
    return float((model.mesh_vert[start : start + size] @ turn[2]).max() + data.geom_xpos[geom][2])


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except Exception as error:  # the parent turns this line into its own sentence
        print("error", f"{type(error).__name__}: {error}".replace("\n", " "), flush=True)
        sys.exit(1)
