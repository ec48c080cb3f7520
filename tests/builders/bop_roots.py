"""BOP data sets written from the golden numbers, for the tests of reading and scoring."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ipjax.bop.dataset import Dataset
from ipjax.bop.records import Estimate
from ipjax.bop.results import ResultRow, as_row

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
ERRORS = np.load(GOLDEN / "bop_pose_errors.npz")
PROTOCOL = np.load(GOLDEN / "bop_protocol.npz")


def write_models(root: Path) -> None:
    """The four golden meshes as ``models_eval``."""
    folder = root / "models_eval"
    folder.mkdir(parents=True)
    infos = {}
    for number in (1, 2, 3, 4):
        infos[str(number)] = json.loads(str(ERRORS[f"obj{number}_info_json"]))
        points, faces = ERRORS[f"obj{number}_pts"], ERRORS[f"obj{number}_faces"]
        head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
        head += [f"property float {axis}" for axis in "xyz"]
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
        body = [" ".join(repr(float(x)) for x in p) for p in points] + [f"3 {a} {b} {c}" for a, b, c in faces]
        (folder / f"obj_{number:06d}.ply").write_text("\n".join(head + body) + "\n")
    (folder / "models_info.json").write_text(json.dumps(infos))


def write_protocol(root: Path, copies: int = 1) -> Path:
    """The golden protocol as a data set without images; ``camera.json`` says how large they are. Of several ``copies``
    each has scenes of its own, 100 further on."""
    write_models(root)
    width, height = (int(x) for x in ERRORS["im_size_wh"])
    (root / "camera.json").write_text(json.dumps({"width": width, "height": height}))
    truths: dict = {}
    infos: dict = {}
    order = np.lexsort((PROTOCOL["gt_id"], PROTOCOL["gt_im"], PROTOCOL["gt_scene"]))
    for i in order:
        scene, image = int(PROTOCOL["gt_scene"][i]), str(PROTOCOL["gt_im"][i])
        truths.setdefault(scene, {}).setdefault(image, []).append(
            {
                "obj_id": int(PROTOCOL["gt_obj"][i]),
                "cam_R_m2c": PROTOCOL["gt_R"][i].astype(float).ravel().tolist(),
                "cam_t_m2c": PROTOCOL["gt_t"][i].astype(float).ravel().tolist(),
            }
        )
        infos.setdefault(scene, {}).setdefault(image, []).append({"visib_fract": float(PROTOCOL["gt_visib"][i])})
    camera = {"cam_K": ERRORS["K"].ravel().tolist(), "depth_scale": 0.1}
    names = ("scene_id", "im_id", "obj_id", "inst_count")
    rows = PROTOCOL["targets"].tolist()
    for copy in range(1, copies):
        rows += [[scene + 100 * copy, *rest] for scene, *rest in PROTOCOL["targets"].tolist()]
        for scene in [s for s in truths if s < 100]:
            truths[scene + 100 * copy], infos[scene + 100 * copy] = truths[scene], infos[scene]
    for scene in truths:
        folder = root / "test" / f"{scene:06d}"
        folder.mkdir(parents=True)
        (folder / "scene_gt.json").write_text(json.dumps(truths[scene]))
        (folder / "scene_gt_info.json").write_text(json.dumps(infos[scene]))
        (folder / "scene_camera.json").write_text(json.dumps(dict.fromkeys(truths[scene], camera)))
    targets = [dict(zip(names, row, strict=True)) for row in rows]
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    return root


def make_scene(root: Path, scene: int) -> Path:
    """The folder of a scene, with those of its images."""
    folder = root / "test" / f"{scene:06d}"
    for kind in ("rgb", "depth", "mask_visib"):
        (folder / kind).mkdir(parents=True)
    return folder


def write_images(root: Path, scenes: int = 1, images: int = 4) -> Path:
    """A small data set with images: object 2 and object 3 in each, 64 × 48 pixels, random colours, a flat depth."""
    from PIL import Image

    write_models(root)
    random = np.random.default_rng(0)
    targets = []
    for scene in range(scenes):
        folder = make_scene(root, scene)
        camera, truth = {}, {}
        for image in range(images):
            camera[str(image)] = {"cam_K": [100.0, 0, 32, 0, 100.0, 24, 0, 0, 1], "depth_scale": 0.5}
            truth[str(image)] = []
            for index, obj in enumerate((2, 3)):
                turn = ERRORS["R_gt"][image * 2 + index].astype(float)
                shift = [150.0 * index - 75, 10.0 * image, 700.0]
                truth[str(image)].append({"obj_id": obj, "cam_R_m2c": turn.ravel().tolist(), "cam_t_m2c": shift})
                mask = np.zeros((48, 64), np.uint8)
                mask[14:34, 2 + 30 * index : 30 + 30 * index] = 255
                Image.fromarray(mask).save(folder / "mask_visib" / f"{image:06d}_{index:06d}.png")
                targets.append({"scene_id": scene, "im_id": image, "obj_id": obj, "inst_count": 1})
            rgb = random.integers(0, 255, (48, 64, 3), np.uint8)
            Image.fromarray(rgb).save(folder / "rgb" / f"{image:06d}.png")
            Image.fromarray(np.full((48, 64), 1400, np.uint16)).save(folder / "depth" / f"{image:06d}.png")
        (folder / "scene_camera.json").write_text(json.dumps(camera))
        (folder / "scene_gt.json").write_text(json.dumps(truth))
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    return root


def write_annotated(root: Path, golden: Mapping[str, np.ndarray]) -> Path:
    """The instances of the golden detections as a data set of one scene, 5: masks of what is visible, boxes of the
    whole silhouettes in scene_gt_info.json, and targets of 2024, which name no objects."""
    from PIL import Image

    write_models(root)
    folder = make_scene(root, 5)
    images = sorted({int(image) for name in ("gt_image", "det_image") for image in golden[name]})
    truths: dict[str, list] = {str(image): [] for image in images}
    infos: dict[str, list] = {str(image): [] for image in images}
    masks = np.unpackbits(golden["gt_mask"], axis=-1)
    for image, obj, visib, box, mask in zip(
        *(golden[f"gt_{name}"] for name in ("image", "obj", "visib", "box")), masks, strict=True
    ):
        mine = truths[str(image)]
        Image.fromarray(mask * np.uint8(255)).save(folder / "mask_visib" / f"{image:06d}_{len(mine):06d}.png")
        mine.append({"obj_id": int(obj), "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 700]})
        infos[str(image)].append({"visib_fract": float(visib), "bbox_obj": box.tolist()})
    camera = {"cam_K": [100.0, 0, 32, 0, 100.0, 24, 0, 0, 1], "depth_scale": 0.5}
    (folder / "scene_gt.json").write_text(json.dumps(truths))
    (folder / "scene_gt_info.json").write_text(json.dumps(infos))
    (folder / "scene_camera.json").write_text(json.dumps(dict.fromkeys(truths, camera)))
    (root / "camera.json").write_text(json.dumps({"width": 64, "height": 48}))
    targets = [{"scene_id": 5, "im_id": image} for image in images]
    (root / "test_targets_bop24.json").write_text(json.dumps(targets))
    return root


def write_ellipsoids(root: Path, scenes: int = 2, images: int = 3, side: int = 112) -> Path:
    """A data set of exact images of the coloured ellipsoid of `problems`, alone in each, with its mesh as the model."""
    import jax.numpy as jnp
    import trimesh
    from PIL import Image

    from ipjax.records import Similarity
    from ipjax.synthetic.problems import AXES, make_view, random_rotation

    size = 200.0  # mm
    ball = trimesh.creation.icosphere(subdivisions=4)
    points, colours = size * ball.vertices * AXES, np.round(255 * (0.5 + 0.45 * ball.vertices)).astype(int)
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    head += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    head += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
    body = [f"{x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(points, colours, strict=True)]
    body += [f"3 {a} {b} {c}" for a, b, c in ball.faces]
    for folder in ("models", "models_eval"):
        (root / folder).mkdir(parents=True)
        (root / folder / "obj_000001.ply").write_text("\n".join(head + body) + "\n")
        (root / folder / "models_info.json").write_text(json.dumps({"1": {"diameter": size}}))
    random, targets = np.random.default_rng(3), []
    for scene in range(scenes):
        folder = make_scene(root, scene)
        camera, truth = {}, {}
        for image in range(images):
            rotation, shift = random_rotation(random), np.array([*random.uniform(-0.1, 0.1, 2), 0.7])
            pose = Similarity(jnp.asarray(rotation), jnp.asarray(shift), jnp.asarray(size / 1000))
            view = make_view(pose, side, fill=0.6)
            (fx, fy), (cx, cy) = np.asarray(view.camera.focal).tolist(), np.asarray(view.camera.centre).tolist()
            Image.fromarray(np.round(255 * np.asarray(view.rgb)).astype(np.uint8)).save(
                folder / "rgb" / f"{image:06d}.png"
            )
            depth = np.round(np.asarray(view.depth) * 10_000).astype(np.uint16)
            Image.fromarray(depth).save(folder / "depth" / f"{image:06d}.png")
            mask = np.asarray(view.mask).astype(np.uint8) * 255
            Image.fromarray(mask).save(folder / "mask_visib" / f"{image:06d}_000000.png")
            camera[str(image)] = {"cam_K": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "depth_scale": 0.1}
            pose_mm = {"cam_R_m2c": rotation.ravel().tolist(), "cam_t_m2c": (1000 * shift).tolist()}
            truth[str(image)] = [{"obj_id": 1, **pose_mm}]
            targets.append({"scene_id": scene, "im_id": image, "obj_id": 1, "inst_count": 1})
        (folder / "scene_camera.json").write_text(json.dumps(camera))
        (folder / "scene_gt.json").write_text(json.dumps(truth))
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    return root


def protocol_rows() -> list[ResultRow]:
    """The estimates of the golden protocol."""
    columns = [PROTOCOL[f"est_{name}"].tolist() for name in ("scene", "im", "obj", "score")]
    places = zip(*columns, PROTOCOL["est_R"].astype(float), PROTOCOL["est_t"].astype(float), strict=True)
    return [ResultRow(s, i, o, c, tuple(R.ravel()), tuple(t)) for s, i, o, c, R, t in places]


def true_rows(dataset: Dataset) -> list[ResultRow]:
    """The annotated poses of all targets as rows."""
    rows = []
    for (scene, image), targets in dataset.targets_by_image().items():
        for truth in dataset.truths(scene, image):
            if truth.obj_id in {t.obj_id for t in targets}:
                estimate = Estimate(truth.obj_id, truth.visible, truth.rotation, truth.translation)
                rows.append(as_row(scene, image, estimate, 0.5))
    return rows
