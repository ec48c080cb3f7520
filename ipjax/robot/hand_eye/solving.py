"""``AX = XB``: a start in closed form, then least squares on all poses together, in NumPy's doubles on the host.

The rotation of the start is that of F. C. Park and B. J. Martin, "Robot sensor calibration: solving AX = XB on the
Euclidean group", IEEE Transactions on Robotics and Automation 10(5), 1994, https://doi.org/10.1109/70.326576: of all
motions between two views, the rotation vectors of the robot are those of the camera, turned. The rest is linear.

The least squares have 12 unknowns: the camera's mount, and the board's. A view's residual is how far the board lies
from where both say, about the board, along the camera's axes. Rotation and translation are weighted by their noise,
which is found from the residuals: the camera's own where it is not known, else the robot's (expectation and
maximisation over the error of every robot pose; A. P. Dempster, N. M. Laird and D. B. Rubin, 1977).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from ipjax.robot.hand_eye.records import Eye, HandEye, Noise, Views
from ipjax.transforms import Similarity, difference, retract, vector_from_rotation

FEWEST = 3  # views, in theory; two motions about two axes
_STEP = 1e-6  # rad and m, of the numeric derivatives, whose error is then 1e-10
_ROUNDS = 30
_LEAST = Noise(1e-6, 1e-7)  # no calibration is better than this; it keeps the weights finite where data are exact
_NEAR_HALF = np.deg2rad(170)  # motions by more are left out of the start: their axis may come with either sign


def holder_from_mount(base_from_gripper: Similarity[np.ndarray], eye: Eye) -> Similarity[np.ndarray]:
    """The robot's poses from what carries the camera to what carries the board."""
    return base_from_gripper if eye == "in-hand" else base_from_gripper.inverse()


def start(views: Views, eye: Eye) -> tuple[Similarity[np.ndarray], Similarity[np.ndarray]]:
    """``mount_from_camera`` and ``holder_from_board`` in closed form (Park and Martin), all views alike."""
    mounts, boards = start_many(views, eye, np.arange(len(views))[None])
    return mounts.take(0), boards.take(0)


def start_many(
    views: Views, eye: Eye, subsets: Int[np.ndarray, "s k"]
) -> tuple[Similarity[np.ndarray], Similarity[np.ndarray]]:
    """The same of many subsets of the views, [s] each."""
    robot, board = holder_from_mount(views.base_from_gripper, eye), views.camera_from_board
    one, other = np.triu_indices(subsets.shape[1], 1)
    first, second = subsets[:, one], subsets[:, other]  # s × pairs
    mount = robot.take(second).inverse() @ robot.take(first)
    camera = board.take(second) @ board.take(first).inverse()
    a, b = vector_from_rotation(mount.rotation), vector_from_rotation(camera.rotation)
    sure = (np.linalg.norm(a, axis=-1) < _NEAR_HALF) & (np.linalg.norm(b, axis=-1) < _NEAR_HALF)
    rotation = _nearest_rotation(np.einsum("sp,spi,spj->sij", sure.astype(float), a, b))
    left = mount.rotation - np.eye(3)
    right = np.einsum("sij,spj->spi", rotation, camera.translation) - mount.translation
    inner = np.einsum("spki,spkj->sij", left, left)
    translation = (np.linalg.pinv(inner, hermitian=True) @ np.einsum("spki,spk->si", left, right)[..., None])[..., 0]
    mount_from_camera = Similarity(rotation, translation, np.ones(len(subsets)))
    every = robot.take(subsets) @ _spread(mount_from_camera) @ board.take(subsets)
    mean = Similarity(_nearest_rotation(every.rotation.sum(1)), every.translation.mean(1), np.ones(len(subsets)))
    return mount_from_camera, mean


def tell_boards(
    base_from_gripper: Similarity[np.ndarray],
    eye: Eye,
    mount_from_camera: Similarity[np.ndarray],
    holder_from_board: Similarity[np.ndarray],
) -> Similarity[np.ndarray]:
    """``camera_from_board`` of each robot pose, by a calibration or by many [*b]; [*b, n]."""
    turned = holder_from_mount(base_from_gripper, eye)
    return _spread(mount_from_camera).inverse() @ turned.inverse() @ _spread(holder_from_board)


