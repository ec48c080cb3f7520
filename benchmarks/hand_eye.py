"""How exact hand–eye calibration is, on made robots and cameras whose truth is known, and what it notices.

    python -m benchmarks.hand_eye [--seeds 100] [--drawn 10] [--page benchmarks/results/hand_eye.md]

Errors are those of gripper_from_camera or base_from_camera, of the whole rotation and of the whole translation.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measure import commit, describe_device
from ipjax.cameras import project
from ipjax.capture.poses.boards import parse_board
from ipjax.capture.poses.sightings import find_board
from ipjax.files.cameras.intrinsics import Intrinsics
from ipjax.files.storage.writing import write_text
from ipjax.inference.drawing import write_image
from ipjax.robot.hand_eye.calibrating import calibrate
from ipjax.robot.hand_eye.from_files import calibrate_files
from ipjax.robot.hand_eye.reading.observing import list_images
from ipjax.robot.hand_eye.records import EYES, Eye, HandEyeError, Noise, Views
from ipjax.robot.hand_eye.solving import solve, start
from ipjax.synthetic.boards import photograph
from ipjax.synthetic.calibration import make_calibration
from ipjax.transforms import Similarity, difference

PAGE = Path("benchmarks/results/hand_eye.md")
BOARD = parse_board("charuco:7x5:0.04:0.03:DICT_4X4_50")
CAMERA = Intrinsics(
    np.array([[620.0, 0, 321], [0, 621, 238], [0, 0, 1]]), (0.08, -0.15, 0.001, 0.0005, 0.02), "plumb_bob", (640, 480)
)
_AXIS = 1 / np.sqrt(3)  # of a vector's deviation, that along each axis
# Name: views, how far they turn (tilt, roll), noise of camera_from_board along each axis (rad, m).
CASES = {
    "15 views, 3 mrad and 1 mm of the whole vectors": (15, (40.0, 60.0), (3e-3 * _AXIS, 1e-3 * _AXIS)),
    "15 views, 3 mrad and 1 mm along each axis, wide turns": (15, (50.0, 120.0), (3e-3, 1e-3)),
    "15 views, 3 mrad and 1 mm along each axis": (15, (40.0, 60.0), (3e-3, 1e-3)),
    "6 views, 3 mrad and 1 mm of the whole vectors": (6, (40.0, 60.0), (3e-3 * _AXIS, 1e-3 * _AXIS)),
    "30 views, 3 mrad and 1 mm of the whole vectors": (30, (40.0, 60.0), (3e-3 * _AXIS, 1e-3 * _AXIS)),
}
ROBOTS = {"exact": (0.0, 0.0), "0.3 mrad, 0.2 mm": (3e-4, 2e-4), "1 mrad, 0.5 mm": (1e-3, 5e-4)}
WAYS = ("poses, all views alike", "corners alone, the robot exact", "corners and the robot's noise")


def error(found: Similarity[np.ndarray], true: Similarity[np.ndarray]) -> np.ndarray:
    """Signed: rotation in degrees, translation in mm, along the camera's axes, in which a bias would lie."""
    return (true.inverse() @ found).log()[:6] * np.repeat([180 / np.pi, 1000], 3)


def summarise(errors: list[np.ndarray]) -> list[str]:
    """Medians, the worst of twenty, and how many standard errors the mean is from zero, along the worst axis."""
    rows = np.array(errors)
    sizes = np.stack([np.linalg.norm(rows[:, :3], axis=1), np.linalg.norm(rows[:, 3:], axis=1)], -1)
    middle, worst = np.median(sizes, 0), np.percentile(sizes, 95, axis=0)
    bias = np.abs(rows.mean(0) / (rows.std(0) / np.sqrt(len(rows)))).max()
    shift = np.linalg.norm(rows.mean(0)[:3]), np.linalg.norm(rows.mean(0)[3:])
    return [
        f"{middle[0]:.3f}°, {middle[1]:.2f} mm",
        f"{worst[0]:.3f}°, {worst[1]:.2f} mm",
        f"{shift[0]:.3f}°, {shift[1]:.2f} mm ({bias:.1f} s.e.)",
    ]


