"""Targets of a run drawn over their photos: outlines where the object is and where it was estimated, and its model."""

import math
from typing import Any

import numpy as np

from benchmarks.results_page.runs import Study
from ipjax.files.pages import embed_image
from ipjax.transforms import Similarity


def pictures(study: Study, side: int = 260) -> list[tuple[str, str]]:
    """Captions and data URLs of the best, median and worst targets (by MSSD of what was found): outlines on the photo,
    and the model at the estimate."""
    import cv2

    from ipjax.bop.dataset import Dataset
    from ipjax.bop.records import MM
    from ipjax.bop.results import read_results
    from ipjax.inference.drawing import silhouette

    run = study.main
    dataset = Dataset(study.data, run["dataset"].rsplit("-", 1)[1], models=study.models)
    diameters = {obj: info.diameter for obj, info in dataset.models().items()}
    error = lambda i: math.inf if i["mssd"] is None else i["mssd"] / diameters[i["obj_id"]]
    ranked = sorted((i for i in run["instances"] if i["found"]), key=error)
    if not ranked:
        return []
    middle = len(ranked) // 2
    if len(ranked) < 9:
        chosen = [(f"{k} of {len(ranked)}", i) for k, i in enumerate(ranked, start=1)]
    else:
        chosen = [("best", i) for i in ranked[:3]]
        chosen += [("median", i) for i in ranked[middle - 1 : middle + 2]]
        chosen += [("worst", i) for i in ranked[-3:][::-1]]
    kept = run["folder"] / f"{run['method'].replace('_', '-')}_{run['dataset']}.csv"
    rows = {(r.scene_id, r.im_id, r.obj_id, r.score): r for r in read_results(kept)}
    drawn = draw_models(study, [one for _, one in chosen], rows)
    found = []
    for (kind, one), model in zip(chosen, drawn, strict=True):
        place = (one["scene_id"], one["im_id"], one["obj_id"])
        frame, mesh, row = dataset.frame(*place[:2]), dataset.mesh(place[2]), rows[*place, one["score"]]
        truth = next(t for t in dataset.truths(*place[:2]) if t.index == one["index"])
        shapes = [
            silhouette(pose @ mesh.vertices, mesh.faces, frame.camera, *frame.rgb.shape[:2])
            for pose in (row_pose(truth), row_pose(row, MM))
        ]
        box = square_around(shapes[0] | shapes[1])
        photo = resize(cut(frame.rgb, box), side)
        for shape, colour in zip(shapes, ((40, 220, 90), (235, 50, 60)), strict=True):
            enlarged = resize(cut(shape.astype(np.uint8) * 255, box), side, smooth=True) > 127
            outline, _ = cv2.findContours(enlarged.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(photo, outline, -1, colour, 3 if colour[0] < 100 else 1, cv2.LINE_AA)
        grey = (0.35 * frame.rgb.mean(-1, keepdims=True) + 120).astype(np.uint8)
        rendered = np.where(model.any(-1, keepdims=True), model, np.repeat(grey, 3, axis=-1))
        both = np.concatenate([photo, resize(cut(rendered, box), side)], axis=1)
        off = f"{100 * error(one):.0f} % of the diameter" if math.isfinite(error(one)) else "more than a diameter"
        caption = (
            f"{kind}: scene {place[0]}, image {place[1]}, object {place[2]}; MSSD {off}, rotation "
            f"{math.degrees(one['rotation']):.0f}°, translation {one['translation'] / MM:.0f} mm"
        )
        found.append((caption, embed_image(both, "jpg", 80)))
    return found


def row_pose(row: Any, unit: float = 1.0) -> Similarity[np.ndarray]:
    """``camera_from_model`` in metres of an annotation, or of a line of a result file; ``unit``: metres in its unit."""
    rotation = np.reshape(np.asarray(row.rotation, np.float64), (3, 3))
    return Similarity(rotation, np.asarray(row.translation, np.float64) * unit, np.ones(()))


def draw_models(study: Study, chosen: list[dict], rows: dict) -> list[np.ndarray]:
    """The scanned model of each target at its estimate, on black: outlines cannot tell a front from a back."""
    import jax

    from ipjax.bop.dataset import Dataset
    from ipjax.bop.records import MM
    from ipjax.records import Camera
    from ipjax.rendering.render import render_each

    dataset = Dataset(study.data, study.main["dataset"].rsplit("-", 1)[1], models=study.models)
    pictures: list[np.ndarray] = [np.zeros(0)] * len(chosen)
    by_size: dict[tuple[int, int], list[int]] = {}
    for i, one in enumerate(chosen):
        by_size.setdefault(dataset.image_size(one["scene_id"], one["im_id"]), []).append(i)
    for (width, height), mine in by_size.items():
        objects = sorted({chosen[i]["obj_id"] for i in mine})
        poses, cameras = [], []
        for i in mine:
            one = chosen[i]
            poses.append(row_pose(rows[one["scene_id"], one["im_id"], one["obj_id"], one["score"]], MM))
            cameras.append(dataset.camera(one["scene_id"], one["im_id"])[0])
        K = np.stack(cameras)
        drawn = render_each(
            [dataset.mesh(obj, "models") for obj in objects],
            [objects.index(chosen[i]["obj_id"]) for i in mine],
            jax.tree.map(lambda *x: np.stack(x), *poses).to_jax(),
            Camera.from_matrix(K),
            height,
            width,
        )
        for i, rgb, mask in zip(mine, drawn.rgb, drawn.mask, strict=True):
            pictures[i] = np.maximum(rgb, 1) * mask[..., None]  # black parts of the object are no background
    return pictures


def square_around(covered: np.ndarray) -> tuple[int, int, int]:
    """Top, left and side of a square around what is covered, with a margin; it may reach out of the image."""
    y, x = np.nonzero(covered) if covered.any() else (np.array([0, covered.shape[0] - 1]),) * 2
    half = int(max(np.ptp(x), np.ptp(y)) * 0.6) + 10
    return (int(y.min()) + int(y.max())) // 2 - half, (int(x.min()) + int(x.max())) // 2 - half, 2 * half


def cut(image: np.ndarray, box: tuple[int, int, int]) -> np.ndarray:
    """The square of an image, black where it reaches out."""
    top, left, side = box
    result = np.zeros((side, side, *image.shape[2:]), image.dtype)
    inside = image[max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)]
    down, across = max(-top, 0), max(-left, 0)
    result[down : down + inside.shape[0], across : across + inside.shape[1]] = inside
    return result


def resize(image: np.ndarray, side: int, *, smooth: bool = False) -> np.ndarray:
    """A square image of another size."""
    import cv2

    way = cv2.INTER_AREA if len(image) > side and not smooth else cv2.INTER_LINEAR
    return np.ascontiguousarray(cv2.resize(image, (side, side), interpolation=way))