def residuals(
    views: Views,
    eye: Eye,
    mount_from_camera: Similarity[np.ndarray],
    holder_from_board: Similarity[np.ndarray],
    error: Float[np.ndarray, "*b 6"] | None = None,
    stretch: Float[np.ndarray, "*b"] | None = None,
) -> Float[np.ndarray, "*b n 6"]:
    """By how much each view's board is off: rotation (rad) and translation (m) about it, along the camera's axes.

    Args:
      mount_from_camera, holder_from_board: leading axes ``*b``, solutions that are tried together.
      error: of every robot pose, rotation and translation along the gripper's axes.
      stretch: logarithm of how much larger the board is than was told.
    """
    robot = views.base_from_gripper
    if error is not None:
        robot = robot @ Similarity[np.ndarray].exp(error[..., None, :])
    told = tell_boards(robot, eye, mount_from_camera, holder_from_board)
    seen = views.camera_from_board
    if stretch is not None:
        seen = Similarity(seen.rotation, seen.translation * np.exp(stretch)[..., None, None], seen.scale)
    return difference(told, seen)[..., :6]


def solve(
    views: Views,
    eye: Eye,
    begin: tuple[Similarity[np.ndarray], Similarity[np.ndarray]] | None = None,
    *,
    noise: Noise | None = None,
    counted: Bool[np.ndarray, " n"] | None = None,
) -> HandEye:
    """The camera's mount by least squares on the views that are counted; the others only get their residual.

    Args:
      views: three or more, whose robot poses turn about two axes or more (see `motion.check_motion`).
      eye: where the camera is.
      begin: ``mount_from_camera`` and ``holder_from_board``; the closed form where it is not given.
      noise: of one view, of the camera or, where the views have covariances, of the robot; None = it is estimated.
      counted: which views the answer rests on; all where it is not given.
    """
    counted = np.ones(len(views), bool) if counted is None else counted
    chosen = views.take(np.flatnonzero(counted))
    mount, board = start(chosen, eye) if begin is None else begin
    estimated, known = noise is None, views.covariance is not None
    noise = noise or _first_noise(residuals(chosen, eye, mount, board))
    inner = np.zeros((12, 12))
    for _ in range(_ROUNDS):
        off, slope = _linearise(chosen, eye, mount, board)
        lever = _lever(chosen, eye, mount, board) if known else None
        spread = _spread_of(chosen, noise, lever)
        # The rows in standard deviations: the inverse of the spread's Cholesky factor.
        root = np.linalg.inv(np.linalg.cholesky(spread))
        rows, right = (root @ slope).reshape(-1, 12), (root @ off[..., None]).reshape(-1)
        inner = rows.T @ rows
        step = np.linalg.lstsq(rows, -right, rcond=None)[0]
        mount, board = retract(mount, step[:6]), retract(board, step[6:])
        off = residuals(chosen, eye, mount, board)
        before = noise
        if estimated:
            noise = _estimate_noise(off, spread, lever, noise)
        changed = abs(np.log(noise.rotation / before.rotation)) + abs(np.log(noise.translation / before.translation))
        if np.abs(step).max() < 1e-9 and changed < 1e-3:
            break
    off, slope = _linearise(views, eye, mount, board)
    spread = _spread_of(views, noise, _lever(views, eye, mount, board) if known else None)
    # What the answer does not know adds to the error of a view that it does not rest on. Of one that it rests on the
    # residual is smaller than the error without it, by as much (R. D. Cook and S. Weisberg, Residuals and Influence in
    # Regression, 1982, chapter 2).
    covariance = np.linalg.pinv(inner, hermitian=True)
    own = slope @ covariance @ np.swapaxes(slope, -1, -2)
    told = spread + np.where(counted, -1.0, 1.0)[:, None, None] * own
    told = np.where(counted[:, None, None], _lift(told, spread), told)
    left_out = np.where(counted[:, None], (spread @ np.linalg.solve(told, off[..., None]))[..., 0], off)
    return HandEye(
        eye, mount, board, covariance[:6, :6], noise, np.flatnonzero(counted), off, left_out, _distance(off, told)
    )


def _spread(pose: Similarity[np.ndarray]) -> Similarity[np.ndarray]:
    """With an axis for the views."""
    ones = np.ones((*pose.translation.shape[:-1], 1))
    return Similarity(pose.rotation[..., None, :, :], pose.translation[..., None, :], ones)


def _copies(pose: Similarity[np.ndarray], count: int) -> Similarity[np.ndarray]:
    parts = pose.rotation, pose.translation, pose.scale
    return Similarity(*(np.broadcast_to(part, (count, *part.shape)) for part in parts))