def measure_poses(seeds: int) -> Iterator[list[str]]:
    """Rows: how exact, in both directions, beside the closed form, and whether covariances are right."""
    for name, (count, (tilt, roll), noise) in CASES.items():
        for number, eye in enumerate(EYES):
            errors, closed, told, wrong = [], [], [], 0
            for seed in range(seeds):
                made = make_calibration(seed + 10_000 * number, count, eye, tilt=tilt, roll=roll, camera_noise=noise)
                result = calibrate(made.camera_from_board, made.base_from_gripper, eye)
                errors.append(error(result.found.mount_from_camera, made.mount_from_camera))
                step = difference(result.found.mount_from_camera, made.mount_from_camera)[:6]
                told.append(step @ np.linalg.solve(result.found.covariance, step) / 6)
                wrong += len(result.wrong)
                begin, _ = start(Views(made.base_from_gripper, made.camera_from_board), eye)
                closed.append(error(begin, made.mount_from_camera))
            ours = summarise(errors)
            yield [name, eye, *ours, summarise(closed)[0], f"{np.mean(told):.2f}", f"{wrong} of {seeds * count}"]


def measure_corners(seeds: int) -> Iterator[list[str]]:
    """Rows: what each view's own covariance is worth, by made corners that are off by 0.2 pixels along each axis."""
    x, y = np.meshgrid(np.arange(1, BOARD.columns), np.arange(1, BOARD.rows))
    points = BOARD.length * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    K, blank = CAMERA.matrix, np.zeros((2, 2), np.uint8)
    for robot, noise in ROBOTS.items():
        errors: dict[str, list[np.ndarray]] = {way: [] for way in WAYS}
        for seed in range(seeds):
            made = make_calibration(seed + 20_000, 15, span=BOARD.span, robot_noise=noise)
            rng, seen = np.random.default_rng(seed), []
            for i in range(15):
                pixels = project(K, made.true_camera_from_board.take(i) @ points) + rng.normal(0, 0.2, (len(points), 2))
                seen.append(find_board(blank, lambda _, pixels=pixels: (points, pixels), K))
            covariance = 0.2**2 * np.stack([one.spread(K) for one in seen])
            boards = Similarity[np.ndarray].stack([one.camera_from_board for one in seen])
            for way, given, fixed in zip(
                WAYS, (None, covariance, covariance), (None, Noise(1e-6, 1e-7), None), strict=True
            ):
                found = solve(Views(made.base_from_gripper, boards, given), "in-hand", noise=fixed)
                errors[way].append(error(found.mount_from_camera, made.mount_from_camera))
        for way in WAYS:
            yield [robot, way, *summarise(errors[way])]


def measure_mistakes(seeds: int) -> Iterator[list[str]]:
    """Rows: what is noticed, and how often, of 15 views with 3 mrad and 1 mm along each axis."""
    count = 15
    named = {name: 0 for name in ("one wrong", "slipped", "shifted", "direction")}
    for seed in range(seeds):
        eye: Eye = EYES[seed % 2]
        made = make_calibration(seed + 30_000, count, eye, camera_noise=(3e-3, 1e-3))
        rng, all_ = np.random.default_rng(seed), np.arange(count)
        one, other = rng.choice(count, 2, replace=False)
        order = np.where(all_ == one, other, all_)
        found = calibrate(made.camera_from_board.take(order), made.base_from_gripper, eye)
        named["one wrong"] += list(found.wrong) == [f"{one:06d}"]
        steps = np.zeros((count, 6))
        steps[one, 3:] = 0.01 * np.array([0.6, 0.0, 0.8])
        found = calibrate(made.camera_from_board, made.base_from_gripper @ Similarity[np.ndarray].exp(steps), eye)
        named["slipped"] += list(found.wrong) == [f"{one:06d}"]
        place = int(rng.integers(0, count - 2))
        who = "all images seem" if place == 0 else f"images from {place:06d} on seem"
        try:
            calibrate(made.camera_from_board.take(np.delete(all_, place)), made.base_from_gripper.take(all_[:-1]), eye)
        except HandEyeError as told:
            named["shifted"] += str(told).startswith(f"{who} to belong to the pose after theirs")
        against: Eye = EYES[1 - seed % 2]
        try:
            calibrate(made.camera_from_board, made.base_from_gripper, against)
        except HandEyeError as told:
            named["direction"] += f"they fit --eye {eye}" in str(told)
    words = {
        "one wrong": "the image of another pose: that one named, no other",
        "slipped": "one robot pose off by 10 mm: that one named, no other",
        "shifted": "an image skipped at a place by chance (not the last two): named with its place",
        "direction": "--eye told wrong: refused, the right one named",
    }
    for name, text in words.items():
        yield [text, f"{named[name]} of {seeds}"]


