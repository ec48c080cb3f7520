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
# # What a cyclic distance sees
#
# A patch of the query goes to its nearest neighbour in the template, and that one to *its* nearest neighbour in the
# query. Where both views show the same thing the walk ends where it began. How far it ends from there is the cyclic
# distance, and it needs no threshold on similarities, which differ from object to object.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from ipjax_kernels.neighbours import cycle_distance, nearest

plt.rcParams["figure.dpi"] = 60
rng = np.random.default_rng(0)
side, channels = 24, 32

# %% [markdown]
# ## Two views of one surface
#
# The template shows a plane. The query shows the same plane turned by 15° and moved, and something stands before its
# right side. The features are a stand-in for an encoder's: smooth random waves over the surface, plus noise of each
# image's own.

# %%
rows, columns = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
grid = np.stack([columns, rows], -1).reshape(-1, 2).astype(np.float32)
middle = (side - 1) / 2
turn = np.radians(15)
spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
where = (grid - middle) @ spin.T + middle + [2.0, -1.0]  # the place in the template that a query patch shows
hidden = grid[:, 0] > 0.68 * side
outside = (where < 0).any(1) | (where > side - 1).any(1)

frequency, phase = rng.normal(0, 0.45, (2, channels)), rng.uniform(0, 2 * np.pi, channels)


def see(places, noise):
    """Unit-norm features of places on the surface."""
    waves = np.cos(places @ frequency + phase) + noise * rng.normal(size=(len(places), channels))
    return (waves / np.linalg.norm(waves, axis=-1, keepdims=True)).astype(np.float32)


template = see(grid, 0.25)
query = see(where, 0.25)
query[hidden] = see(rng.uniform(0, 200, (hidden.sum(), 2)), 0.25)  # of the thing in front

# %% [markdown]
# ## There and back

# %%
valid = jnp.ones(side * side, bool)
found = nearest(jnp.asarray(query), jnp.asarray(template)[None], valid, valid[None])
there, back = found.query_to_template[0], found.template_to_query[0]
distance = np.asarray(cycle_distance(there, back, jnp.asarray(grid), valid, valid))
error = np.linalg.norm(grid[np.asarray(there)] - where, axis=-1)  # of the match itself, which only we can know
similarity = np.asarray(found.query_similarity[0])

fig, axes = plt.subplots(1, 3, figsize=(10, 3.4))
pictures = (
    ("cosine of the match", similarity, None),
    ("cyclic distance, patches", distance, 8),
    ("true error", error, 8),
)
for axis, (title, values, top) in zip(axes, pictures, strict=True):
    image = axis.imshow(values.reshape(side, side), vmax=top)
    axis.contour(hidden.reshape(side, side), [0.5], colors="red", linewidths=1)
    axis.set_title(title)
    axis.axis("off")
    fig.colorbar(image, ax=axis, shrink=0.8)
plt.show()

# %% [markdown]
# Right of the red line the query shows something else, and its walks end anywhere. To the left they come home, save at
# the borders that the template does not show.
#
# ## Ranking pairs
#
# The paper keeps the K pairs of smallest distance. Very many are exactly zero, so distance alone ranks them no further
# and the sum of the K smallest says little about *which template* is right; the cosines decide among the short cycles.

# %%
seen = ~hidden & ~outside
short = distance <= 1.5
fig, axis = plt.subplots(figsize=(7, 3.5))
limits = (0, 0.5, 1.5, 2.5, 4, 8, 40)
labels, bars = [], []
for low, high in zip((-1, *limits), limits, strict=False):
    chosen = (distance > low) & (distance <= high)
    if chosen.any():
        labels.append(f"≤ {high:g}\n({chosen.sum()})")
        bars.append((error[chosen] <= 1.5).mean())
axis.bar(labels, bars)
axis.set(xlabel="cyclic distance, patches (how many)", ylabel="share of right matches", ylim=(0, 1))
plt.show()
print(f"{(distance == 0).sum()} of {len(distance)} cycles are exactly closed")
print(f"right matches: {(error <= 1.5).mean():.0%} of all, {(error[short] <= 1.5).mean():.0%} of the short cycles")

# %%
assert (error[short] <= 1.5).mean() > (error <= 1.5).mean() + 0.1
assert (error[short] <= 1.5).mean() > 0.85
assert (error[distance > 4] <= 1.5).mean() < 0.4
assert short[seen].mean() > 2 * short[hidden].mean()
