"""``python -m benchmarks.results_page RUN [RUN …] --data DATA [--markdown FILE] [--html FILE]``.

Makes a page of results from folders that ``ipjax evaluate`` wrote: a Markdown file of numbers alone, and an HTML page,
complete in itself, with error curves, bars per object, and the best, median and worst targets of the first run drawn
over their photos. That page holds photos of the data set: keep it out of the repository.
"""

import argparse
import base64
import html
import json
import math
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import describe_device

COLOURS = ("#1b6ca8", "#d1495b", "#2e8b57", "#b8860b", "#6a4c93")
HEADS = {"vsd": "AR_VSD", "mssd": "AR_MSSD", "mspd": "AR_MSPD", "ar": "AR"}


def read_run(folder: Path) -> dict[str, Any]:
    """What a run wrote: its score and its settings."""
    score = folder / "score.json"
    if not score.is_file():
        raise SystemExit(f"{folder}: no score.json; let 'ipjax evaluate' finish there")
    run = json.loads(score.read_text())
    with open(folder / "results.jsonl", encoding="utf-8") as file:
        run["settings"] = json.loads(file.readline())["settings"]
    run["folder"] = folder
    return run


def commit() -> str:
    """The commit of this checkout, with a mark where files differ from it; "unknown" outside of one."""
    try:
        said = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=10"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return said.stdout.strip()


def percent(value: float | None, interval=None) -> str:
    """A share in %, with its interval."""
    if value is None:
        return "–"
    text = f"{100 * value:.1f}"
    return text if not interval else f"{text} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def tables(runs: list[dict]) -> list[tuple[str, list[list[str]]]]:
    """Headings and rows, the first row being the columns' names."""
    names = [n for n in HEADS if n in runs[0]["all_frames"]["recalls"]]
    found = []
    for title, key in (("One frame per scene (the headline)", "one_frame_per_scene"), ("All frames", "all_frames")):
        rows = [["method", "images", "targets", *(HEADS[n] for n in names)]]
        for run in runs:
            part = run[key]
            cells = [percent(part["recalls"].get(n), part["intervals"].get(n)) for n in names]
            rows.append([run["method"], str(part["images"]), str(part["targets"]), *cells])
        found.append((title + ": average recalls, %, with 95 % bootstrap intervals over images", rows))
    rows = [["method", "rotation °", "translation mm", "scale %", "not found", "ADD-S AUC", "ADD(-S) AUC"]]
    rows[0] += ["ADD-S < 0.1 d, %", "s per image"]
    for run in runs:
        m, a = run["medians"], run["add"]
        cells = [f"{m[k]:.1f}" if k in m else "–" for k in ("rotation_deg", "translation_mm", "scale_percent")]
        cells += [str(run["missing"]), *(percent(a.get(k)) for k in ("add_s_auc", "add_or_s_auc", "add_s_01d"))]
        seconds = run["seconds_per_image"]
        rows.append([run["method"], *cells, "–" if seconds is None else f"{seconds:.1f}"])
    found.append(("Medians of what was found, areas under the curve to 10 cm, time", rows))
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
    rows.append(["wins", "", *(str(wins[i]) for i in range(len(runs))), ""])
    found.append((f"{HEADS[metric]} per object, %", rows))
    return found


def preamble(runs: list[dict]) -> list[str]:
    """Where the numbers come from."""
    device = describe_device()
    lines = [
        f"{runs[0]['dataset']}, masks as annotated, objects onboarded from normalised meshes (the method "
        "does not know their size unless its name says otherwise).",
        f"Device of this page: {device['device']}, {device['cores']} cores, "
        + ("no GPU" if device["platform"] == "cpu" else device["platform"])
        + f"; jax {device['jax']}, Python {device['python']}; commit {commit()}, {time.strftime('%Y-%m-%d')}.",
    ]
    lines += [f"Encoder: {e}." for e in dict.fromkeys(run["settings"].get("encoder", "none") for run in runs)]
    views = [o.get("onboarding", {}) for run in runs for o in run["settings"].get("objects", {}).values()]
    lines += [
        f"Templates: {d} directions × {r} rolls."
        for d, r in sorted({(v["directions"], v["rolls"]) for v in views if "directions" in v})
    ]
    lines += [f"{note}." for note in dict.fromkeys(note for run in runs for note in run["notes"])]
    if runs[0]["all_frames"]["targets"] < 500:
        lines.append("A mini set: not to be compared with published figures of the full data set.")
    return lines


def markdown(runs: list[dict]) -> str:
    """The page of numbers."""
    lines = ["# Accuracy", "", "Made by `python -m benchmarks.results_page`; do not edit by hand.", ""]
    lines += [f"* {line}" for line in preamble(runs)]
    for title, rows in tables(runs):
        lines += ["", f"## {title}", "", "| " + " | ".join(rows[0]) + " |", "|" + " --- |" * len(rows[0])]
        lines += ["| " + " | ".join(row) + " |" for row in rows[1:]]
    return "\n".join(lines) + "\n"


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


def bars(runs: list[dict]) -> str:
    """An SVG of every object's average recall, a bar per run."""
    metric = [n for n in HEADS if n in runs[0]["all_frames"]["recalls"]][-1]
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


