"""Makes coco_detections.npz: made-up detections, and what pycocotools (2.0.11) scores them with BOP's rule of ignoring.

    pip install pycocotools && python make_coco.py

Annotated instances (``gt_``): image, obj, visib (share that is visible), box (x, y, width, height of the whole
silhouette), mask (of what is visible; packed bits of 48 × 64). Detections (``det_``): image, obj, score (with ties),
box, mask.
``bbox_`` and ``segm_``: stats (AP, AP50, AP75, AR100) and ap, of each object (−1: nothing of it is to be found).
"""

from pathlib import Path

import numpy as np
from pycocotools import mask as codec
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

HEIGHT, WIDTH, IMAGES, OBJECTS = 48, 64, 24, (1, 2, 3, 4)


class BopEval(COCOeval):
    """BOP reads the annotations' own ``ignore``, as https://github.com/MartinSmeyer/cocoapi does."""

    def _prepare(self):
        kept = {number: one.get("ignore", False) for number, one in self.cocoGt.anns.items()}
        super()._prepare()
        for annotations in self._gts.values():
            for one in annotations:
                one["ignore"] = kept[one["id"]]


def draw(rng, box):
    """An ellipse in a box, as a mask."""
    x, y, w, h = box
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return ((columns - x - w / 2) / (w / 2)) ** 2 + ((rows - y - h / 2) / (h / 2)) ** 2 <= 1


def clip(box):
    left, top = np.clip(box[0], 0, WIDTH - 4), np.clip(box[1], 0, HEIGHT - 4)
    right, bottom = np.clip(box[0] + box[2], left + 4, WIDTH), np.clip(box[1] + box[3], top + 4, HEIGHT)
    return np.array([left, top, right - left, bottom - top])


def make(rng):
    truths, found = [], []
    for image in range(IMAGES):
        for obj in OBJECTS:
            for _ in range(rng.integers(0, 4) if obj != 4 else int(image == 2)):
                box = clip(np.concatenate([rng.integers(0, 45, 2), rng.integers(8, 28, 2)]))
                mask = draw(rng, box)
                visib = float(rng.choice([0.05, 0.4, 1.0], p=[0.25, 0.35, 0.4])) if obj != 4 else 0.02
                mask[:, : int(box[0] + box[2] * (1 - max(visib, 0.1)))] = False
                truths.append((image, obj, visib, box, mask))
                for _ in range(rng.integers(0, 4)):
                    near = clip(np.round(box + rng.normal(0, rng.choice([0.5, 2, 5]), 4), 1))
                    score = np.round(rng.uniform(0.2, 1), 1)
                    found.append((image, obj, score, near, draw(rng, near) & (mask | (rng.random() < 0.3))))
            for _ in range(rng.integers(0, 2)):
                box = clip(np.concatenate([rng.integers(0, 45, 2), rng.integers(8, 28, 2)]).astype(float))
                found.append((image, obj, np.round(rng.uniform(0, 0.9), 1), box, draw(rng, box)))
    return truths, [one for one in found if one[-1].any()]


def encode(mask):
    return codec.encode(np.asfortranarray(mask.astype(np.uint8)))


def main():
    truths, found = make(np.random.default_rng(81))
    truths = [one for one in truths if one[-1].any()]
    images = [{"id": i, "height": HEIGHT, "width": WIDTH} for i in range(IMAGES)]
    annotations = [
        {"id": i + 1, "image_id": image, "category_id": obj, "bbox": box.tolist(), "area": int(mask.sum())}
        | {"segmentation": encode(mask), "iscrowd": 0, "ignore": visib < 0.1}
        for i, (image, obj, visib, box, mask) in enumerate(truths)
    ]
    dataset = COCO()
    categories = [{"id": obj} for obj in OBJECTS]
    dataset.dataset = {"images": images, "annotations": annotations, "categories": categories, "info": {}}
    dataset.createIndex()
    results = [
        {"image_id": image, "category_id": obj, "score": float(score)}
        | {"bbox": box.tolist(), "segmentation": encode(mask)}
        for image, obj, score, box, mask in found
    ]
    arrays = {}
    for prefix, rows, third in (("gt", truths, "visib"), ("det", found, "score")):
        columns = list(zip(*rows, strict=True))
        names = ("image", "obj", third, "box")
        arrays |= {f"{prefix}_{n}": np.array(c) for n, c in zip(names, columns[:4], strict=True)}
        arrays[f"{prefix}_mask"] = np.packbits(np.array(columns[4]), axis=-1)
    for kind in ("bbox", "segm"):
        scored = BopEval(dataset, dataset.loadRes(results), kind)
        scored.evaluate()
        scored.accumulate()
        scored.summarize()
        arrays[f"{kind}_stats"] = np.array(scored.stats)[[0, 1, 2, 8]]
        precision = scored.eval["precision"][:, :, :, 0, 2]  # IoU, recall, object
        arrays[f"{kind}_ap"] = precision.mean((0, 1))
    np.savez_compressed(Path(__file__).parent / "coco_detections.npz", **arrays)
    print({name: value for name, value in arrays.items() if name.startswith(("bbox", "segm"))}, len(truths), len(found))


if __name__ == "__main__":
    main()
