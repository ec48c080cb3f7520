"""How far the surfaces of objects made from one photo are off: what `ipjax.files.objects.deviations` rests on.

    python -m benchmarks.photo_shapes made [--data ../shared/data/ycbv] [--objects 50] [--seed 1]
    python -m benchmarks.photo_shapes real --data ../shared/data
    python -m benchmarks.photo_shapes page

``made``: made objects and, where ``data`` is, scans, each seen from a random direction: its outline is inflated, and
its depth image completed, and the nearest and the farthest surface along every ray are compared with the true ones,
in diameters of the guess. Seed 1 chose the values; another judges them.

``real``: the two meshes of image-to-3D models whose photo is at hand. ``page`` writes benchmarks/results/shapes.md.

Surfaces are drawn as points, so many that a pixel of 56 on a side has dozens: no renderer is needed.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.measure import commit
from ipjax.files.storage.parsing import parse_json
from ipjax.files.storage.writing import append_json, read_lines, write_text
from ipjax.transforms import Similarity

SIDE = 224  # pixels of the photo
COARSE = 56  # of the images in which surfaces are compared
POINTS = 250_000
NOISE = 0.005  # of the depth image, diameters
METHODS = {"inflate": "the outline inflated", "depth": "the depth image completed"}


def framing(points: Float[np.ndarray, "n 3"], side: int) -> Float[np.ndarray, "3 3"]:
    """K of the camera in whose square image the points take 83 % of the longer side."""
    rays = points[:, :2] / points[:, 2:]
    low, high = rays.min(0), rays.max(0)
    focal = 0.83 * side / (high - low).max()
    x, y = (side - 1) / 2 - focal * (low + high) / 2
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def draw(points: Float[np.ndarray, "n 3"], matrix: Float[np.ndarray, "3 3"], side: int, far: bool = False):
    """Depth of the nearest (or farthest) point in each pixel, 0 = none."""
    from ipjax.cameras import project

    column, row = np.round(project(matrix, points)).astype(int).T
    inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
    image, sign = np.full((side, side), np.inf), -1 if far else 1
    np.minimum.at(image, (row[inside], column[inside]), sign * points[inside, 2])
    return np.where(np.isfinite(image), sign * image, 0.0)


def close(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Without the pixels between points that nothing was drawn in."""
    from scipy import ndimage

    known = depth > 0
    mask = np.asarray(ndimage.binary_closing(np.pad(known, 3), iterations=2), bool)[3:-3, 3:-3] | known
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.where(mask, depth[tuple(np.asarray(nearest))], 0)


def compare(
    guess: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "m 3"], matrix: Float[np.ndarray, "3 3"]
) -> dict[str, float]:
    """Two surfaces in one camera: how far the nearest and farthest along each ray, and the outline, are apart.

    In the unit of the guess, to which the true one is first brought: the medians of the nearest agree.
    """
    from scipy import ndimage

    images = [[draw(points, matrix, COARSE, far) for far in (False, True)] for points in (guess, true)]
    both = (images[0][0] > 0) & (images[1][0] > 0)
    unit = float(np.median(images[1][0][both] / images[0][0][both]))
    front, back = (images[0][i][both] - images[1][i][both] / unit for i in range(2))
    filled = [np.asarray(ndimage.binary_closing(one[0] > 0), bool) for one in images]
    edges = [x & ~np.asarray(ndimage.binary_erosion(x), bool) for x in filled]
    apart = np.asarray(ndimage.distance_transform_edt(~edges[1]))[edges[0]]
    apart = apart / matrix[0, 0] * np.median(images[0][0][both])
    rms = lambda x: float(np.sqrt(np.mean(x**2)))
    middle = lambda z: (z.min() + z.max()) / 2
    return {
        "front": rms(front),
        "back": rms(back),
        "back_mean": float(back.mean()),
        "across": rms(apart),
        "centre": float(middle(guess[:, 2]) - middle(true[:, 2]) / unit),
    }


