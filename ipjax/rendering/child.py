"""Renders one job with MuJoCo, in a process of its own; started by `mujoco_process`, never imported.

MuJoCo reads MUJOCO_GL when it is imported and a wrong value can abort the process, so the parent chooses it and only
this child runs GL. It needs NumPy and MuJoCo alone, to start fast. Arguments: the folder of the job. In: ``job.json``
and the arrays beside it. Out: ``rgb.npy``, ``depth.npy``, ``ids.npy``, and lines on standard output:
``ready`` when there is something to draw in, ``frame N`` after each, ``done``; or ``refused`` or ``error`` and why.
"""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's bindings declare their names at run time.)

import json
import sys
from pathlib import Path

import mujoco
import numpy as np


def sphere_points(count: int) -> np.ndarray:
    """Points spread over the unit sphere."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - height**2)
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=-1)


def build_model(folder: Path, job: dict) -> mujoco.MjModel:
    """A model whose geoms are the meshes of the job, in order, with exactly the vertices given."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth = job["width"] * job["oversample"]
    spec.visual.global_.offheight = job["height"] * job["oversample"]
    spec.visual.quality.offsamples = 0  # multisampling would blend depths at silhouettes
    arrays = [dict(np.load(folder / f"mesh{i}.npz")) for i in range(job["meshes"])]
    for i, mesh in enumerate(arrays):
        item = spec.add_mesh(name=f"mesh{i}")
        # The compiler measures a volume, which a flat or tiny mesh lacks: give it a ball of as many points instead.
        item.uservert = sphere_points(len(mesh["vertices"])).ravel().tolist()
        item.userface = mesh["faces"].ravel().tolist()
        item.usernormal = mesh["normals"].ravel().tolist()
        item.userfacenormal = mesh["faces"].ravel().tolist()
        item.usertexcoord = mesh["uv"].ravel().tolist()
        item.userfacetexcoord = mesh["uv_faces"].ravel().tolist()
        # Open and flat meshes have no volume, and the renderer asks for none.
        item.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        image = mesh["texture"]
        texture = spec.add_texture(
            name=f"texture{i}",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=image.shape[1],
            height=image.shape[0],
            nchannel=3,
        )
        texture.data = image.tobytes()
        material = spec.add_material(name=f"material{i}")
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"texture{i}"
        material.specular = 0.0
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{i}", material=f"material{i}", contype=0, conaffinity=0
        )
    model = spec.compile()
    # The compiler also moves every mesh into a frame of its own: vertices and normals are written again in ours.
    for i, mesh in enumerate(arrays):
        start, count = model.mesh_vertadr[i], model.mesh_vertnum[i]
        if count != len(mesh["vertices"]):
            raise RuntimeError(f"mesh {i}: MuJoCo kept {count} of {len(mesh['vertices'])} vertices")
        model.mesh_vert[start : start + count] = mesh["vertices"]
        start, count = model.mesh_normaladr[i], model.mesh_normalnum[i]
        if count != len(mesh["normals"]):
            raise RuntimeError(f"mesh {i}: MuJoCo kept {count} of {len(mesh['normals'])} normals")
        model.mesh_normal[start : start + count] = mesh["normals"]
    return model


def disable_mipmaps(context: mujoco.MjrContext, textures: list[int]) -> None:
    """Colour atlases must not be minified: coarser levels mix faces that are not neighbours on the surface."""
    from OpenGL import GL

    for index in textures:
        GL.glBindTexture(GL.GL_TEXTURE_2D, int(context.texture[index]))
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_LINEAR)


def set_light(scene: mujoco.MjvScene, light: dict | None) -> None:
    """One light: none = everything ambient, so that colours come out as they are in the texture."""
    scene.nlight = 1
    lamp = scene.lights[0]
    lamp.headlight = 0
    lamp.castshadow = 0
    lamp.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    lamp.attenuation[:] = (1, 0, 0)
    lamp.cutoff, lamp.exponent = 180, 0
    lamp.pos[:] = 0
    lamp.dir[:] = (0, 0, 1)
    lamp.ambient[:] = 1 if light is None else light["ambient"]
    lamp.diffuse[:] = 0 if light is None else light["diffuse"]
    lamp.specular[:] = 0


def set_camera(scene: mujoco.MjvScene, frustum: np.ndarray) -> None:
    """OpenCV axes are the world's: x right, y down, z ahead; the frustum is (left, right, bottom, top, near, far)."""
    left, right, bottom, top, near, far = (float(x) for x in frustum)
    for eye in (0, 1):  # a mono image uses the average of both
        camera = scene.camera[eye]
        camera.pos[:] = 0
        camera.forward[:] = (0, 0, 1)
        camera.up[:] = (0, -1, 0)
        camera.orthographic = 0
        camera.frustum_center, camera.frustum_width = (left + right) / 2, (right - left) / 2
        camera.frustum_bottom, camera.frustum_top = bottom, top
        camera.frustum_near, camera.frustum_far = near, far


