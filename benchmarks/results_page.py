"""``python -m benchmarks.results_page RUN [RUN …] --data DATA [-o PAGE]``: the page of results.

Makes a page from folders that ``ipjax evaluate`` (or `benchmarks.classical`) wrote: PAGE.md holds numbers alone;
PAGE.html, complete in itself, adds error curves, bars per object, and the best, median and worst targets of `Config()`
drawn over their photos. That page holds photos of the data set: it is kept out of the repository.
``--studies FILE`` instead of folders makes the page of all that `benchmarks.evaluation` ran.
"""

import argparse
import base64
import dataclasses
import html
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import commit, describe_device
from ipjax.bop.evaluation import FEW, SIZED
from ipjax.files.storage.parsing import parse_json, read_json
from ipjax.files.storage.writing import read_lines, write_text
from ipjax.transforms import Similarity

COLOURS = ("#1b6ca8", "#d1495b", "#2e8b57", "#b8860b", "#6a4c93")
HEADS = {"vsd": "AR_VSD", "mssd": "AR_MSSD", "mspd": "AR_MSPD", "ar": "AR"}


@dataclasses.dataclass(frozen=True)
class Study:
    """Runs on one data set with one set of meshes."""

    title: str
    data: Path
    models: Path | None
    runs: list[dict[str, Any]]

    @property
    def metrics(self) -> list[str]:
        """The recalls that all runs have, in the order of the tables."""
        return [n for n in HEADS if all(n in run["all_frames"]["recalls"] for run in self.runs)]

    @property
    def main(self) -> dict[str, Any]:
        """The run whose targets are drawn: `Config()` where it is there."""
        return next((run for run in self.runs if "default" in run["method"]), self.runs[0])


def read_studies(path: Path) -> list[Study]:
    """What `benchmarks.evaluation` ran."""
    if not path.is_file():
        raise SystemExit(f"{path}: no such file; run python -m benchmarks.evaluation first")
    entries = read_json(path)
    return [
        Study(e["title"], Path(e["data"]), Path(e["models"]), [read_run(Path(folder)) for folder in e["runs"]])
        for e in entries
    ]


def read_run(folder: Path) -> dict[str, Any]:
    """What a run wrote: its score and its settings."""
    score = folder / "score.json"
    if not score.is_file():
        raise SystemExit(f"{folder}: no score.json; let 'ipjax evaluate' finish there")
    run = read_json(score)
    run["settings"] = parse_json(read_lines(folder / "results.jsonl")[0])["settings"]
    run["folder"] = folder
    return run


def percent(value: float | None, interval=None) -> str:
    """A share in %, with its interval."""
    if value is None:
        return "–"
    text = f"{100 * value:.1f}"
    return text if not interval else f"{text} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def parts(run: dict) -> dict[str, dict]:
    """Recalls by title, the headline first."""
    return {"one frame per scene": run["one_frame_per_scene"], "all frames": run["all_frames"], **run["without"]}


def knows_size(run: dict) -> bool:
    """Whether the method was told the size of the objects, so that it had no scale to find."""
    return any("told each object's true size" in note for note in run["notes"])


def overview(studies: list[Study]) -> list[list[str]]:
    """A row for each run of each study: the headline."""
    rows = [["data and meshes", "method", "targets", *HEADS.values(), "all frames: AR", "rotation °", "translation mm"]]
    rows[0] += ["scale %", "s per image"]
    for study in studies:
        for run in study.runs:
            part, seconds = run["one_frame_per_scene"], run["seconds_per_image"]
            cells = [percent(part["recalls"].get(n), part["intervals"].get(n) if n == "ar" else None) for n in HEADS]
            cells += [percent(run["all_frames"]["recalls"].get("ar"))]
            cells += [*median_cells(run), "–" if seconds is None else f"{seconds:.1f}"]
            rows.append([study.title, run["method"], str(part["targets"]), *cells])
    return rows