def run_made(output: Path, objects: int, seed: int, data: Path | None) -> None:
    """A line for each object and method; lines that are there are not made again."""
    from ipjax.bop.dataset import Dataset
    from ipjax.files.meshes.mesh import normalise
    from ipjax.files.meshes.sampling import sample_appearance
    from ipjax.onboarding.reconstruction.completion import complete_depth
    from ipjax.onboarding.reconstruction.inflation import inflate_photo
    from ipjax.records import Camera
    from ipjax.synthetic.objects import KINDS, make_object

    done = {tuple(parse_json(line)["key"]) for line in read_lines(output)} if output.exists() else set()
    dataset = None if data is None else Dataset(data)
    numbers = [] if dataset is None else sorted(dataset.models())
    for index in range(objects):
        if all((seed, index, method) in done for method in METHODS):
            continue
        rng = np.random.default_rng([seed, index, 77])
        if dataset is not None and index % 2:
            number = numbers[index // 2 % len(numbers)]
            name, mesh = f"obj_{number:06d}", normalise(dataset.mesh(number, "models"))
        else:
            kind = KINDS[index // 2 % len(KINDS)]
            name, mesh = f"{kind}-{index}", make_object(kind, 200_000 * seed + index)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose = Similarity(turn * np.sign(np.linalg.det(turn)), np.array([0, 0, rng.uniform(3, 4.5)]), np.ones(()))
        true = pose @ np.asarray(sample_appearance(mesh, POINTS)[0], np.float64)
        matrix = framing(true, SIDE)
        depth = close(draw(true, matrix, SIDE))
        mask, camera = depth > 0, Camera.from_matrix(matrix)
        rgb = np.where(mask[..., None], 90, 128).astype(np.uint8)
        noisy = np.where(mask, depth + NOISE * rng.normal(size=depth.shape), 0)
        coarse = matrix * np.array([[COARSE / SIDE]] * 2 + [[1]])
        coarse[:2, 2] += (COARSE / SIDE - 1) / 2
        for method in METHODS:
            if (seed, index, method) in done:
                continue
            made = inflate_photo(rgb, mask, camera=camera)
            if method == "depth":
                made = complete_depth(rgb, mask, noisy, camera)
            assert made.camera_from_mesh is not None
            unit = normalise(made.mesh)
            back = Similarity(np.eye(3), np.asarray(unit.centre), np.asarray(1 / unit.scale))
            placed = made.camera_from_mesh.to_numpy() @ back
            guess = Similarity(placed.rotation, placed.translation / placed.scale, np.ones(()))
            points = guess @ np.asarray(sample_appearance(unit, POINTS // 2)[0], np.float64)
            row = {"key": [seed, index, method], "object": name, **compare(points, true, coarse), "commit": commit()}
            append_json(output, row)
            print(row, flush=True)


def run_real(output: Path, data: Path) -> None:
    """A line for each mesh of an image-to-3D model whose photo is at hand, put where it fits the scan best."""
    from benchmarks.reconstructions import MESHES
    from ipjax.bop.alignments import read_alignment
    from ipjax.bop.dataset import Dataset
    from ipjax.files.meshes.loading import load_mesh
    from ipjax.files.meshes.mesh import diameter, normalise
    from ipjax.files.meshes.sampling import sample_appearance

    done = {tuple(parse_json(line)["key"]) for line in read_lines(output)} if output.exists() else set()
    for number, (mesh, alignment, photo) in MESHES.items():
        if photo is None or (0, number, "elsewhere") in done:
            continue
        folder = data / photo[0]
        dataset = Dataset(folder.parents[1], models=data / "ycbv")
        scene, image = int(folder.name), 0
        truth = next(one for one in dataset.truths(scene, image) if one.obj_id == number)
        scan, made = dataset.mesh(number, "models"), normalise(load_mesh(data / mesh))
        pose = Similarity(np.asarray(truth.rotation), np.asarray(truth.translation), np.ones(()))
        true = pose @ np.asarray(sample_appearance(scan, 2 * POINTS)[0], np.float64)
        there = made.to_file(np.asarray(sample_appearance(made, 2 * POINTS)[0], np.float64))
        guess = pose @ (read_alignment(data / alignment) @ there)
        size = diameter(scan)
        row = compare(guess / size, true / size, framing(true, COARSE))
        append_json(output, {"key": [0, number, "elsewhere"], "object": Path(mesh).stem, **row, "commit": commit()})
        print(row, flush=True)


def tell(rows: list[dict[str, Any]]) -> list[str]:
    """The table: of each seed and method, means over the objects of their root mean squares."""
    text = [
        "| seed | made by | objects | front, along its ray | back, along it | its mean | outline, across | centre |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for seed, method in dict.fromkeys((row["key"][0], row["key"][2]) for row in rows):
        chosen = [row for row in rows if (row["key"][0], row["key"][2]) == (seed, method)]
        average = lambda name, chosen=chosen: f"{np.mean([row[name] for row in chosen]):.3f}"
        centre = f"{np.sqrt(np.mean([row['centre'] ** 2 for row in chosen])):.3f}"
        figures = [average("front"), average("back"), average("back_mean"), average("across"), centre]
        text.append(f"| {seed or 'real'} | {method} | {len(chosen)} | {' | '.join(figures)} |")
    return text


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("made", "real", "page"))
    parser.add_argument("--data", type=Path, help="made: a BOP data set with scans; real: the shared data")
    parser.add_argument("--objects", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("build/photo_shapes.jsonl"))
    parser.add_argument("--page", type=Path, default=Path("benchmarks/results/shapes.md"), help="page: write it here")
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    if options.what == "made":
        run_made(options.output, options.objects, options.seed, options.data)
    elif options.what == "real":
        if options.data is None:
            parser.error("real needs --data FOLDER")
        run_real(options.output, options.data)
    rows = [parse_json(line) for line in read_lines(options.output)]
    text = tell(rows)
    print("\n".join(text))
    if options.what == "page":
        states = ", ".join(dict.fromkeys(row["commit"] for row in rows))
        head = [
            "# How far surfaces made from one photo are off",
            "",
            "Made by `python -m benchmarks.photo_shapes`; do not edit by hand. Root mean squares over the surface"
            " of each object, in diameters of the guess, and their mean over objects seen from random directions,"
            " after the medians of the fronts were brought together: *front* is the nearest surface along each "
            "ray of the photo, *back* the farthest, *centre* the middle of the object along the photo's axis "
            "(root mean square over the objects). `inflate` and `depth` chose the values of "
            "`ipjax.files.objects.deviations` on seed 1. *real*: one mesh each of SAM 3D and InstantMesh, put "
            "where it fits the scan best; the worse of the two is what is assumed of such meshes, and of "
            "TripoSR's, none of which is at hand with a truth.",
            "",
            f"Commit {states}.",
            "",
        ]
        write_text(options.page, "\n".join([*head, *text]) + "\n")


if __name__ == "__main__":
    main()
