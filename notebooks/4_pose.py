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
# # One frame to one pose, and how it fails
#
# The whole way, small: onboard, look, estimate. So that nothing is downloaded, the encoder is a **stand-in**: the
# object is painted with its own coordinates, and the "features" are waves of a patch's mean colour. It matches better
# than any network on a real object; what comes after the features is the real thing.

# %%
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import ipjax
from ipjax.cameras import project
from ipjax.config import AlignConfig, Config, OnboardConfig
from ipjax.onboarding.mesh import make_templates
from ipjax.synthetic.objects import make_object
from ipjax.synthetic.scenes import make_scene

plt.rcParams["figure.dpi"] = 60
PATCH = 14


class ColourEncoder(eqx.Module):
    """Waves of the mean colour of each patch; stands in for a network."""

    frequency: jax.Array
    phase: jax.Array
    identity: str = eqx.field(static=True, default="stand-in: colours")

    def __call__(self, image):
        rows, columns = image.shape[0] // PATCH, image.shape[1] // PATCH
        cells = image.reshape(rows, PATCH, columns, PATCH, 3)
        inked = jnp.any(cells > 0, axis=-1, keepdims=True).astype(image.dtype)
        mean = jnp.sum(cells * inked, axis=(1, 3)) / jnp.maximum(jnp.sum(inked, axis=(1, 3)), 1)
        waves = jnp.cos(mean @ self.frequency + self.phase)
        return waves / jnp.linalg.norm(waves, axis=-1, keepdims=True)


rng = np.random.default_rng(0)
encoder = ColourEncoder(
    jnp.asarray(rng.normal(0, 4, (3, 32)), jnp.float32), jnp.asarray(rng.uniform(0, 6.28, 32), jnp.float32)
)

# %% [markdown]
# ## Once per object

# %%
shape = make_object("tee", 1)
low, high = shape.vertices.min(0), shape.vertices.max(0)
painted = dataclasses.replace(
    shape,
    colours=np.round(40 + 215 * (shape.vertices - low) / (high - low)).astype(np.uint8),
    texture=None,
    uv=None,
)
settings = OnboardConfig(directions=16, rolls=4, resolution=168, surface=512)
templates, pictures = make_templates(painted, encoder, settings, progress=False)
print(f"{len(pictures)} templates of {templates.patches.points.shape[1]} patches")

# %% [markdown]
# ## Once per frame

# %%
scene = make_scene([painted, make_object("carton", 3)], 5, sizes=(0.17, 0.16), clutter=2, oversample=1)
true = scene.camera_from_object[0]
config = Config(align=AlignConfig(count=256))
find = jax.jit(ipjax.estimate)


def look(mask, depth=scene.depth):
    """The estimate for one mask and depth image."""
    view = ipjax.frame(scene.rgb, depth, mask, scene.matrix, resolution=168)
    return find(None, templates, ipjax.observe(encoder, view), jax.random.key(0), config)


def error(found):
    """Degrees, millimetres, and relative size."""
    R, Q = np.asarray(found.camera_from_object.rotation), np.asarray(true.rotation)
    angle = np.degrees(np.arccos(np.clip((np.trace(R @ Q.T) - 1) / 2, -1, 1)))
    offset = np.linalg.norm(np.asarray(found.camera_from_object.translation) - np.asarray(true.translation))
    return float(angle), 1000 * float(offset), float(found.camera_from_object.scale / true.scale - 1)


good = look(scene.masks[0])


# %%
def show(axis, found, title):
    """The photo with the object's surface points at the estimated pose."""
    pixels = np.asarray(project(scene.camera, found.camera_from_object @ templates.surface.points))
    axis.imshow(scene.rgb)
    axis.scatter(*pixels.T, s=1, c="cyan")
    axis.set(title=title, xlim=(0, 639), ylim=(479, 0))
    axis.axis("off")


degrees, millimetres, growth = error(good)
fig, axes = plt.subplots(1, 2, figsize=(10, 3.8))
axes[0].imshow(scene.masks[0], cmap="gray")
axes[0].axis("off")
axes[0].set_title("mask")
show(axes[1], good, f"off by {degrees:.1f}°, {millimetres:.1f} mm, {growth:+.1%} in size")
plt.show()

# %% [markdown]
# ## How it fails
#
# **The wrong mask.** The mask of another object is a question without an answer. An answer comes all the same; what it
# rests on (confidence, inliers) tells the two apart.
#
# **The wrong unit.** Depths that are too large by a quarter make a world that is larger by a quarter. Nothing in one
# frame contradicts it: the rotation stays right, and the size is off by exactly that.

# %%
wrong_mask = look(scene.masks[1])
wrong_unit = look(scene.masks[0], scene.depth * np.float32(1.25))

fig, axes = plt.subplots(1, 2, figsize=(10, 3.8))
show(axes[0], wrong_mask, "the carton's mask")
show(axes[1], wrong_unit, "depths × 1.25")
plt.show()
for name, found in (("right", good), ("wrong mask", wrong_mask), ("wrong unit", wrong_unit)):
    degrees, millimetres, growth = error(found)
    print(
        f"{name:11s} {degrees:6.1f}° {millimetres:7.1f} mm {growth:+7.1%} in size; "
        f"confidence {float(found.confidence):.2f}, {int(found.inliers)} inliers"
    )

# %%
degrees, millimetres, growth = error(good)
assert degrees < 12 and millimetres < 20 and abs(growth) < 0.1
assert float(wrong_mask.confidence) < float(good.confidence)
assert abs(error(wrong_unit)[2] - 0.25) < 0.12 and error(wrong_unit)[0] < 15
