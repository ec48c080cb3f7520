"""A search as one self-contained HTML page: the values that its template shows."""

from pathlib import Path
from typing import Any

import numpy as np

from ipjax.detection.explanation.pictures import CUT, POSED, draw_crop, draw_found, draw_proposals
from ipjax.detection.records import Detection, Detections, Ranking, Rejected, Step
from ipjax.files.pages import embed_image, render_page
from ipjax.files.storage.writing import write_text

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_MOST_RANKED = 12  # proposals of an object that the page shows, those that were estimated besides
_STAGES = {
    "propose": "cut up the frame into proposals",
    "cut": "cut out the proposals",
    "glance": "describe all of them, at a part of their size",
    "rank": "compare them with the objects",
    "describe": "describe crops whole",
    "verify": "estimate poses in proposals",
    "verify rest": "estimate poses in what an instance left",
    "verify again": "estimate poses in the masks of poses",
    "mask": "draw masks of poses",
    "assign": "decide between objects",
    "compile": "compile",
}


def explain(path: str | Path, found: Detections, title: str = "a frame") -> None:
    """Write a page of how objects were sought in a frame: the proposals; of each object their ranking, the estimates in
    the best of them, what was accepted, and why every other was not; and what each stage took.

    Args:
      path: of the page, one HTML file with its pictures inside.
      found: of `Detector.detect`, whose records have all that is shown.
      title: the frame's name.

    Raises:
      OSError: it cannot be written.
    """
    told, rejected = found.told()
    masks, rgb = found.proposals.masks, found.scene.rgb
    tried = sorted({one.proposal for one in (*told, *rejected)})
    total = sum(found.seconds.values())
    objects = [_show_object(found, ranking, told, rejected) for ranking in found.rankings]
    page = render_page(
        _TEMPLATE,
        title=title,
        sought=len(found.names),
        present=sum(one.present for one in told),
        count=len(masks),
        tried=len(tried),
        seconds=f"{total:.1f}",
        overlay=embed_image(draw_found(found.scene, told), "jpg"),
        rows=[_show_row(one) for one in told],
        proposals=embed_image(draw_proposals(rgb, masks, tried, found.clicks), "jpg"),
        clicks=[f"{x:g}, {y:g}" for x, y in found.clicks],
        objects=objects,
        nothing=[name for index, name in enumerate(found.names) if index not in {one.index for one in found.rankings}],
        cut_colour=_in_hexadecimal(CUT),
        posed_colour=_in_hexadecimal(POSED),
        stages=[
            (_STAGES.get(name, name), f"{spent:.2f}", f"{100 * spent / max(total, 1e-9):.1f}")
            for name, spent in sorted(found.seconds.items(), key=lambda one: -one[1])
        ],
    )
    write_text(path, page)


def _in_hexadecimal(colour: tuple[int, int, int]) -> str:
    return "#" + "".join(f"{channel:02x}" for channel in colour)


def _show_row(one: Detection) -> dict[str, str]:
    x, y, width, height = one.box
    return {
        "name": one.name,
        "state": "found" if one.present else "a guess",
        "confidence": f"{one.confidence:.2f}",
        "size": f"{1e3 * float(one.result.estimate.diameter):.0f} mm",
        "box": f"{x}, {y}, {width} × {height}",
        "proposal": str(one.proposal),
    }


def _show_object(
    found: Detections, ranking: Ranking, told: tuple[Detection, ...], rejected: tuple[Rejected, ...]
) -> dict[str, Any]:
    """One object's section: what became of it in a sentence, the ranking, and every estimate."""
    mine = [one for one in told if one.index == ranking.index]
    others = sorted((one for one in rejected if one.index == ranking.index), key=lambda one: -(one.score or 0))
    hits = [one for one in mine if one.present]
    if hits:
        many = f"{len(hits)} instances, with confidences" if len(hits) > 1 else "found, with a confidence"
        verdict = f"{many} of {', '.join(f'{one.confidence:.2f}' for one in hits)}"
    elif mine:
        verdict = f"not here, or not seen well enough: the best guess has a confidence of {mine[0].confidence:.2f}"
    else:
        verdict = "nothing that was tried could be it"
    accepted = {one.proposal for one in hits}
    shown = max(_MOST_RANKED, ranking.estimated)
    rest = ranking.similarity[shown:]
    return {
        "name": ranking.name,
        "verdict": verdict,
        "good": bool(hits),
        "ranked": [
            {
                "image": _crop(found, found.proposals.masks[number]),
                "number": number,
                "similarity": f"{similarity:.2f}",
                "state": "accepted" if number in accepted else "estimated" if place < ranking.estimated else "",
                "glanced": place >= ranking.whole,
            }
            for place, (number, similarity) in enumerate(
                zip(ranking.proposals[:shown].tolist(), ranking.similarity[:shown], strict=True)
            )
        ],
        "rest": f"{len(rest)} more, down to {rest.min():.2f}" if len(rest) else "",
        "trials": [_show_trial(found, one, ("accepted" if one.present else "a guess"), _praise(one)) for one in mine]
        + [_show_trial(found, one, one.why.value, _blame(one)) for one in others],
    }


def _praise(one: Detection) -> str:
    if one.present:
        return f"present; the mask that its pose gives overlaps the proposal by {one.overlap:.0%}"
    return "the surest of what was tried, but too unsure to be called present"


def _blame(one: Rejected) -> str:
    if one.rival is None:
        return one.reason
    return f"{one.reason} (proposal {one.rival.proposal}, confidence {one.rival.confidence:.2f})"


def _show_trial(found: Detections, one: Detection | Rejected, state: str, words: str) -> dict[str, Any]:
    return {
        "number": one.proposal,
        "similarity": f"{one.similarity:.2f}",
        "state": state,
        "good": state == "accepted",
        "words": words,
        "steps": [_show_step(found, step) for step in one.steps],
    }


def _show_step(found: Detections, step: Step) -> dict[str, Any]:
    if not step.success:
        told = "no pose"
    else:
        told = f"confidence {step.confidence:.2f}, score {step.score:.2f}, {1e3 * step.diameter:.0f} mm"
    return {"where": step.where, "image": _crop(found, step.mask, step.posed), "told": told}


def _crop(found: Detections, mask: np.ndarray, posed: np.ndarray | None = None) -> str:
    if not mask.any() and (posed is None or not posed.any()):
        mask = np.ones_like(mask)
    return embed_image(draw_crop(found.scene.rgb, mask, posed), "jpg")
