"""A score as text."""

from collections.abc import Sequence

from ipjax import metrics
from ipjax.bop.scoring.summaries import Score

# Targets below which no AUC is given: the toolbox's curve takes its higher value, so one target under 10 cm is 1.
FEW = 10
SIZED = {"mssd": "MSSD", "add_or_s": "ADD(-S)"} | {
    f"size_{round(100 * x)}": f"size to {100 * x:g} %" for x in metrics.SIZE_TOLERANCES.tolist()
}  # recalls of poses with their size


def format_score(found: Score) -> str:
    """A score as a table for people: recalls, medians, areas under curves, and a line for each object."""
    names = [n for n in ("vsd", "mssd", "mspd", "ar") if n in found.all_frames.recalls]
    heads = {"vsd": "AR_VSD", "mssd": "AR_MSSD", "mspd": "AR_MSPD", "ar": "AR"}
    lines = [f"{found.method} on {found.dataset}", ""]
    rows = [["", "images", "targets", *(heads[n] for n in names)]]
    for title, part in found.parts().items():
        cells = [percent(part.recalls[n], part.intervals.get(n)) for n in names]
        rows.append([title, str(part.images), str(part.targets), *cells])
    if found.against:
        cells = [percent(found.against["recalls"][n]) if n in found.against["recalls"] else "–" for n in names]
        rows.append([f"{found.against['method']}, all frames", "", "", *cells])
    lines += [
        *in_columns(rows),
        "",
        "Recalls in %; brackets: 95 % bootstrap over images. One frame per scene: the first."
        + (" Without SCENE/IMAGE: its annotation is in doubt." if found.without else ""),
    ]
    if found.all_frames.sized:
        rows = [["", *SIZED.values()]]
        for title, part in found.parts().items():
            rows.append([title, *(percent(part.sized[n], part.sized_intervals.get(n)) for n in SIZED)])
        lines += [
            "",
            "With the model at its estimated size, which the recalls above do not see (%; in true diameters):",
            *in_columns(rows),
            "",
        ]
    if found.medians:
        parts = [
            f"rotation {found.medians['rotation_deg']:.1f}°",
            f"translation {found.medians['translation_mm']:.1f} mm",
        ]
        if "scale_percent" in found.medians:
            parts.append(f"scale {found.medians['scale_percent']:.1f} %")
        lines.append(
            f"Median errors of what was found: {', '.join(parts)}; {found.missing} targets without an estimate."
        )
    if found.add:
        a = found.add
        area = (
            f"AUC to 10 cm, as PoseCNN's toolbox sums it: ADD {100 * a['add_auc']:.1f}, "
            f"ADD-S {100 * a['add_s_auc']:.1f}, ADD(-S) {100 * a['add_or_s_auc']:.1f}; below"
        )
        lines.append(
            f"{area if found.all_frames.targets >= FEW else 'Below'} 0.1 d: ADD(-S) {100 * a['recall_01d']:.1f} %, "
            f"ADD-S {100 * a['add_s_01d']:.1f} %."
        )
    if found.precision:
        p = found.precision
        lines.append(
            f"BOP 2024 detection: AP_MSSD {100 * p['ap_mssd']:.1f}, AP_MSPD {100 * p['ap_mspd']:.1f}, "
            f"mAP {100 * p['map']:.1f}; BOP 2025: AP_MSSD {100 * p['ap_mssd']:.1f}, to 2 … 20 mm "
            f"{100 * p['ap_mssd_mm']:.1f}."
        )
    if found.seconds_per_image is not None:
        lines.append(f"Time per image: {found.seconds_per_image:.2f} s.")
    rows = [["object", "targets", *(heads[n] for n in names), "rotation °", "translation mm"]]
    if found.against:
        rows[0] += [found.against["method"], "better"]
    for obj, entry in found.objects.items():
        cells = [str(obj), f"{entry['targets']:.0f}", *(percent(entry[n]) for n in names)]
        cells += [f"{entry[k]:.1f}" if k in entry else "–" for k in ("rotation_deg", "translation_mm")]
        if found.against:
            key = found.against["metric"]
            other = found.against["objects"].get(obj, {}).get(key)
            cells += ["–", ""] if other is None else [percent(other), _sign(entry[key] - other)]
        rows.append(cells)
    lines += ["", *in_columns(rows)]
    if found.against:
        a = found.against
        lines.append(
            f"Objects won against {a['method']} ({heads[a['metric']]}): {a['wins']}, tied {a['ties']}, "
            f"lost {a['losses']}."
        )
    lines += [f"Note: {note}." for note in found.notes]
    if found.problems:
        lines.append(f"{len(found.problems)} problems, the first: {found.problems[0]}")
    return "\n".join(lines)


def percent(value: float, interval: Sequence[float] | None = None) -> str:
    """A share in %, with the brackets of its interval."""
    text = f"{100 * value:.1f}"
    return text if not interval else f"{text} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def _sign(gain: float) -> str:
    return "+" if gain > 0 else "−" if gain < 0 else "="


def in_columns(rows: list[list[str]]) -> list[str]:
    """Lines of a table whose cells stand below one another; all columns but the first are set to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
