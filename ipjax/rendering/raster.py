"""Our own z-buffer as a renderer: slower than a GL library, and the same on every machine."""

from collections.abc import Callable

import numpy as np

from ipjax.cameras import resize
from ipjax.files.meshes.textures import sample_texture
from ipjax.rendering.job import Job, Renders


def draw_raster(job: Job, progress: Callable[[int, int], None] | None) -> Renders:
    """All frames of a job, one after another, on JAX's device."""
    import jax
    import jax.numpy as jnp
    from ipjax_kernels.rasterize import rasterize

    factor = job.oversample
    height, width = job.height * factor, job.width * factor
    vertices = np.concatenate([mesh.vertices for mesh in job.meshes])
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in job.meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(job.meshes, starts[:-1], strict=True)])
    owner_vertex = np.repeat(np.arange(len(job.meshes)), np.diff(starts))
    owner = owner_vertex[faces[:, 0]]
    textured = np.array([mesh.texture is not None for mesh in job.meshes])
    near = job.near_far()[:, 0]
    shape = (len(job.poses), job.height, job.width)
    rgb, depth, ids = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.full(shape, -1, np.int16)
    middle = slice(factor // 2, None, factor)
    device_faces = jnp.asarray(faces, jnp.int32)
    for frame, (pose, intrinsics) in enumerate(zip(job.poses, job.intrinsics, strict=True)):
        moved = np.einsum("nij,nj->ni", pose[owner_vertex, :, :3], vertices) + pose[owner_vertex, :, 3]
        camera = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
        camera = resize(camera, (job.width, job.height), (width, height))
        drawn = rasterize(
            jnp.asarray(moved, jnp.float32),
            device_faces,
            jnp.asarray(camera[[0, 1], [0, 1]], jnp.float32),
            jnp.asarray(camera[:2, 2], jnp.float32),
            height,
            width,
            near=jnp.asarray(near[frame], jnp.float32),
        )
        metric, index, weights = (np.asarray(x) for x in jax.block_until_ready(drawn))
        covered = index >= 0
        face, weight = index[covered], weights[covered].astype(np.float64)
        corners = faces[face]
        pixels = np.zeros((len(face), 3), np.float64)
        for i, mesh in enumerate(job.meshes):
            mine = owner[face] == i
            local = corners[mine] - starts[i]
            if textured[i] and mesh.uv is not None and mesh.texture is not None:
                pixels[mine] = sample_texture(mesh.texture, np.einsum("kc,kci->ki", weight[mine], mesh.uv[local]))
            else:
                pixels[mine] = np.einsum("kc,kci->ki", weight[mine], mesh.colours[local].astype(np.float64))
            if job.light is not None:
                normals = np.einsum("kc,kci->ki", weight[mine], mesh.normals[local]) @ pose[i, :, :3].T
                direction = job.light_directions[frame]
                length = np.maximum(np.linalg.norm(normals, axis=-1), 1e-12)
                shade = job.light.get("diffuse", 0.5) * np.maximum(-(normals @ direction) / length, 0)
                pixels[mine] *= np.minimum(job.light.get("ambient", 0.5) + shade, 1)[:, None]
        colours = np.zeros((height, width, 3), np.float32)
        colours[covered] = pixels
        total = colours.reshape(job.height, factor, job.width, factor, 3).sum((1, 3))
        count = covered.reshape(job.height, factor, job.width, factor).sum((1, 3))
        depth[frame] = metric[middle, middle] * job.scales[frame]
        seen = depth[frame] > 0
        rgb[frame] = np.round(total / np.maximum(count, 1)[..., None]) * seen[..., None]
        ids[frame] = np.where(seen, owner[np.maximum(index[middle, middle], 0)], -1)
        if progress is not None:
            progress(frame + 1, len(job.poses))
    return Renders(rgb=rgb, depth=depth, camera=job.cameras, backend="raster", ids=ids if job.segment else None)
