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
# # A capture becomes a data set
#
# A camera goes around a table; out come models of what stands there and labels in every frame, in BOP's layout. The
# capture is made in code, so that the truth is known: small images of a perfect sensor, and a depth camera that the
# factory has right, so that it need not be solved.

# %%
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ipjax
from ipjax.bop.dataset import Dataset
from ipjax.capture.dataset import make_dataset
from ipjax.capture.models.making import ModelConfig
from ipjax.capture.steps.settings import RunSettings
from ipjax.config import OnboardConfig
from ipjax.files.images.opening import read_rgb
from ipjax.synthetic.captures import make_capture, write_capture
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.sensor import PERFECT

plt.rcParams["figure.dpi"] = 60
folder = Path(tempfile.mkdtemp())
cartons = [make_object("carton", 1), make_object("carton", 3)]
sharp = {"size": (240, 180), "sensor": PERFECT, "factory_error": 0}
made = make_capture(3, views=6, arc=90, objects=cartons, sizes=(0.2, 0.2), **sharp)
write_capture(made, folder / "table", poses=True)
sorted(path.name for path in (folder / "table").iterdir())

# %% [markdown]
# ## One call
#
# On the command line it is `ipjax capture run table -o mytable`. Voxels are as wide as what a pixel of
# these small images sees.

# %%
settings = RunSettings(depth_mode="factory", models=ModelConfig(voxel=0.004))
run = make_dataset(folder / "table", folder / "mytable", settings=settings)
for one in run.done:
    print(f"{one.step.name:<7} {one.record.outcome.summary}")
    for warning in one.record.outcome.warnings:
        print(f"        look at: {warning}")

# %% [markdown]
# Each step left a picture that shows whether it is right; `report.html` in the folder of work shows all of them, with
# figures and what they mean. Here are the models, and the labels of every frame.

# %%
for name in ("models.png", "labels.png"):
    plt.figure(figsize=(9, 4.5))
    plt.imshow(read_rgb(run.work / name))
    plt.axis("off")
    plt.show()

# %% [markdown]
# ## Again
#
# What is finished is not made again. A step is repeated when something it was made of changed, or a file is gone; a run
# that was killed goes on in the same way.

# %%
(run.dataset / "camera.json").unlink()
again = make_dataset(folder / "table", folder / "mytable", settings=settings)
[(one.step.name, one.why) for one in again.done]

# %% [markdown]
# ## The data set
#
# It loads as any other in BOP's layout. The masks are compared with the truth.

# %%
dataset = Dataset(run.dataset)
shares = []
for image in range(len(made.names)):
    for truth in dataset.truths(0, image):
        mask = dataset.mask(0, image, truth.index)
        overlap = [(mask & (made.ids[image] == k)).sum() / (mask | (made.ids[image] == k)).sum() for k in range(2)]
        shares.append((truth.obj_id, int(np.argmax(overlap)), max(overlap)))
for number, model in dataset.models().items():
    mine = [share for obj_id, _, share in shares if obj_id == number]
    print(f"object {number}: {1000 * model.diameter:.0f} mm; overlap with the truth {np.median(mine):.2f}")

# %% [markdown]
# ## An object of it
#
# A model of the capture is a mesh as any other: it can be onboarded, and then be found elsewhere. The features are a
# stand-in here, so that nothing is downloaded.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp


class ColourEncoder(eqx.Module):
    """Waves of the mean colour of each patch; stands in for a network."""

    frequency: jax.Array
    identity: str = eqx.field(static=True, default="stand-in: colours")

    def __call__(self, image):
        rows, columns = image.shape[0] // 14, image.shape[1] // 14
        mean = image.reshape(rows, 14, columns, 14, 3).mean((1, 3))
        waves = jnp.cos(mean @ self.frequency)
        return waves / jnp.linalg.norm(waves, axis=-1, keepdims=True)


encoder = ColourEncoder(jnp.asarray(np.random.default_rng(0).normal(0, 4, (3, 32)), jnp.float32))
templates, info = ipjax.onboard(
    dataset.model_path(1, "models"),
    encoder,
    OnboardConfig(resolution=112, directions=6, rolls=1, surface=512),
    metres_per_unit=0.001,
    progress=False,
)
print(f"{info.name}: {len(templates.camera_from_object.scale)} templates")

# %%
assert [one.why is None for one in again.done] == [True] * 5 + [False]
assert {(obj_id, number) for obj_id, number, _ in shares} in ({(1, 0), (2, 1)}, {(1, 1), (2, 0)})
assert np.median([share for *_, share in shares]) > 0.85
assert json.loads((run.dataset / "dataset_info.json").read_text())["frames"] == list(made.names)
assert info.metres_per_unit and abs(info.metres_per_unit / info.mesh_scale - dataset.models()[1].diameter) < 1e-4
