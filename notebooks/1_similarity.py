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
# # One similarity from three points
#
# A pose with unknown size is a similarity: rotation, translation, scale. Three pairs of points fix it, and `umeyama`
# finds the one that fits best. Everything later (RANSAC, refits) is this function, thousands of times over.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from ipjax_kernels.similarity import umeyama
from scipy.spatial.transform import Rotation

plt.rcParams["figure.dpi"] = 60
rng = np.random.default_rng(0)

# %% [markdown]
# Three corners of an object, in the object's own units, and the same three seen by a camera, in metres.

# %%
rotation = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix()
translation, scale = np.array([0.05, -0.02, 0.6]), 0.18

objects = rng.normal(size=(3, 3))
camera = scale * objects @ rotation.T + translation


def fit(source, target):
    """`umeyama` with all weights 1, as NumPy arrays."""
    arrays = jnp.asarray(source, jnp.float32), jnp.asarray(target, jnp.float32), jnp.ones(len(source))
    return [np.asarray(x) for x in umeyama(*arrays)]


R, t, s, success = fit(objects, camera)
print(f"scale {s:.4f} (true {scale}), translation {t.round(4)}, determined: {bool(success)}")

# %% [markdown]
# ## Which way round?
#
# The published algorithm prints `R = U Vᵀ` for the singular vectors of `Σ x_reference x_queryᵀ`. That is the inverse
# rotation. Umeyama's own form is `V D Uᵀ`, with `D = diag(1, 1, ±1)` so that the result never mirrors.

# %%
centred_object, centred_camera = objects - objects.mean(0), camera - camera.mean(0)
U, S, Vt = np.linalg.svd(centred_object.T @ centred_camera)
D = np.diag([1, 1, np.linalg.det(Vt.T @ U.T)])
printed, correct = U @ D @ Vt, Vt.T @ D @ U.T


def angle(A, B):
    """Degrees between two rotations."""
    return np.degrees(np.arccos(np.clip((np.trace(A @ B.T) - 1) / 2, -1, 1)))


print(f"as printed: {angle(printed, rotation):.1f}° off; V D Uᵀ: {angle(correct, rotation):.4f}° off")

# %% [markdown]
# ## What noise does
#
# Three points are exact and brittle. The wider apart they are, the less the same noise matters, and more points help
# with the root of their number. That is why a hypothesis from three pairs is refitted to all pairs that agree with it.

# %%
fig, axis = plt.subplots(figsize=(7, 4))
for count in (3, 10, 100):
    errors = []
    for spread in (0.1, 0.2, 0.4, 0.8):
        source = spread * rng.normal(size=(200, count, 3))
        target = scale * source @ rotation.T + translation + 0.002 * rng.normal(size=source.shape)
        found = umeyama(
            jnp.asarray(source, jnp.float32), jnp.asarray(target, jnp.float32), jnp.ones((200, count), jnp.float32)
        )[0]
        errors.append(np.median([angle(r, rotation) for r in np.asarray(found)]))
    axis.loglog((0.1, 0.2, 0.4, 0.8), errors, "o-", label=f"{count} points")
axis.set(xlabel="spread of the points, diameters", ylabel="median rotation error, degrees", title="2 mm of noise")
axis.legend()
plt.show()

# %% [markdown]
# ## What it refuses
#
# Points on one line leave a turn about that line open. The numbers stay finite, and `success` says not to trust them.

# %%
line = np.linspace(0, 1, 3)[:, None] * np.array([[1.0, 2.0, 3.0]])
R_line, t_line, s_line, line_success = fit(line, scale * line @ rotation.T + translation)
print("three points on a line: determined:", bool(line_success), "finite:", bool(np.isfinite(R_line).all()))

# %%
assert angle(R, rotation) < 0.05 and abs(s - scale) < 1e-5 and np.abs(t - translation).max() < 1e-5
assert bool(success) and not bool(line_success) and np.isfinite(R_line).all()