def median_cells(run: dict) -> list[str]:
    """Rotation, translation, scale; the last is no error of a method that was told it."""
    m = run["medians"]
    cells = [f"{m[k]:.1f}" if k in m else "–" for k in ("rotation_deg", "translation_mm", "scale_percent")]
    return [*cells[:2], "given" if knows_size(run) else cells[2]]


def tables(study: Study) -> list[tuple[str, list[list[str]]]]:
    """Headings and rows, the first row being the columns' names."""
    runs, names = study.runs, study.metrics
    found = []
    for title in parts(runs[0]):
        rows = [["method", "images", "targets", *(HEADS[n] for n in names)]]
        for run in runs:
            part = parts(run).get(title)
            if part is not None:
                cells = [percent(part["recalls"].get(n), part["intervals"].get(n)) for n in names]
                rows.append([run["method"], str(part["images"]), str(part["targets"]), *cells])
        heading = title[0].upper() + title[1:] + (" (the headline)" if title == "one frame per scene" else "")
        found.append((heading + ": average recalls, %, with 95 % bootstrap intervals over images", rows))
    rows = [["method", "rotation °", "translation mm", "scale %", "not found", "ADD-S AUC", "ADD(-S) AUC"]]
    rows[0] += ["ADD-S < 0.1 d, %", "s per image"]
    for run in runs:
        a, seconds = run["add"], run["seconds_per_image"]
        cells = [*median_cells(run), str(run["missing"])]
        few = run["all_frames"]["targets"] < FEW
        cells += [percent(None if few else a.get(k)) for k in ("add_s_auc", "add_or_s_auc")]
        cells += [percent(a.get("add_s_01d"))]
        rows.append([run["method"], *cells, "–" if seconds is None else f"{seconds:.1f}"])
    found.append(("Medians of what was found, areas under the curve to 10 cm, time", rows))
    if any(run["all_frames"].get("sized") for run in runs):
        rows = [["method", *(name if "size" in name else f"AR {name}" for name in SIZED.values())]]
        for run in runs:
            sized = run["all_frames"].get("sized", {})
            cells = [
                "given" if knows_size(run) and name.startswith("size") else percent(sized.get(name)) for name in SIZED
            ]
            rows.append([run["method"], *cells])
        heading = (
            "The model at its estimated size, which BOP's recalls do not see, %, all frames; errors in true diameters"
        )
        found.append((heading, rows))
    metric = names[-1]
    rows = [["object", "targets", *(run["method"] for run in runs), "best"]]
    wins = dict.fromkeys(range(len(runs)), 0)
    for obj, entry in sorted(runs[0]["objects"].items(), key=lambda pair: int(pair[0])):
        values = [run["objects"].get(obj, {}).get(metric) for run in runs]
        best = max(v for v in values if v is not None)
        winners = [i for i, v in enumerate(values) if v == best]
        if len(winners) == 1:
            wins[winners[0]] += 1
        who = runs[winners[0]]["method"] if len(winners) == 1 else "tie"
        rows.append([obj, f"{entry['targets']:.0f}", *(percent(v) for v in values), who if len(runs) > 1 else ""])
    if len(runs) > 1:
        rows.append(["wins", "", *(str(wins[i]) for i in range(len(runs))), ""])
    found.append((f"{HEADS[metric]} per object, %, all frames", rows))
    return found


def preamble(studies: list[Study]) -> list[str]:
    """Where the numbers come from."""
    runs = [run for study in studies for run in study.runs]
    device = describe_device()
    lines = [
        "Masks as annotated; objects onboarded from normalised meshes, so that ipjax has their size to find. The "
        "classical baseline (FPFH, RANSAC, ICP) is told their true size.",
        f"Device of this page: {device['device']}, {device['cores']} cores, "
        + ("no GPU" if device["platform"] == "cpu" else str(device["platform"]))
        + f"; jax {device['jax']}, Python {device['python']}; commit {commit()}, {time.strftime('%Y-%m-%d')}. Seconds "
        "per image are for all of its targets, as measured, on whatever else the machine was doing.",
    ]
    lines += [
        f"Encoder: {e}." for e in dict.fromkeys(r["settings"]["encoder"] for r in runs if "encoder" in r["settings"])
    ]
    views = [o.get("onboarding", {}) for run in runs for o in run["settings"].get("objects", {}).values()]
    lines += [
        f"Templates: {d} directions × {r} rolls."
        for d, r in sorted({(v["directions"], v["rolls"]) for v in views if "directions" in v})
    ]
    if any(run["without"] for run in runs):
        lines.append("Without SCENE/IMAGE: its annotation is in doubt, by the data set's own notes.")
    if any(run["all_frames"]["targets"] < 500 for run in runs):
        lines.append("Mini sets: not to be compared with published figures of the full data sets.")
    return lines


