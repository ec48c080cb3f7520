"""Signed errors on exact images: ``python -m benchmarks.bias [--scenes N] [--page FILE]``.

An ellipsoid is drawn by a formula, at a random pose, size and place in an image of 640 × 480, and goes the way of every
query: ``frame``, ``observe``, ``estimate``, at the defaults (crops of 224², a grid of 56²). No image holds noise, so
the mean error over many of them is zero only if no stage is biased. Four stages are measured: the
mask's border on the grid (``contour``), ``refine`` from the truth, the whole ``estimate``, and ``frame`` at image sizes
from 640 to 4096 pixels, odd ones included. A mean farther from zero than three standard errors is a bias.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import ipjax
from benchmarks.measure import describe_device
from ipjax.config import Config
from ipjax.estimation.features import observe
from ipjax.estimation.refinement import refine
from ipjax.estimation.scene import SceneGrid
from ipjax.files.storage.writing import write_text
from ipjax.inference.frames import frame_turned
from ipjax.synthetic import problems

GRID, RESOLUTION = 16, 16 * problems.PATCH  # patches and pixels on a side, as DINOv2 has them by default
SIZES = ((640, 480), (641, 479), (1280, 720), (2560, 1440), (2561, 1441), (4096, 3072))
COORDINATES = ("x", "y", "z", "size")


def pose_errors(found, truth) -> np.ndarray:
    """x, y, z of the centre and size, in % of the diameter."""
    offset = (np.asarray(found.translation, np.float64) - np.asarray(truth.translation)) / float(truth.scale)
    return 100 * np.array([*offset, float(found.scale) / float(truth.scale) - 1])


def rotation_error(found, truth) -> float:
    """Degrees, up to the half-turns that an ellipsoid cannot tell apart."""
    relative = np.asarray(found.rotation, np.float64).T @ np.asarray(truth.rotation, np.float64)
    turns = [np.diag(s) for s in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    return min(np.degrees(np.arccos(np.clip((np.trace(relative @ t) - 1) / 2, -1, 1))) for t in turns)


def contour_errors(cloud, truth) -> np.ndarray:
    """How far the traced border is shifted (x, y) and enlarged, in % of the diameter."""
    focal, centre = np.asarray(cloud.camera.focal, np.float64), np.asarray(cloud.camera.centre, np.float64)
    points = np.asarray(cloud.contour.points, np.float64)[np.asarray(cloud.contour.valid)]
    conic = problems.outline_conic(truth, focal, centre)
    along = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    slope = 2 * along @ conic
    length = np.linalg.norm(slope[:, :2], axis=1)
    # To first order, the distance from the conic along its normal.
    gap, normal = np.sum(along @ conic * along, axis=1) / length, slope[:, :2] / length[:, None]
    translation = np.asarray(truth.translation, np.float64)
    middle = focal * translation[:2] / translation[2] + centre
    terms = np.concatenate([normal, np.sum(normal * (points - middle), axis=1, keepdims=True)], axis=1)
    x, y, size = np.linalg.lstsq(terms, gap, rcond=None)[0]
    diameter = float(truth.scale) / translation[2] * focal
    return 100 * np.array([x / diameter[0], y / diameter[1], np.nan, size])


def frame_errors(
    seed: int,
    width: int,
    height: int,
    *,
    resolution: int = RESOLUTION,
    crop: str = "square",
    share: tuple[float, float] = (0.4, 0.7),
) -> dict[str, np.ndarray]:
    """How far depth, colours and mask of a crop are from where its camera says: x, y in pixels of the whole image, and
    the mask's size in %."""
    scene = problems.make_frame(seed, height, width, share)
    view, camera_from_crop = frame_turned(
        scene.rgb, scene.depth, scene.mask, scene.matrix, resolution=resolution, crop=crop
    )
    focal, centre = np.asarray(view.camera.focal, np.float64), np.asarray(view.camera.centre, np.float64)
    crop_from_object = camera_from_crop.to_numpy().inverse() @ scene.camera_from_object.to_numpy()
    rgb, depth, mask = problems.draw_ellipsoid(crop_from_object, focal, centre, resolution, resolution)
    zoom = scene.matrix[[0, 1], [0, 1]] / focal  # in the middle of the image
    seen = mask & (np.asarray(view.depth) > 0)
    inner = seen.copy()
    for down, right in ((0, 3), (0, -3), (3, 0), (-3, 0)):
        inner &= np.roll(mask, (down, right), (0, 1))

    def moved(image, exact):
        """The shift of the exact image that explains the difference, by least squares."""
        down, right = np.gradient(exact)
        slopes = np.stack([right[inner], down[inner]], -1)
        return np.linalg.lstsq(slopes, -(np.asarray(image, np.float64) - exact)[inner], rcond=None)[0] * zoom

    rows, columns = np.mgrid[:resolution, :resolution]
    middle = lambda shape: np.array([columns[shape].mean(), rows[shape].mean()])
    cut = np.asarray(view.mask)
    size = 100 * (np.sqrt(cut.sum() / mask.sum()) - 1)
    return {
        "depth": np.array([*moved(view.depth, depth), np.nan]),
        "colours": np.array([*np.mean([moved(view.rgb[..., k], rgb[..., k]) for k in range(3)], axis=0), np.nan]),
        "mask": np.array([*((middle(cut) - middle(mask)) * zoom), size]),
    }