def _nearest_rotation(matrix: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """The rotation R with the largest trace of Rᵀ matrix."""
    left, _, right = np.linalg.svd(matrix)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    return left @ right


def _linearise(views: Views, eye: Eye, mount: Similarity[np.ndarray], board: Similarity[np.ndarray]):
    """Residuals [n, 6] and their derivatives [n, 6, 12] by the steps of the mount and of the board."""
    steps = _STEP * np.concatenate([np.zeros((1, 12)), np.eye(12), -np.eye(12)])
    mounts, boards = (_copies(pose, len(steps)) for pose in (mount, board))
    moved = residuals(views, eye, retract(mounts, steps[:, :6]), retract(boards, steps[:, 6:]))
    return moved[0], np.moveaxis(moved[1:13] - moved[13:], 0, -1) / (2 * _STEP)


def _lever(views: Views, eye: Eye, mount: Similarity[np.ndarray], board: Similarity[np.ndarray]):
    """Derivatives [n, 6, 6] of the residuals by the errors of the robot's poses, along the gripper's axes."""
    steps = _STEP * np.concatenate([np.eye(6), -np.eye(6)])
    moved = residuals(views, eye, mount, board, error=steps)
    return np.moveaxis(moved[:6] - moved[6:], 0, -1) / (2 * _STEP)


def _spread_of(views: Views, noise: Noise, lever: np.ndarray | None) -> Float[np.ndarray, "n 6 6"]:
    """The covariance of each view's residual."""
    own = np.diag([noise.rotation**2] * 3 + [noise.translation**2] * 3)
    if lever is None or views.covariance is None:
        return np.broadcast_to(own, (len(views), 6, 6))
    return views.covariance + lever @ own @ np.swapaxes(lever, -1, -2)


def _distance(off: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Squared, in standard deviations."""
    return np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])


def _lift(matrix: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """The matrix with at least a thousandth of the whole: a view that alone determines something hides its error."""
    root = np.linalg.cholesky(whole)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ matrix @ np.swapaxes(inverse, -1, -2))
    back = root @ vectors
    return (back * np.maximum(values, 1e-3)[:, None, :]) @ np.swapaxes(back, -1, -2)


def _first_noise(off: np.ndarray) -> Noise:
    middle = np.median(np.square(off), axis=0)
    return _bounded(np.sqrt(middle[:3].mean() / 0.45), np.sqrt(middle[3:].mean() / 0.45))


def _estimate_noise(off: np.ndarray, spread: np.ndarray, lever: np.ndarray | None, noise: Noise) -> Noise:
    """One step of expectation and maximisation: the error of each pose, given its residual, and its uncertainty."""
    own = np.diag([noise.rotation**2] * 3 + [noise.translation**2] * 3)
    gain = own if lever is None else own @ np.swapaxes(lever, -1, -2)
    gain = gain @ np.linalg.inv(spread)
    found = (gain @ off[..., None])[..., 0]
    rest = own - gain @ (np.eye(6) if lever is None else lever) @ own
    free = 6 * len(off) / max(6 * len(off) - 12, 1)  # twelve of the numbers went into the solution
    squares = free * np.square(found) + np.einsum("nii->ni", np.broadcast_to(rest, (len(off), 6, 6)))
    mean = squares.mean(0)
    return _bounded(np.sqrt(mean[:3].mean()), np.sqrt(mean[3:].mean()))


def _bounded(rotation: float, translation: float) -> Noise:
    return Noise(max(float(rotation), _LEAST.rotation), max(float(translation), _LEAST.translation))


def find_stretch(views: Views, found: HandEye) -> tuple[float, float]:
    """How much larger the board seems to be than was told, by the views that count; and its standard deviation.

    One step of least squares with a thirteenth unknown, the logarithm of the length of all camera_from_board.
    """
    chosen = views.take(found.used)
    mount, board = found.mount_from_camera, found.holder_from_board
    off, slope = _linearise(chosen, found.eye, mount, board)
    moved = residuals(chosen, found.eye, mount, board, stretch=np.array(_STEP)) - off
    rows = np.concatenate([slope, moved[..., None] / _STEP], -1)
    lever = None if views.covariance is None else _lever(chosen, found.eye, mount, board)
    root = np.linalg.inv(np.linalg.cholesky(_spread_of(chosen, found.noise, lever)))
    rows, right = (root @ rows).reshape(-1, 13), (root @ off[..., None]).reshape(-1)
    step = np.linalg.lstsq(rows, -right, rcond=None)[0]
    covariance = np.linalg.pinv(rows.T @ rows, hermitian=True)
    return float(np.expm1(step[12])), float(np.sqrt(covariance[12, 12]))