def notes(study: Study) -> list[str]:
    """What the runs have to say of themselves, once each."""
    told = [note for run in study.runs for note in run["notes"] if "true size" not in note]
    return [f"{note}." for note in dict.fromkeys(told)]


def markdown(studies: list[Study]) -> str:
    """The page of numbers."""
    lines = ["# Accuracy", "", "Made by `python -m benchmarks.evaluation`; do not edit by hand.", ""]
    lines += [f"* {line}" for line in preamble(studies)]
    lines += ["", "## In short: one frame per scene", "", *markdown_table(overview(studies))]
    for study in studies:
        lines += ["", f"## {study.title}", *(f"\n{note}" for note in notes(study))]
        for title, rows in tables(study):
            lines += ["", f"### {title}", "", *markdown_table(rows)]
    return "\n".join(lines) + "\n"


def markdown_table(rows: list[list[str]]) -> list[str]:
    """Its lines; numbers to the right."""
    head = ["| " + " | ".join(rows[0]) + " |", "|" + " --- |" + " ---: |" * (len(rows[0]) - 1)]
    return head + ["| " + " | ".join(row) + " |" for row in rows[1:]]


def curve(runs: list[dict], key: str, unit: float, limit: float, label: str) -> str:
    """An SVG of the share of all instances with an error below x."""
    width, height, left, bottom = 420, 260, 44, 36
    parts = [f'<svg viewBox="0 0 {width} {height}" width="{width}" role="img" aria-label="{html.escape(label)}">']
    across, up = width - left - 10, height - bottom - 10
    for k in range(5):
        y = 10 + up * (1 - k / 4)
        x = left + across * k / 4
        parts.append(f'<line x1="{left}" y1="{y}" x2="{left + across}" y2="{y}" stroke="#ddd"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4}" text-anchor="end">{25 * k} %</text>')
        parts.append(f'<text x="{x}" y="{height - bottom + 16}" text-anchor="middle">{limit * k / 4:g}</text>')
    for colour, run in zip(COLOURS, runs, strict=False):
        if key == "scale" and knows_size(run):
            continue
        values = [math.inf if i[key] is None else i[key] * unit for i in run["instances"]]
        points, total = [f"{left},{10 + up}"], len(values)
        for count, value in enumerate(sorted(v for v in values if v <= limit), start=1):
            x = left + across * value / limit
            points += [
                f"{x:.1f},{10 + up * (1 - (count - 1) / total):.1f}",
                f"{x:.1f},{10 + up * (1 - count / total):.1f}",
            ]
        points.append(f"{left + across},{points[-1].split(',')[1]}")
        parts.append(f'<polyline points="{" ".join(points)}" fill="none" stroke="{colour}" stroke-width="2"/>')
    parts.append(
        f'<text x="{left + across / 2}" y="{height - 4}" text-anchor="middle">{html.escape(label)}</text></svg>'
    )
    return "".join(parts)


