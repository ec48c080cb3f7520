# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a pose to a grasp, with a good and a poor mesh
#
# The paper's experiment, small: a simulated gripper picks an object, once by a good mesh of it and once by a poor one,
# as a reconstruction from one photo might be. The object is the same, and lies the same. The gripper is one of boxes on
# a gantry, so that nothing is needed but MuJoCo. The pose is the true one here; with poses that ipjax finds from the
# simulated camera, and real scans, it is `python -m benchmarks.grasps`.

# %%
import matplotlib.pyplot as plt
import numpy as np

from ipjax.files.meshes.mesh import move, normalise
from ipjax.files.meshes.sampling import sample_surface
from ipjax.records import Surface
from ipjax.robot.cell.camera import look
from ipjax.robot.cell.cell import make_cell
from ipjax.robot.cell.report.film import draw_film
from ipjax.robot.cell.trial import try_pick
from ipjax.synthetic.degradation import degrade
from ipjax.synthetic.objects import make_object
from ipjax.transforms import Similarity

plt.rcParams["figure.dpi"] = 60

# %% [markdown]
# ## The object, good and poor
#
# Something like a drill. The poor mesh is level 4 of `ipjax degrade`: its back is the mirrored front, it is bumpy and
# coarse, its sides are stretched, and a tenth of it is missing. It has a size and a turn of its own, too;
# `good_from_poor` undoes them.

# %%
SIZE = 0.14  # metres
good = move(make_object("tee", 1), np.eye(3))
poor, good_from_poor = degrade(good, 4, 1)
aligned = {"good": good, "poor": move(poor, good_from_poor.rotation, good_from_poor.translation, good_from_poor.scale)}
known = {}
for name, mesh in aligned.items():
    unit = normalise(mesh)
    points, normals, seen = sample_surface(unit, 2048, seed=0)
    good_from_object = Similarity(np.eye(3), np.asarray(unit.centre), np.asarray(1 / unit.scale))
    known[name] = Surface(*(np.asarray(x, np.float32) for x in (points, normals, seen))), good_from_object

fig, axes = plt.subplots(1, 2, figsize=(8, 3.2), subplot_kw={"projection": "3d"})
for axis, (name, (surface, _)) in zip(axes, known.items(), strict=True):
    axis.scatter(*surface.points.T, s=2, c=surface.normals @ np.array([0.3, -0.5, 0.8]), cmap="gray")
    axis.set(title=f"the {name} mesh", xlim=(-0.4, 0.4), ylim=(-0.4, 0.4), zlim=(-0.4, 0.4))
    axis.axis("off")
plt.show()

# %% [markdown]
# ## It is picked
#
# Grasps are planned on what is known, never on the true mesh, and keep off what the cell's camera measured beside it.

# %%
cell = make_cell([move(good, np.eye(3), scale=SIZE)], 8, names=["drill"], arm="gantry")
sight = look(cell, oversample=1)
thing_from_good = Similarity(np.eye(3), np.zeros(3), np.asarray(SIZE))
trials = {}
for name, (surface, good_from_object) in known.items():
    pose = sight.camera_from_object[0] @ thing_from_good @ good_from_object
    trials[name] = try_pick(cell, surface, sight, pose.to_jax())
    pick = trials[name].pick
    print(f"{name}: {trials[name].planned} grasps planned; {pick.why}")

# %% [markdown]
# ## The film
#
# Above with the good mesh, below with the poor one.

# %%
SHOWN = 5
fig, axes = plt.subplots(2, SHOWN, figsize=(12, 3.9))
for row, (name, trial) in enumerate(trials.items()):
    for axis in axes[row]:
        axis.axis("off")
    recording = trial.pick.recording
    if recording is None:
        axes[row, 0].set_title(f"{name}: no pick")
        continue
    every = max((len(recording.times) - 1) // (SHOWN - 1), 1)
    for axis, frame in zip(axes[row], draw_film(cell, recording, every=every, size=(240, 180)), strict=False):
        axis.imshow(frame)
    axes[row, 0].set_title(f"{name} mesh")
plt.tight_layout()
plt.show()

# %%
assert trials["good"].pick.success
assert trials["poor"].planned
