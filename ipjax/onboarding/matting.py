"""The object in a photo by an installed matting package: rembg, where it is there and a model of it is, too.

Nothing is required and nothing is downloaded: rembg itself would fetch a model of 4 to 900 MB when it is first used, so
it is asked only for one whose file is here: ``models/NAME/NAME.onnx`` in its home folder, or ``NAME.onnx`` in that of
its earlier versions.
"""

import contextlib
import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

# Its models that cut out whatever stands out, best first, as long as their licences let anybody use them.
MODELS = ("birefnet-general", "isnet-general-use", "birefnet-general-lite", "u2net", "silueta", "u2netp")
_NO_CHECKSUM = "MODEL_CHECKSUM_DISABLED"  # of rembg: where it is set, a file with another checksum is not fetched anew


class MattingError(ValueError):
    """The matting package failed; the message is one sentence for the user."""


def find_matting() -> tuple[str | None, str]:
    """The model that can be used, or None and why not: the end of a sentence, empty where no package is installed."""
    if "rembg" not in sys.modules and importlib.util.find_spec("rembg") is None:
        return None, ""
    home, before = _find_homes()
    for name in MODELS:
        if (home / "models" / name / f"{name}.onnx").is_file() or (before / f"{name}.onnx").is_file():
            return name, ""
    return None, (
        f" (rembg is installed, but none of its models is in {home}, and none is downloaded without being asked: "
        "'rembg d isnet-general-use' does)"
    )


def matte(model: str, rgb: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """What a model of rembg takes for the foreground.

    Raises MattingError in one sentence: the package does not work, or its answer is no mask of the photo.
    """
    kept = os.environ.get(_NO_CHECKSUM)
    os.environ[_NO_CHECKSUM] = "1"
    try:
        with contextlib.redirect_stdout(sys.stderr):  # what it prints is no answer of ours
            rembg: Any = importlib.import_module("rembg")
            found: Any = rembg.remove(np.ascontiguousarray(rgb), session=rembg.new_session(model), only_mask=True)
    except (Exception, SystemExit) as error:  # it ends the program where its ONNX runtime is missing
        words = (str(error).strip().splitlines() or [type(error).__name__])[0]
        words = "it has no ONNX runtime: pip install 'rembg[cpu]'" if isinstance(error, SystemExit) else words
        raise MattingError(f"rembg failed ({words}); give a mask, a box around the object, or a click on it") from None
    finally:
        if kept is None:
            os.environ.pop(_NO_CHECKSUM, None)
        else:
            os.environ[_NO_CHECKSUM] = kept
    found = np.asarray(found)
    if found.shape != rgb.shape[:2]:
        raise MattingError(f"rembg's mask has the shape {list(found.shape)}, not that of the photo; give a mask")
    return found > 127


def _find_homes() -> tuple[Path, Path]:
    """Where rembg keeps its models, and where its versions before 2026 did."""
    data = os.environ.get("XDG_DATA_HOME")
    before = os.environ.get("U2NET_HOME") or os.path.join(data or "~", ".u2net")
    home = os.environ.get("REMBG_HOME") or (os.path.join(data, "rembg") if data else "~/.rembg")
    return Path(os.environ.get("U2NET_HOME") or home).expanduser(), Path(before).expanduser()