def metric_depth(buffer: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth along z from the reversed depth buffer (1 at near, 0 at far); 0 where nothing was drawn."""
    raw = buffer.astype(np.float64)
    near, far = float(np.float32(near)), float(np.float32(far))
    return np.where(buffer > 0, near * far / (raw * (far - near) + near), 0.0)


def shrink(rgb: np.ndarray, covered: np.ndarray, factor: int) -> np.ndarray:
    """Mean colour of the covered samples of every pixel."""
    if factor == 1:
        return rgb * covered[..., None].astype(np.uint8)
    height, width = covered.shape[0] // factor, covered.shape[1] // factor
    shape = (height, factor, width, factor)
    weight = covered.reshape(shape).sum((1, 3), dtype=np.float32)[..., None]
    total = (rgb * covered[..., None]).reshape(*shape, 3).sum((1, 3), dtype=np.float32)
    return np.round(total / np.maximum(weight, 1)).astype(np.uint8)


def main(folder: Path) -> None:
    """Draw all frames of the job in the folder, and report progress to the parent on standard output."""
    job = json.loads((folder / "job.json").read_text())
    poses = np.load(folder / "poses.npy")  # frame, mesh, 3, 4
    frusta = np.load(folder / "frusta.npy")  # frame, 6
    frames, height, width, factor = len(poses), job["height"], job["width"], job["oversample"]
    rows, columns = height * factor, width * factor

    try:
        model = build_model(folder, job)
    except Exception as error:
        print("refused", f"{error}".replace("\n", " "), flush=True)
        sys.exit(1)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    gl = mujoco.GLContext(columns, rows)
    gl.make_current()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
    if context.currentBuffer != mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value:
        raise RuntimeError("no offscreen framebuffer")
    print("ready", flush=True)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    disable_mipmaps(context, job["atlases"])

    scene = mujoco.MjvScene(model, maxgeom=job["meshes"] + 8)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene)
    scene.flags[:] = 0  # no culling: reconstructed meshes have holes; no shadow, fog, sky, reflection
    set_light(scene, job["light"])
    # A frame lists only what it shows: meshes shrunk to a point would cost as much as the others.
    geoms = [scene.geoms[i] for i in range(scene.ngeom)]
    names = [name for name in ("dataid", "matid", "texid", "texcoord") if hasattr(geoms[0], name)]
    appearances = {geom.objid: [(name, getattr(geom, name)) for name in names] for geom in geoms}

    def output(name: str, dtype: str, *tail: int) -> np.memmap:
        return np.lib.format.open_memmap(
            folder / f"{name}.npy", mode="w+", dtype=np.dtype(dtype), shape=(frames, height, width, *tail)
        )

    rgb, depth = output("rgb", "u1", 3), output("depth", "f4")
    ids = output("ids", "i2") if job["segment"] else None
    rectangle = mujoco.MjrRect(0, 0, columns, rows)
    colours, reading = np.empty((rows, columns, 3), np.uint8), np.empty((rows, columns), np.float32)
    middle = slice(factor // 2, None, factor)  # the sample at the pixel's centre (factor is odd)
    segmenting = [mujoco.mjtRndFlag.mjRND_SEGMENT.value, mujoco.mjtRndFlag.mjRND_IDCOLOR.value]
    for frame in range(frames):
        set_camera(scene, frusta[frame])
        if job["light"] is not None:
            scene.lights[0].dir[:] = job["light"]["directions"][frame]
        shown = np.flatnonzero(poses[frame, :, :, :3].any((1, 2))).tolist()
        for slot, i in enumerate(shown):
            geom = scene.geoms[slot]
            for name, value in appearances[i]:
                setattr(geom, name, value)
            geom.mat[:] = poses[frame, i, :, :3]
            geom.pos[:] = poses[frame, i, :, 3]
            geom.segid = i
        scene.ngeom = len(shown)
        mujoco.mjr_render(rectangle, scene, context)
        mujoco.mjr_readPixels(colours, reading, rectangle, context)
        metric = metric_depth(reading[::-1], frusta[frame, 4], frusta[frame, 5])
        rgb[frame] = shrink(colours[::-1], metric > 0, factor)
        depth[frame] = metric[middle, middle]
        rgb[frame] *= (depth[frame] > 0)[..., None].astype(np.uint8)
        if ids is not None:
            scene.flags[segmenting] = 1
            mujoco.mjr_render(rectangle, scene, context)
            mujoco.mjr_readPixels(colours, None, rectangle, context)
            scene.flags[segmenting] = 0
            code = (colours[::-1].astype(np.int32) @ np.array([1, 256, 65536], np.int32))[middle, middle]
            ids[frame] = np.where(depth[frame] > 0, code - 1, -1)
        print("frame", frame + 1, flush=True)
    for array in (rgb, depth, ids):
        if array is not None:
            array.flush()
    print("done", mujoco.__version__, flush=True)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except Exception as error:  # the parent turns this line into its own sentence
        print("error", f"{type(error).__name__}: {error}".replace("\n", " "), flush=True)
        sys.exit(1)