def bars(study: Study) -> str:
    """An SVG of every object's average recall, a bar per run."""
    runs, metric = study.runs, study.metrics[-1]
    objects = sorted(runs[0]["objects"], key=int)
    step = max(14 * len(runs) + 8, 26)
    width, height = 50 + step * len(objects), 220
    parts = [f'<svg viewBox="0 0 {width} {height}" width="{width}" role="img" aria-label="{HEADS[metric]} per object">']
    for k in range(5):
        y = 10 + 180 * (1 - k / 4)
        parts.append(f'<line x1="40" y1="{y}" x2="{width}" y2="{y}" stroke="#ddd"/>')
        parts.append(f'<text x="36" y="{y + 4}" text-anchor="end">{25 * k}</text>')
    for place, obj in enumerate(objects):
        for i, (colour, run) in enumerate(zip(COLOURS, runs, strict=False)):
            value = run["objects"].get(obj, {}).get(metric) or 0.0
            x, tall = 46 + place * step + 14 * i, 180 * value
            title = f"object {obj}, {html.escape(run['method'])}: {100 * value:.1f}"
            parts.append(
                f'<rect x="{x}" y="{190 - tall:.1f}" width="12" height="{tall:.1f}" fill="{colour}">'
                f"<title>{title}</title></rect>"
            )
        parts.append(f'<text x="{46 + place * step + 7 * len(runs)}" y="206" text-anchor="middle">{obj}</text>')
    return "".join(parts) + "</svg>"


