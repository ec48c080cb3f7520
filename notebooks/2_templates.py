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
# # A mesh becomes templates
#
# An object is onboarded once: it is rendered from everywhere, and every patch of every picture is lifted to the 3-D
# point of the object that it shows. From then on no mesh is needed to find it.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial import cKDTree

from ipjax.estimation.features import lift
from ipjax.files.meshes.sampling import sample_surface
from ipjax.onboarding.mesh import framing_cameras
from ipjax.onboarding.viewpoints import viewpoints
from ipjax.rendering.render import render
from ipjax.synthetic.objects import make_object

plt.rcParams["figure.dpi"] = 60
mesh = make_object("mug", 1)
print(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces, sides {np.ptp(mesh.vertices, axis=0).round(3)}")

# %% [markdown]
# ## Where to look from
#
# Directions are spread evenly over the sphere (a Fibonacci spiral), and each is rolled about its own axis: features of
# a vision transformer are not the same upside down, so an upside-down object wants an upside-down template.

# %%
poses = viewpoints(6, 2)
cameras = framing_cameras(mesh.vertices, poses, 112, 0.83)
views = render(mesh, poses, cameras, 112, 112)
print(f"{len(views)} views, drawn by {views.backend}")

fig, axes = plt.subplots(2, 6, figsize=(9, 3.2))
for index, axis in enumerate(axes.T.ravel()):
    axis.imshow(views.rgb[index])
    axis.axis("off")
fig.suptitle("six directions, two rolls of each")
plt.show()

# %% [markdown]
# ## From a patch to a point
#
# `lift` takes the object's pixels in a patch, drops those whose depth is far from the median (at a fold, the mean would
# lie on neither surface), and averages the rest. The camera's pose then carries the point into the object's frame.

# %%
patch = 8
rows = columns = 112 // patch
points, owners = [], []
for index in range(len(views)):
    in_camera, cover = lift(views[index], rows, columns, 0.05)
    rotation, translation = np.asarray(poses.rotation[index]), np.asarray(poses.translation[index])
    in_object = (np.asarray(in_camera) - translation) @ rotation
    keep = np.asarray(cover) >= 0.3
    points.append(in_object[keep])
    owners.append(np.full(keep.sum(), index))
points, owners = np.concatenate(points), np.concatenate(owners)

fig = plt.figure(figsize=(8, 4))
for column, (title, colour) in enumerate((("by height", points[:, 2]), ("by view", owners))):
    axis = fig.add_subplot(1, 2, column + 1, projection="3d")
    axis.scatter(*points.T, c=colour, s=4, cmap="viridis" if column == 0 else "tab20")
    axis.set_title(f"{len(points)} patches, coloured {title}")
    axis.set_box_aspect((1, 1, 1))
plt.show()

# %% [markdown]
# Every view has put its patches on the same object: how far are they from its surface?

# %%
surface = np.asarray(sample_surface(mesh, 20000, seed=0)[0])
distance = cKDTree(surface).query(points)[0]
print(f"median {np.median(distance):.4f}, 95 % below {np.quantile(distance, 0.95):.4f} diameters")
reach = jnp.asarray(points).max(0) - jnp.asarray(points).min(0)
print("extent of the patches", np.asarray(reach).round(2), "and of the mesh", np.ptp(mesh.vertices, axis=0).round(2))

# %%
assert np.median(distance) < 0.01 and np.quantile(distance, 0.95) < 0.04
assert (np.abs(np.asarray(reach) - np.ptp(mesh.vertices, axis=0)) < 0.12).all()
