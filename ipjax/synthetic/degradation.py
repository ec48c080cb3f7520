"""Stand-ins for what single-view reconstruction does to a mesh, in four levels, the same on every machine.

All levels work on the normalised mesh (unit diameter) and end with a random rotation and scale, unknown to estimates:

1. three steps of Laplacian smoothing, bumps of 1 % of the diameter (rms), texture blurred with σ = 2 texels of 1024;
2. ten steps, bumps of 3 %, σ = 6;
3. the half behind the plane across the thinnest axis replaced by the mirrored front, vertices clustered on a grid of
   24 cells per diameter, colours per vertex and blurred (σ = 8), axes scaled by 1.0, 0.9, 1.1;
4. level 3 with bumps of 3 %, 10 % of the faces missing in patches, the mirrored back in the front's mean colour.

Where a number decides which vertices or faces exist, it is kept away from ties: the grid has a random offset, and what
lies within 1e-6 of the mirror is on it. So rounding, which differs between machines, cannot change the topology.
"""

import dataclasses

import numpy as np
from scipy import ndimage, sparse

from ipjax.files.meshes.mesh import Mesh, make_mesh, normalise, vertex_normals
from ipjax.files.meshes.textures import sample_texture
from ipjax.transforms import Similarity

STEPS = {1: 3, 2: 10}  # of smoothing
BUMPS = {1: 0.01, 2: 0.03, 3: 0.0, 4: 0.03}  # rms, diameters
BLUR = {1: 2.0, 2: 6.0, 3: 8.0, 4: 8.0}  # σ in texels of a texture 1024 wide
CELLS = 24  # per diameter
STRETCH = (1.0, 0.9, 1.1)
MISSING = 0.1  # share of the faces
PATCHES = 6
BUMP_LENGTH = 0.15  # width of the bumps, diameters
SMOOTHING = 0.5  # how far a vertex goes towards the mean of its neighbours


def alignment_as_json(original_from_degraded: Similarity[np.ndarray]) -> dict:
    """The similarity as alignment files hold it."""
    return {
        "comment": "x_original = scale * R @ x_degraded + t; for evaluation only",
        "scale": float(original_from_degraded.scale),
        "R": original_from_degraded.rotation.tolist(),
        "t": original_from_degraded.translation.tolist(),
    }


def degrade(mesh: Mesh, level: int, seed: int = 0) -> tuple[Mesh, Similarity[np.ndarray]]:
    """A degraded mesh, and ``original_from_degraded``, the similarity to the given mesh's frame, for evaluations only.

    The result is a mesh of its own: unknown scale (0.1 to 10 diameters) and rotation. Its `seen` is 0 on the half that
    was made up. Where the mesh has no texture, its vertex colours are blurred along its edges to the same width.
    Raises ValueError for a level that is not 1, 2, 3 or 4.
    """
    if level not in BLUR:
        raise ValueError(f"a level of degradation is 1, 2, 3 or 4, not {level!r}")
    random = np.random.Generator(np.random.PCG64([seed, level]))
    plain = dataclasses.replace(mesh, scale=1.0, centre=(0.0, 0.0, 0.0))
    unit = normalise(plain)
    welded = _weld(unit)
    if level <= 2:
        vertices = _smooth(welded, STEPS[level])
        worse = dataclasses.replace(unit, vertices=vertices[welded.place], normals=unit.normals)
        worse = _blur(worse, welded, BLUR[level])
        worse = roughen(worse, BUMPS[level], random)
    else:
        worse = _blur(unit, welded, BLUR[level])
        if worse.texture is not None and worse.uv is not None:
            worse = dataclasses.replace(worse, colours=sample_texture(worse.texture, worse.uv), texture=None, uv=None)
        worse = _mirror(worse, random)
        if level == 4:
            back = worse.seen < 0.5
            colours = worse.colours.copy()
            colours[back] = np.round(worse.colours[~back].astype(np.float64).mean(0)).astype(np.uint8)
            worse = dataclasses.replace(worse, colours=colours)
        worse = _cluster(worse, random)
        worse = roughen(worse, BUMPS[level], random)
        worse = dataclasses.replace(worse, vertices=worse.vertices * np.array(STRETCH))
        if level == 4:
            worse = _remove_patches(worse, random)
    # Uniform rotation from a normal quaternion; the scale is uniform in its logarithm.
    w, x, y, z = _unit_vector(random.standard_normal(4))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    scale = float(10 ** random.uniform(-1, 1))
    vertices = scale * worse.vertices @ rotation.T
    result = make_mesh(
        vertices,
        worse.faces,
        colours=worse.colours,
        uv=worse.uv,
        texture=worse.texture,
        seen=worse.seen,
        notes=(f"degraded to level {level}, seed {seed}",),
    )
    degraded_from_unit = Similarity(rotation, np.zeros(3), np.asarray(scale))
    original_from_unit = Similarity(np.eye(3), np.asarray(unit.centre, np.float64), np.asarray(1 / unit.scale))
    return result, original_from_unit @ degraded_from_unit.inverse()