def summary(errors: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The mean and its standard error of each column."""
    table = np.array(errors)
    return table.mean(axis=0), table.std(axis=0, ddof=1) / np.sqrt(len(table))


def format_mean(mean: float, error: float, digits: int) -> str:
    """Mean ± standard error, in bold where the mean is farther from zero than three standard errors."""
    if not np.isfinite(mean):
        return ""
    text = f"{mean:+.{digits}f} ± {error:.{digits}f}"
    return f"**{text}**" if abs(mean) > 3 * error else text


def measure_poses(scenes: int, directions: int, rolls: int) -> list[str]:
    """The rows of the contour, of ``refine`` and of ``estimate``."""
    templates = problems.make_templates(directions, rolls, grid=GRID)
    templates = eqx.tree_at(lambda t: t.surface, templates, problems.make_surface(2048))
    encoder, config = problems.make_encoder(), Config()
    observe_compiled = jax.jit(observe)
    reduce = jax.jit(lambda query: SceneGrid(query, config.score.resolution, config.refine.silhouette).cloud)
    fit = jax.jit(lambda cloud, pose: refine(templates.surface, cloud, pose, config.refine)[0])
    find = jax.jit(ipjax.estimate)
    errors: dict[str, list[np.ndarray]] = {"contour": [], "refine, from the truth": [], "estimate": []}
    turned: dict[str, list[float]] = {name: [] for name in errors}
    for seed in range(scenes):
        scene = problems.make_frame(seed)
        view = ipjax.frame(scene.rgb, scene.depth, scene.mask, scene.matrix, resolution=RESOLUTION)
        query, truth = observe_compiled(encoder, view), scene.camera_from_object
        cloud = reduce(query)
        errors["contour"].append(contour_errors(cloud, truth))
        for name, pose in (
            ("refine, from the truth", fit(cloud, truth)),
            ("estimate", find(None, templates, query, jax.random.key(seed), config).camera_from_object),
        ):
            errors[name].append(pose_errors(pose, truth))
            turned[name].append(rotation_error(pose, truth))
        if (seed + 1) % 20 == 0:
            print(f"  {seed + 1} of {scenes} scenes", file=sys.stderr, flush=True)
    lines = [
        "| stage | x, % | y, % | z, % | size, % | median offset, % | 90 % of offsets | median rotation |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, found in errors.items():
        text = [format_mean(m, e, 3) for m, e in zip(*summary(found), strict=True)]
        offset = np.linalg.norm(np.array(found)[:, :2] if name == "contour" else np.array(found)[:, :3], axis=1)
        rotation = f"{np.median(turned[name]):.2f}°" if turned[name] else ""
        far = f"{np.median(offset):.3f} | {np.quantile(offset, 0.9):.3f}"
        lines.append(f"| {name} | {' | '.join(text)} | {far} | {rotation} |")
    return lines


def measure_frames(scenes: int) -> list[str]:
    """The rows of ``frame`` at every image size."""
    lines = [
        "| image | depth x, px | depth y, px | colours x | colours y | mask x | mask y | mask size, % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for width, height in SIZES:
        found = [frame_errors(seed, width, height) for seed in range(scenes)]
        text = []
        for what, columns in (("depth", 2), ("colours", 2), ("mask", 3)):
            mean, error = summary([one[what] for one in found])
            text += [format_mean(m, e, 3) for m, e in zip(mean[:columns], error[:columns], strict=True)]
        lines.append(f"| {width} × {height} | {' | '.join(text)} |")
        print(f"  {lines[-1]}", file=sys.stderr, flush=True)
    return lines


def main() -> None:
    """Measure, print, and write the page where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200, help="images for contour, refine and estimate")
    parser.add_argument("--frames", type=int, default=40, help="images of each size for frame")
    parser.add_argument("--directions", type=int, default=20, help="directions of the templates")
    parser.add_argument("--rolls", type=int, default=4, help="in-plane rotations of each direction")
    parser.add_argument("--page", type=Path, help="the Markdown file to write, e.g. benchmarks/results/bias.md")
    options = parser.parse_args()
    if options.scenes < 2 or options.frames < 2:
        parser.error("a standard error takes two scenes or more")
    poses = measure_poses(options.scenes, options.directions, options.rolls)
    frames = measure_frames(options.frames)
    device = describe_device()
    root = Path(__file__).resolve().parent.parent
    state = subprocess.run(["git", "rev-parse", "--short=10", "HEAD"], cwd=root, capture_output=True, text=True)
    page = "\n".join(
        [
            "# Signed errors on exact images",
            "",
            f"Made by `python -m benchmarks.bias --scenes {options.scenes} --frames {options.frames}`, commit "
            f"{state.stdout.strip() or 'unknown'}, on {', '.join(f'{k}: {v}' for k, v in device.items())}.",
            "",
            "An ellipsoid drawn by a formula, at random poses, sizes and places; no noise. Mean ± standard error over",
            f"{options.scenes} images of 640 × 480, in % of the diameter; bold = farther from zero than three standard",
            "errors. The contour has no depth; its offset is that of x and y.",
            "",
            *poses,
            "",
            f"`frame`: how far the crop is from where its camera says, in pixels of the whole image ({options.frames} "
            "of each size).",
            "",
            *frames,
            "",
        ]
    )
    print(page)
    if options.page:
        write_text(options.page, page)
        print(f"{options.page}: written", file=sys.stderr)


if __name__ == "__main__":
    main()
