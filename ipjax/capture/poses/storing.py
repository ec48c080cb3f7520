"""The first poses in files, as the step pose leaves them in the folder of work."""

from pathlib import Path

from ipjax.capture.pictures import draw_trajectory
from ipjax.capture.poses.initial import InitialPoses, describe
from ipjax.capture.poses.tracks import write_tracks
from ipjax.capture.records import Capture
from ipjax.capture.trajectories import write_trajectory
from ipjax.inference.drawing import write_image


def write_poses(work: Path, capture: Capture, found: InitialPoses) -> list[str]:
    """Write tracks.npz, trajectory.png, ignore.png where something moves with the camera, and poses.json last.

    Returns:
      What is told of the poses, in sentences, as the picture has them.

    Raises:
      OSError: one of them cannot be written.
    """
    work.mkdir(parents=True, exist_ok=True)
    lines = describe(found)
    picture = draw_trajectory(found.trajectory, found.points, capture.camera.to_matrix(), capture.size, lines)
    write_tracks(work / "tracks.npz", found.tracks)
    write_image(work / "trajectory.png", picture)
    (work / "ignore.png").unlink(missing_ok=True)  # of an earlier run; later steps take it for this one's
    if found.still.any():
        write_image(work / "ignore.png", found.still.astype("uint8") * 255)
    write_trajectory(work / "poses.json", found.trajectory)
    return lines