def measure_drawn(seeds: int) -> Iterator[list[str]]:
    """Rows: from drawn images of 640 × 480 pixels through a lens, with noise, and a file of poses."""
    pattern, scale = BOARD.draw(4000), 4000
    for eye in EYES:
        errors, told = [], []
        for seed in range(seeds):
            made = make_calibration(seed + 40_000, 15, eye, span=BOARD.span, robot_noise=(3e-4, 2e-4))
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                for i in range(15):
                    rgb = photograph(pattern, scale, made.true_camera_from_board.take(i), CAMERA, noise=3.0, seed=i)
                    write_image(folder / f"{i:06d}.png", rgb)
                write_text(folder / "poses.json", json.dumps(made.base_from_gripper.to_matrix().tolist()))
                images = list_images([folder])
                outcome = calibrate_files(images, folder / "poses.json", CAMERA, BOARD, eye)
            found = outcome.calibration.found
            errors.append(error(found.mount_from_camera, made.mount_from_camera))
            told.append([np.degrees(found.deviations[0]), 1000 * found.deviations[1], outcome.corner_noise])
        turn, shift, pixels = np.median(told, 0)
        yield [eye, *summarise(errors), f"± {turn:.3f}°, ± {shift:.2f} mm", f"{pixels:.2f}"]


def table(heads: list[str], rows: Iterator[list[str]]) -> list[str]:
    """Lines of Markdown, printed as they come."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    print(*lines, sep="\n", flush=True)
    for row in rows:
        lines.append("| " + " | ".join(row) + " |")
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hand_eye", description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=100, help="made calibrations of each kind")
    parser.add_argument("--drawn", type=int, default=10, help="calibrations from drawn images, in each direction")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    device = describe_device()
    lines = [
        "# Hand–eye calibration",
        "",
        f"Made by `python -m benchmarks.hand_eye`; do not edit by hand. {device['device']}, Python {device['python']}, "
        f"commit {commit()}. Everything is made, so that the truth is known. Errors are medians of the whole rotation "
        "and of the whole translation, then the worst of twenty, then the mean of signed errors along the camera's "
        "axes (its length, and how many standard errors from zero it is along the worst of six axes).",
        "",
        f"## From poses, {options.seeds} seeds",
        "",
        "Turns: views tilted by up to 40° to all sides and rolled by ± 60° (wide: 50°, ± 120°), 0.5 m from a board of "
        "28 × 20 cm. Noise is that of camera_from_board, about the board. The closed form is Park and Martin's. Right "
        "covariances give 1.",
        "",
    ]
    heads = ["made data", "eye", "error", "95 %", "bias", "closed form", "error² / covariance", "right pairs left out"]
    lines += table(heads, measure_poses(options.seeds))
    lines += ["", f"## What is noticed, {options.seeds} seeds", ""]
    lines += table(["mistake", "noticed"], measure_mistakes(options.seeds))
    lines += [
        "",
        f"## What is known of corners and of the robot, {options.seeds // 2} seeds",
        "",
        "Fifteen views of 24 corners, each off by 0.2 pixels along each axis; noise of the robot along each axis. "
        "Corners alone: only the reprojection errors count, as if the robot were exact; the last is what is used: each "
        "view's covariance by its corners, and the robot's noise from the residuals.",
        "",
    ]
    lines += table(["robot", "way", "error", "95 %", "bias"], measure_corners(options.seeds // 2))
    lines += [
        "",
        f"## From images, {options.drawn} seeds",
        "",
        "Fifteen drawn images of 640 × 480 pixels each, through a lens, with noise of 3 grey levels; the robot off by "
        "0.3 mrad and 0.2 mm along each axis. Corners are found, and poses read from a file.",
        "",
    ]
    lines += table(["eye", "error", "95 %", "bias", "told", "pixels"], measure_drawn(options.drawn))
    write_text(options.page, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
