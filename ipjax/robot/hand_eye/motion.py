"""Whether a robot's poses can tell where its camera is: hand–eye calibration needs turns about two axes.

Turns about one axis leave the camera's place along that axis open, and its rotation about it; motions without any turn
leave its whole place open (R. Y. Tsai and R. K. Lenz, "A new technique for fully autonomous and efficient 3D robotics
hand/eye calibration", IEEE Transactions on Robotics and Automation 5(3), 1989, https://doi.org/10.1109/70.34770).
"""

import numpy as np

from ipjax.robot.hand_eye.records import HandEyeError
from ipjax.transforms import Similarity, vector_from_rotation

FEWEST = 4  # views: three have as many numbers as there are unknowns, but for six, and a wrong one could not be told
LEAST = np.deg2rad(8)  # below which a turn drowns in the noise of usual robots and cameras
WANTED = np.deg2rad(20)
WHAT_TO_DO = "turn the hand about at least two axes, by 20° or more about each, between views"


def measure_turns(base_from_gripper: Similarity[np.ndarray]) -> tuple[float, float]:
    """The widest turn (rad) between two poses, and the widest about an axis across the main one.

    Args:
      base_from_gripper: [n].
    """
    first, second = np.triu_indices(len(base_from_gripper.scale), 1)
    turned = base_from_gripper.take(first).inverse() @ base_from_gripper.take(second)
    vectors = vector_from_rotation(turned.rotation)
    if not len(vectors):
        return 0.0, 0.0
    # A turn by more than 90° about one axis is as telling as one by 90°.
    lengths = np.linalg.norm(vectors, axis=1)
    vectors = vectors * np.minimum(1, (np.pi / 2) / np.maximum(lengths, 1e-12))[:, None]
    _, axes = np.linalg.eigh(vectors.T @ vectors)
    across = np.linalg.norm(vectors @ axes[:, :2], axis=1)
    return float(lengths.max()), float(across.max())


def check_motion(base_from_gripper: Similarity[np.ndarray], what: str = "views of the board") -> list[str]:
    """What these poses tell too little about, in sentences; empty where they tell enough.

    Raises:
      HandEyeError: they cannot tell where the camera is: too few, no turn, or turns about one axis only.
    """
    count = len(base_from_gripper.scale)
    if count < FEWEST:
        raise HandEyeError(
            f"too few {what}, {count}: {FEWEST} is the least, 15 is usual; take more, and {WHAT_TO_DO} (hold the "
            "board's whole picture sharp)"
        )
    widest, across = measure_turns(base_from_gripper)
    if widest < LEAST:
        raise HandEyeError(
            f"the robot's poses turn by no more than {np.degrees(widest):.1f}°, so the camera's place cannot be told: "
            f"{WHAT_TO_DO}"
        )
    if across < LEAST:
        raise HandEyeError(
            "the robot's poses all turn about one axis (about others by no more than "
            f"{np.degrees(across):.1f}°), so the camera's place along it cannot be told: {WHAT_TO_DO}"
        )
    if min(widest, across) < WANTED:
        return [
            f"the robot's poses turn by no more than {np.degrees(min(widest, across)):.0f}° about a second axis: "
            f"{WHAT_TO_DO}, and the answer becomes surer"
        ]
    return []
