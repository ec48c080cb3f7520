"""A page with the findings and a small picture of every frame that was looked at."""

from collections.abc import Sequence
from pathlib import Path

from ipjax.capture.checks.findings import FACT, UNUSABLE, WARNING, Finding, find_blurred
from ipjax.capture.checks.inspection import Inspection
from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text

_TEMPLATE = Path(__file__).with_name("page.html.jinja")


def write_page(path: Path, inspection: Inspection, findings: Sequence[Finding]) -> Path:
    """Write the page; returns its path.

    Raises:
      OSError: it cannot be written.
    """
    names = [inspection.capture.names[i] for i in inspection.looked_at]
    blurred = find_blurred(inspection)
    frames = []
    overlaps = {pair.first: pair for pair in inspection.pairs}
    for name, image, is_blurred in zip(names, inspection.images, blurred, strict=True):
        pair = overlaps.get(name)
        frames.append(
            {
                "name": name,
                "rgb": embed_image(image.rgb, "jpg"),
                "depth": embed_image(image.depth, "jpg"),
                "blurred": bool(is_blurred),
                "known": f"{100 * image.known:.0f} %",
                "sharpness": f"{image.sharpness:.2f}",
                "distance": f"{image.distance:.2f} m",
                "matches": "" if pair is None else str(pair.matches),
                "overlap": "" if pair is None or pair.overlap is None else f"{100 * pair.overlap:.0f} %",
            }
        )
    groups = [(kind, [f for f in findings if f.kind == kind]) for kind in (UNUSABLE, WARNING, FACT)]
    return write_text(
        path, render_page(_TEMPLATE, name=inspection.capture.folder.resolve().name, groups=groups, frames=frames)
    )