def pictures(study: Study, side: int = 260) -> list[tuple[str, str]]:
    """Captions and data URLs of the best, median and worst targets (by MSSD of what was found): outlines on the photo,
    and the model at the estimate."""
    import cv2

    from ipjax.bop.dataset import MM, Dataset, read_results
    from ipjax.inference.drawing import silhouette

    run = study.main
    dataset = Dataset(study.data, run["dataset"].rsplit("-", 1)[1], models=study.models)
    diameters = {obj: info.diameter for obj, info in dataset.models().items()}
    error = lambda i: math.inf if i["mssd"] is None else i["mssd"] / diameters[i["obj_id"]]
    ranked = sorted((i for i in run["instances"] if i["found"]), key=error)
    if not ranked:
        return []
    middle = len(ranked) // 2
    if len(ranked) < 9:
        chosen = [(f"{k} of {len(ranked)}", i) for k, i in enumerate(ranked, start=1)]
    else:
        chosen = [("best", i) for i in ranked[:3]]
        chosen += [("median", i) for i in ranked[middle - 1 : middle + 2]]
        chosen += [("worst", i) for i in ranked[-3:][::-1]]
    kept = run["folder"] / f"{run['method'].replace('_', '-')}_{run['dataset']}.csv"
    rows = {(r.scene_id, r.im_id, r.obj_id, r.score): r for r in read_results(kept)}
    drawn = draw_models(study, [one for _, one in chosen], rows)
    found = []
    for (kind, one), model in zip(chosen, drawn, strict=True):
        place = (one["scene_id"], one["im_id"], one["obj_id"])
        frame, mesh, row = dataset.frame(*place[:2]), dataset.mesh(place[2]), rows[*place, one["score"]]
        truth = next(t for t in dataset.truths(*place[:2]) if t.index == one["index"])
        shapes = [
            silhouette(pose @ mesh.vertices, mesh.faces, frame.camera, *frame.rgb.shape[:2])
            for pose in (row_pose(truth), row_pose(row, MM))
        ]
        box = square_around(shapes[0] | shapes[1])
        photo = resize(cut(frame.rgb, box), side)
        for shape, colour in zip(shapes, ((40, 220, 90), (235, 50, 60)), strict=True):
            enlarged = resize(cut(shape.astype(np.uint8) * 255, box), side, smooth=True) > 127
            outline, _ = cv2.findContours(enlarged.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(photo, outline, -1, colour, 3 if colour[0] < 100 else 1, cv2.LINE_AA)
        grey = (0.35 * frame.rgb.mean(-1, keepdims=True) + 120).astype(np.uint8)
        beside = np.where(model.any(-1, keepdims=True), model, np.repeat(grey, 3, axis=-1))
        both = np.concatenate([photo, resize(cut(beside, box), side)], axis=1)
        _, coded = cv2.imencode(".jpg", both[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
        off = f"{100 * error(one):.0f} % of the diameter" if math.isfinite(error(one)) else "more than a diameter"
        caption = (
            f"{kind}: scene {place[0]}, image {place[1]}, object {place[2]}; MSSD {off}, rotation "
            f"{math.degrees(one['rotation']):.0f}°, translation {one['translation'] / MM:.0f} mm"
        )
        found.append((caption, "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()))
    return found


def row_pose(row: Any, unit: float = 1.0) -> Similarity[np.ndarray]:
    """``camera_from_model`` in metres of an annotation, or of a line of a result file; ``unit``: metres in its unit."""
    rotation = np.reshape(np.asarray(row.rotation, np.float64), (3, 3))
    return Similarity(rotation, np.asarray(row.translation, np.float64) * unit, np.ones(()))


def draw_models(study: Study, chosen: list[dict], rows: dict) -> list[np.ndarray]:
    """The scanned model of each target at its estimate, on black: outlines cannot tell a front from a back."""
    import jax

    from ipjax.bop.dataset import MM, Dataset
    from ipjax.records import Camera
    from ipjax.rendering.render import render_each

    dataset = Dataset(study.data, study.main["dataset"].rsplit("-", 1)[1], models=study.models)
    pictures: list[np.ndarray] = [np.zeros(0)] * len(chosen)
    by_size: dict[tuple[int, int], list[int]] = {}
    for i, one in enumerate(chosen):
        by_size.setdefault(dataset.image_size(one["scene_id"], one["im_id"]), []).append(i)
    for (width, height), mine in by_size.items():
        objects = sorted({chosen[i]["obj_id"] for i in mine})
        poses, cameras = [], []
        for i in mine:
            one = chosen[i]
            poses.append(row_pose(rows[one["scene_id"], one["im_id"], one["obj_id"], one["score"]], MM))
            cameras.append(dataset.camera(one["scene_id"], one["im_id"])[0])
        K = np.stack(cameras)
        drawn = render_each(
            [dataset.mesh(obj, "models") for obj in objects],
            [objects.index(chosen[i]["obj_id"]) for i in mine],
            jax.tree.map(lambda *x: np.stack(x), *poses).to_jax(),
            Camera.from_matrix(K),
            height,
            width,
        )
        for i, rgb, mask in zip(mine, drawn.rgb, drawn.mask, strict=True):
            pictures[i] = np.maximum(rgb, 1) * mask[..., None]  # black parts of the object are no background
    return pictures


def square_around(covered: np.ndarray) -> tuple[int, int, int]:
    """Top, left and side of a square around what is covered, with a margin; it may reach out of the image."""
    y, x = np.nonzero(covered) if covered.any() else (np.array([0, covered.shape[0] - 1]),) * 2
    half = int(max(np.ptp(x), np.ptp(y)) * 0.6) + 10
    return (int(y.min()) + int(y.max())) // 2 - half, (int(x.min()) + int(x.max())) // 2 - half, 2 * half


def cut(image: np.ndarray, box: tuple[int, int, int]) -> np.ndarray:
    """The square of an image, black where it reaches out."""
    top, left, side = box
    result = np.zeros((side, side, *image.shape[2:]), image.dtype)
    inside = image[max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)]
    down, across = max(-top, 0), max(-left, 0)
    result[down : down + inside.shape[0], across : across + inside.shape[1]] = inside
    return result


def resize(image: np.ndarray, side: int, *, smooth: bool = False) -> np.ndarray:
    """A square image of another size."""
    import cv2

    way = cv2.INTER_AREA if len(image) > side and not smooth else cv2.INTER_LINEAR
    return np.ascontiguousarray(cv2.resize(image, (side, side), interpolation=way))


def html_table(rows: list[list[str]]) -> str:
    """A table, its first row being the head."""
    head = "".join(f"<th>{html.escape(c)}</th>" for c in rows[0])
    body = ["<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows[1:]]
    return f"<div class=wide><table><tr>{head}</tr>{''.join(body)}</table></div>"


def page(studies: list[Study]) -> str:
    """The whole page, in one file."""
    style = (
        "body{font:15px/1.5 system-ui,sans-serif;max-width:1400px;margin:2em auto;padding:0 1em;color:#222}"
        "table{border-collapse:collapse;margin:.5em 0;font-size:14px}td,th{padding:.2em .7em;border-bottom:1px solid "
        "#ddd;text-align:right;white-space:nowrap}td:first-child,th:first-child{text-align:left}figure{display:"
        "inline-block;width:540px;margin:.4em;vertical-align:top}figcaption{font-size:13px}svg text{font-size:11px;"
        "fill:#444}.key span{padding:.1em .6em;color:#fff;margin-right:.5em;border-radius:3px}.wide{overflow-x:auto}"
        "h2{margin-top:2em;border-bottom:2px solid #1b6ca8}"
    )
    out = ['<!doctype html><html lang="en"><meta charset="utf-8"><title>Accuracy</title>', f"<style>{style}</style>"]
    out.append("<h1>Accuracy</h1><ul>" + "".join(f"<li>{html.escape(x)}</li>" for x in preamble(studies)) + "</ul>")
    out.append(f"<h2>In short: one frame per scene</h2>{html_table(overview(studies))}")
    for study in studies:
        runs = study.runs
        out.append(f"<h2>{html.escape(study.title)}</h2>")
        out += [f"<p>{html.escape(note)}</p>" for note in notes(study)]
        for title, rows in tables(study):
            out.append(f"<h3>{html.escape(title)}</h3>{html_table(rows)}")
        key = "".join(
            f'<span style="background:{colour}">{html.escape(run["method"])}</span>'
            for colour, run in zip(COLOURS, runs, strict=False)
        )
        out.append(f"<h3>Share of all targets below an error</h3><p class=key>{key}</p>")
        out.append(curve(runs, "rotation", 180 / math.pi, 60, "rotation error, degrees (nearest symmetric pose)"))
        out.append(curve(runs, "translation", 1000, 60, "translation error, mm"))
        if runs[0]["add"]:
            out.append(curve(runs, "add_s", 1000, 40, "ADD-S, mm"))
        out.append(curve(runs, "scale", 100, 40, "scale error, % (methods that have to find it)"))
        out.append(f"<h3>{HEADS[study.metrics[-1]]} per object, %</h3><p class=key>{key}</p>")
        out.append(f"<div class=wide>{bars(study)}</div>")
        out.append(
            f"<h3>Targets of {html.escape(study.main['method'])}</h3><p>Left: the photo, outlined where the object is "
            "annotated (green) and estimated (red). Right: the scanned model, drawn at the estimate.</p>"
        )
        for caption, url in pictures(study):
            told = html.escape(caption)
            out.append(f'<figure><img alt="{told}" src="{url}" width=520><figcaption>{told}</figcaption></figure>')
    return "\n".join(out) + "</html>\n"


def write(studies: list[Study], stem: Path) -> None:
    """PAGE.md and PAGE.html."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    for suffix, text in ((".md", markdown(studies)), (".html", page(studies))):
        path = stem.with_name(stem.name + suffix)
        write_text(path, text)
        print(f"{path}: {len(text.encode()) / 1024:.0f} KB")


def main(arguments: list[str] | None = None) -> None:
    """Read the runs, write the pages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.results_page", description=__doc__.split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN", help="folders that 'ipjax evaluate' wrote")
    parser.add_argument("--data", type=Path, help="their data set, for the photos")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from")
    parser.add_argument("--studies", type=Path, metavar="FILE", help="studies.json of benchmarks.evaluation, instead")
    parser.add_argument("-o", "--page", type=Path, default=Path("out/accuracy"), help="without .md, .html")
    options = parser.parse_args(arguments)
    if (options.studies is None) == (not options.runs) or (options.runs and options.data is None):
        parser.error("give folders of results and their --data, or --studies")
    if options.studies is not None:
        studies = read_studies(options.studies)
    else:
        runs = [read_run(folder) for folder in options.runs]
        studies = [Study(runs[0]["dataset"], options.data, options.models, runs)]
    write(studies, options.page)


if __name__ == "__main__":
    main()
