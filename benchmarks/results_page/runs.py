"""What runs wrote: scores and settings, by study."""

import dataclasses
from pathlib import Path
from typing import Any

from ipjax.files.storage.parsing import parse_json, read_json
from ipjax.files.storage.writing import read_lines

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


def parts(run: dict) -> dict[str, dict]:
    """Recalls by title, the headline first."""
    return {"one frame per scene": run["one_frame_per_scene"], "all frames": run["all_frames"], **run["without"]}


def knows_size(run: dict) -> bool:
    """Whether the method was told the size of the objects, so that it had no scale to find."""
    return any("told each object's true size" in note for note in run["notes"])