def pictures(run: dict, data: Path, models: Path | None, side: int = 320) -> list[tuple[str, str]]:
    """Captions and data URLs of the best, median and worst targets (by MSSD): truth green, estimate red."""
    import cv2

    from ipjax.host.bop import MM, Dataset, read_results
    from ipjax.host.drawing import silhouette

    dataset = Dataset(data, run["dataset"].rsplit("-", 1)[1], models=models)
    diameters = {obj: info.diameter for obj, info in dataset.models().items()}
    error = lambda i: math.inf if i["mssd"] is None else i["mssd"] / diameters[i["obj_id"]]
    ranked = sorted((i for i in run["instances"] if i["found"]), key=error)
    if not ranked:
        return []
    middle = len(ranked) // 2
    chosen = [("best", i) for i in ranked[:3]]
    chosen += [("median", i) for i in ranked[max(middle - 1, 3) : middle + 2] if i not in ranked[-3:]]
    chosen += [("worst", i) for i in ranked[-3:][::-1] if i not in ranked[:3]]
    rows = {(r.scene_id, r.im_id, r.obj_id): r for r in read_results(next(run["folder"].glob("*.csv")))}
    found = []
    for kind, one in chosen:
        place = (one["scene_id"], one["im_id"], one["obj_id"])
        frame, mesh, row = dataset.frame(*place[:2]), dataset.mesh(place[2]), rows[place]
        truth = next(t for t in dataset.truths(*place[:2]) if t.index == one["index"])
        image, covered = np.ascontiguousarray(frame.rgb), np.zeros(frame.rgb.shape[:2], bool)
        estimate = (np.reshape(row.rotation, (3, 3)), np.asarray(row.translation) * MM)
        for (rotation, translation), colour in (
            ((truth.rotation, truth.translation), (40, 220, 90)),
            (estimate, (235, 50, 60)),
        ):
            shape = silhouette(mesh.vertices @ rotation.T + translation, mesh.faces, frame.camera, *covered.shape)
            outline, _ = cv2.findContours(shape.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, outline, -1, colour, 2)
            covered |= shape
        y, x = np.nonzero(covered) if covered.any() else (np.array([0, covered.shape[0] - 1]),) * 2
        half = int(max(np.ptp(x), np.ptp(y)) * 0.65) + 10
        top, left = max(int(y.mean()) - half, 0), max(int(x.mean()) - half, 0)
        cut = image[top : top + 2 * half, left : left + 2 * half]
        zoom = side / max(cut.shape[:2])
        cut = cv2.resize(cut, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR)
        _, coded = cv2.imencode(".jpg", cut[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
        caption = (
            f"{kind}: scene {place[0]}, image {place[1]}, object {place[2]}; MSSD {100 * error(one):.0f} % of the "
        )
        caption += (
            f"diameter, rotation {math.degrees(one['rotation']):.0f}°, translation {one['translation'] / MM:.0f} mm"
        )
        found.append((caption, "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()))
    return found


def page(runs: list[dict], data: Path, models: Path | None) -> str:
    """The whole page, in one file."""
    style = (
        "body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}"
        "table{border-collapse:collapse;margin:.5em 0}td,th{padding:.2em .7em;border-bottom:1px solid #ddd;"
        "text-align:right}td:first-child,th:first-child{text-align:left}figure{display:inline-block;width:320px;"
        "margin:.4em;vertical-align:top}figcaption{font-size:13px}svg text{font-size:11px;fill:#444}"
        ".key span{padding:.1em .6em;color:#fff;margin-right:.5em;border-radius:3px}.wide{overflow-x:auto}"
    )
    parts = ['<!doctype html><html lang="en"><meta charset="utf-8"><title>Accuracy</title>', f"<style>{style}</style>"]
    parts.append("<h1>Accuracy</h1><ul>" + "".join(f"<li>{html.escape(x)}</li>" for x in preamble(runs)) + "</ul>")
    for title, rows in tables(runs):
        parts.append(f"<h2>{html.escape(title)}</h2><div class=wide><table><tr>")
        parts.append("".join(f"<th>{html.escape(c)}</th>" for c in rows[0]) + "</tr>")
        parts += ["<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows[1:]]
        parts.append("</table></div>")
    key = "".join(
        f'<span style="background:{colour}">{html.escape(run["method"])}</span>'
        for colour, run in zip(COLOURS, runs, strict=False)
    )
    parts.append(f"<h2>Share of all targets below an error</h2><p class=key>{key}</p>")
    parts.append(curve(runs, "rotation", 180 / math.pi, 60, "rotation error, degrees (nearest symmetric pose)"))
    parts.append(curve(runs, "translation", 1000, 60, "translation error, mm"))
    parts.append(curve(runs, "add_s", 1000, 40, "ADD-S, mm"))
    parts.append(curve(runs, "scale", 100, 40, "scale error, %"))
    parts.append(f"<h2>Average recall per object, %</h2><p class=key>{key}</p><div class=wide>{bars(runs)}</div>")
    shown = pictures(runs[0], data, models)
    parts.append(f"<h2>Targets of {html.escape(runs[0]['method'])}</h2><p>Green: annotated. Red: estimated.</p>")
    parts += [
        f'<figure><img src="{url}" width=320><figcaption>{html.escape(c)}</figcaption></figure>' for c, url in shown
    ]
    return "\n".join(parts) + "</html>\n"


def main() -> None:
    """Read the runs, write the pages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.results_page", description=__doc__.split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folders that 'ipjax evaluate' wrote")
    parser.add_argument("--data", type=Path, required=True, help="the data set, for the photos")
    parser.add_argument("--models", type=Path, help="another data set, to take the models from")
    parser.add_argument("--markdown", type=Path, default=Path("benchmarks/results/accuracy.md"))
    parser.add_argument("--html", type=Path, default=Path("out/accuracy.html"))
    options = parser.parse_args()
    runs = [read_run(folder) for folder in options.runs]
    for path, text in ((options.markdown, markdown(runs)), (options.html, page(runs, options.data, options.models))):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        print(f"{path}: {len(text.encode()) / 1024:.0f} KB")


if __name__ == "__main__":
    main()