@dataclasses.dataclass(frozen=True)
class _Welded:
    """The mesh with coinciding vertices merged, so that they move as one and no seam opens."""

    place: np.ndarray  # of every vertex
    vertices: np.ndarray  # one per place
    average: sparse.csr_array  # mean over the neighbours of every place


def _weld(mesh: Mesh) -> _Welded:
    # 1e-6 of the diameter, on a grid with an offset, so that no cell begins at a plane of symmetry.
    key = np.floor(mesh.vertices * 1e6 + 0.41421356).astype(np.int64)
    place = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)
    count = int(place.max()) + 1
    vertices = np.zeros((count, 3))
    vertices[place[::-1]] = mesh.vertices[::-1]  # the first of each
    corners = place[mesh.faces]
    a = np.concatenate([corners[:, [0, 1, 2]].ravel(), corners[:, [1, 2, 0]].ravel()])
    b = np.concatenate([corners[:, [1, 2, 0]].ravel(), corners[:, [0, 1, 2]].ravel()])
    proper = a != b
    links = sparse.coo_array((np.ones(int(proper.sum())), (a[proper], b[proper])), (count, count)).tocsr()
    links.data[:] = 1
    degree = np.asarray(links.sum(1)).reshape(-1)
    isolated = sparse.diags_array((degree == 0).astype(np.float64))
    average = sparse.diags_array(1 / np.maximum(degree, 1)) @ links + isolated
    return _Welded(place, vertices, average.tocsr())


def _smooth(welded: _Welded, steps: int) -> np.ndarray:
    vertices = welded.vertices
    for _ in range(steps):
        vertices = vertices + SMOOTHING * (welded.average @ vertices - vertices)
    return vertices


def roughen(mesh: Mesh, amplitude: float, random: np.random.Generator) -> Mesh:
    """Move vertices along their normals by a smooth random field of the given rms."""
    waves = 64
    frequency = random.standard_normal((waves, 3)) / BUMP_LENGTH
    phase = random.uniform(0, 2 * np.pi, waves)
    if amplitude == 0:
        return mesh
    field = np.cos(mesh.vertices @ frequency.T + phase).sum(1)
    field = field - field.mean()
    field = field * (amplitude / np.sqrt((field * field).mean()))
    normals = vertex_normals(mesh.vertices, mesh.faces)
    return dataclasses.replace(mesh, vertices=mesh.vertices + field[:, None] * normals)


def _blur(mesh: Mesh, welded: _Welded, sigma: float) -> Mesh:
    """Blur the texture by `sigma` texels of 1024, or the vertex colours by the same share of the diameter."""
    if mesh.texture is not None:
        width = sigma * mesh.texture.shape[1] / 1024
        image = ndimage.gaussian_filter(mesh.texture.astype(np.float64), (width, width, 0), mode="nearest")
        return dataclasses.replace(mesh, texture=np.round(image).astype(np.uint8))
    count = len(welded.vertices)
    colours = np.stack([np.bincount(welded.place, mesh.colours[:, i], count) for i in range(3)], axis=-1)
    colours /= np.bincount(welded.place, minlength=count)[:, None]
    corners = welded.vertices[welded.place[mesh.faces]]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    # A half step spreads a colour by a variance of a quarter of the squared edge along each direction in the surface.
    steps = int(np.clip(np.round((sigma / 1024) ** 2 / (0.25 * float((edges**2).mean()))), 1, 200))
    for _ in range(steps):
        colours = colours + SMOOTHING * (welded.average @ colours - colours)
    return dataclasses.replace(mesh, colours=np.round(colours).astype(np.uint8)[welded.place])


