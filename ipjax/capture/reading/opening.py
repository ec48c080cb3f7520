"""Opening a capture, whatever form it has."""

from pathlib import Path
from typing import Any

from ipjax.capture.reading.bop import is_bop, open_bop
from ipjax.capture.reading.frames import is_frames, open_frames
from ipjax.capture.reading.numbered import is_numbered, open_numbered
from ipjax.capture.reading.tum import is_tum, open_tum
from ipjax.capture.records import Capture, CaptureError
from ipjax.files.cameras.intrinsics import check_depth_scale

# In the order in which they are tried: our own folder is the one with the fewest marks.
FORMS = {
    "bop": (is_bop, open_bop),
    "tum": (is_tum, open_tum),
    "numbered": (is_numbered, open_numbered),
    "frames": (is_frames, open_frames),
}


def open_capture(
    folder: str | Path,
    *,
    form: str | None = None,
    camera: Any = None,
    depth_scale: float | int | None = None,
    poses: bool = True,
    every: int = 1,
) -> Capture:
    """A capture on disc; its frames are read when they are asked for.

    Args:
      folder: of one of the forms: our own ("frames": rgb/, depth/, camera.json), a TUM RGB-D sequence ("tum"), files
        ``frame-N.color.png`` as in 7-Scenes ("numbered"), one scene of a BOP data set ("bop").
      form: which of them, where the folder does not say so itself.
      camera: of the colour images: a file, fx, fy, cx, cy, K or `Intrinsics`; default: the folder's own. Of TUM's
        sequences "tum-fr1", "tum-fr2" or "tum-fr3" is known by name.
      depth_scale: metres per number of the depth images; default: the camera file's, or the form's.
      poses: whether to take the poses that the folder has.
      every: take each n-th frame only.

    Raises:
      CaptureError: no such folder, no form that is known, or files that are missing, unequal or unreadable; one
        sentence that says what was found and what to do.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder")
    if every < 1:
        raise CaptureError(f"every {every}-th frame cannot be taken; give 1 or more")
    if depth_scale is not None:
        try:
            check_depth_scale(depth_scale)
        except ValueError as error:
            raise CaptureError(str(error)) from None
    if form is None:
        form = next((name for name, (fits, _) in FORMS.items() if fits(folder)), None)
        if form is None:
            raise CaptureError(
                f"{folder}: no capture is recognised in it: expected are rgb/ with depth/ and camera.json, a TUM RGB-D "
                "sequence (rgb.txt, depth.txt), frame-N.color.png with frame-N.depth.png, or a scene of a BOP data set "
                "(scene_camera.json)"
            )
    if form not in FORMS:
        raise CaptureError(f"no form of captures is called {form!r}; one of {', '.join(FORMS)}")
    return FORMS[form][1](folder, camera=camera, depth_scale=depth_scale, poses=poses, chosen=slice(None, None, every))