def _mirror(mesh: Mesh, random: np.random.Generator) -> Mesh:
    """Keep one half of the mesh, cut across its thinnest axis, and put its mirror image in place of the other."""
    extents = np.ptp(mesh.vertices, axis=0)
    axis = int(np.flatnonzero(extents <= extents.min() * (1 + 1e-6))[0])
    side = 1.0 if random.integers(2) else -1.0
    height = side * mesh.vertices[:, axis]
    height = np.where(np.abs(height) < 1e-6, 0.0, height)
    vertices, colours = [mesh.vertices], [mesh.colours.astype(np.float64)]
    above = height > 0
    faces = [mesh.faces[(height[mesh.faces] >= 0).all(1) & above[mesh.faces].any(1)]]
    crossing = mesh.faces[above[mesh.faces].any(1) & (height[mesh.faces] < 0).any(1)]
    total = len(mesh.vertices)
    for one_above in (True, False):
        # Turn every triangle so that its first corner is the only one above (True), or the only one below (False).
        many = above[crossing].sum(1)
        chosen = crossing[(many == 1) == one_above]
        single = above[chosen] if one_above else ~above[chosen]
        turn = (single.argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(chosen, turn, axis=1).T
        cuts = []
        for other in (b, c):
            t = (height[a] / (height[a] - height[other]))[:, None]
            vertices.append(mesh.vertices[a] + t * (mesh.vertices[other] - mesh.vertices[a]))
            colours.append(mesh.colours[a] + t * (mesh.colours[other].astype(np.float64) - mesh.colours[a]))
            cuts.append(total + np.arange(len(a)))
            total += len(a)
        if one_above:
            faces.append(np.stack([a, cuts[0], cuts[1]], axis=-1))
        else:
            faces.append(np.stack([cuts[0], b, c], axis=-1))
            faces.append(np.stack([cuts[0], c, cuts[1]], axis=-1))
    points, paint, front = np.concatenate(vertices), np.concatenate(colours), np.concatenate(faces)
    used, index = np.unique(front, return_inverse=True)
    points, paint, front = points[used], paint[used], index.reshape(-1, 3)
    on_plane = np.abs(points[:, axis]) < 1e-6
    points[on_plane, axis] = 0.0
    reflected = points.copy()
    reflected[:, axis] *= -1
    n = len(points)
    paint = np.round(np.concatenate([paint, paint])).astype(np.uint8)
    return make_mesh(
        np.concatenate([points, reflected]),
        np.concatenate([front, front[:, ::-1] + n]),
        colours=paint,
        seen=np.concatenate([np.ones(n), np.zeros(n)]),
    )


def _cluster(mesh: Mesh, random: np.random.Generator) -> Mesh:
    """Merge all vertices of a cell of the grid into their mean, and drop the faces that collapse."""
    cell = np.floor(mesh.vertices * CELLS + random.uniform(0, 1, 3)).astype(np.int64)
    number = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)
    count = int(number.max()) + 1
    size = np.bincount(number, minlength=count)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(number, values[:, i], count) for i in range(values.shape[1])], -1) / size[:, None]

    faces = number[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # Of faces that fell together, in either winding, the first stays.
    first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    faces = faces[np.sort(first)]
    used, index = np.unique(faces, return_inverse=True)
    return make_mesh(
        mean(mesh.vertices)[used],
        index.reshape(-1, 3),
        colours=np.round(mean(mesh.colours.astype(np.float64))[used]).astype(np.uint8),
        seen=mean(mesh.seen[:, None])[used, 0],
    )


def _remove_patches(mesh: Mesh, random: np.random.Generator) -> Mesh:
    """Remove a tenth of the faces: those nearest to a few random places of the surface."""
    middle = mesh.vertices[mesh.faces].mean(1)
    places = middle[random.integers(0, len(middle), PATCHES)]
    nearest = ((middle[:, None] - places[None]) ** 2).sum(-1).min(1)
    keep = np.ones(len(middle), bool)
    keep[np.argsort(nearest, kind="stable")[: round(MISSING * len(middle))]] = False
    used, index = np.unique(mesh.faces[keep], return_inverse=True)
    return make_mesh(mesh.vertices[used], index.reshape(-1, 3), colours=mesh.colours[used], seen=mesh.seen[used])


def _unit_vector(values: np.ndarray) -> np.ndarray:
    return values / np.sqrt((values * values).sum())
