"""Scoring several result files, on one data set or on several, and what they are called."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from ipjax.bop.dataset import Dataset
from ipjax.bop.scoring.benchmark.figures import THRESHOLDS, Entry, summarise
from ipjax.bop.scoring.scores import score
from ipjax.bop.scoring.summaries import Score

_OF_DATASET = re.compile(r"(.+)_([^_]+-(?:test|train|val)[^-]*)")  # METHOD_DATASET-SPLIT, as BOP names result files


@dataclass(frozen=True)
class Benchmark:
    """Participants side by side: the figures of each on each data set."""

    participants: tuple[str, ...]
    datasets: tuple[str, ...]
    entries: tuple[Entry, ...]  # by data set, within it by participant
    notes: tuple[str, ...]  # on the figures: what is missing

    def of(self, dataset: str) -> list[Entry]:
        """The entries of a data set, in the order of the participants."""
        return [entry for entry in self.entries if entry.dataset == dataset]

    def objects(self) -> list[int]:
        """Every object of any data set."""
        return sorted({obj for entry in self.entries for obj in entry.objects})

    def all_notes(self) -> list[str]:
        """Those on the single scores before those on the figures."""
        notes = []
        for entry in self.entries:
            who, problems = _name(entry.participant, entry.dataset, len(self.datasets) > 1), entry.score.problems
            notes += [f"{who}: {note}" for note in entry.score.notes]
            notes += [f"{who}: {len(problems)} problems, the first: {problems[0]}"] if problems else []
        return [*notes, *self.notes]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and text, without the scores that the entries are of."""
        entries = []
        for entry in self.entries:
            record = {name: value for name, value in vars(entry).items() if name != "score"}
            record["objects"] = {str(obj): asdict(figures) for obj, figures in entry.objects.items()}
            entries.append(record | {"mean": asdict(entry.mean), "all": asdict(entry.all)})
        return {
            "participants": list(self.participants),
            "datasets": list(self.datasets),
            "thresholds": THRESHOLDS.tolist(),
            "entries": entries,
            "notes": self.all_notes(),
        }


def compare(
    groups: Sequence[tuple[Dataset, Sequence[str | Path]]],
    metrics: Sequence[str] = ("mssd", "mspd", "vsd"),
    *,
    names: Sequence[str] | None = None,
    titles: Sequence[str] | None = None,
    on_error: Literal["raise", "skip"] = "raise",
    progress: bool = False,
    **scoring: Any,
) -> Benchmark:
    """Score result files and put them side by side.

    Args:
        groups: data sets, each with the result files of the participants, in the same order.
        metrics: as `score`'s; ADD and ADD-S are always measured, too.
        names: of the participants; default: of the first data set's files, without BOP's ``_DATASET-SPLIT``.
        titles: of the data sets; default: their names and splits.
        on_error, progress: as `score`'s.
        scoring: more for `score`.

    Raises DatasetError, one sentence with file and line, for damaged results or data; ValueError where numbers of files
    or names do not match, or two of them are alike.
    """
    if not groups or not groups[0][1]:
        raise ValueError("there is nothing to score")
    files = [[Path(path) for path in paths] for _, paths in groups]
    for (dataset, _), mine in zip(groups, files, strict=True):
        _refuse_twins(mine)
        if len(mine) != len(files[0]):
            raise ValueError(
                f"{dataset.root}: every data set needs a result file of each participant, in the same order; the first "
                f"has {len(files[0])}, this one {len(mine)}"
            )
    participants = _choose("participants", names, files[0], _list_methods(files[0], groups[0][0]))
    sets = [dataset.root for dataset, _ in groups]
    chosen_titles = _choose("data sets", titles, sets, [f"{d.name}-{d.split}" for d, _ in groups])
    measured = tuple(dict.fromkeys((*metrics, "add", "add_s")))
    entries, notes = [], []
    for (dataset, _), mine, title in zip(groups, files, chosen_titles, strict=True):
        for path, participant in zip(mine, participants, strict=True):
            method = participant if len(files[0]) > 1 or names is not None else path.stem
            found = score(path, dataset, measured, method=method, on_error=on_error, progress=progress, **scoring)
            entries.append(summarise(found, participant, title))
            notes += _list_notes(found, participant, title, len(groups) > 1)
    notes += _compare_objects(entries)
    return Benchmark(tuple(participants), tuple(chosen_titles), tuple(entries), tuple(notes))


def _refuse_twins(paths: Iterable[Path]) -> None:
    seen: set[Path] = set()
    for path in paths:
        if path.resolve() in seen:
            raise ValueError(f"{path} is given twice: each participant has a file of its own")
        seen.add(path.resolve())


def _choose(what: str, given: Sequence[str] | None, paths: Sequence[Path], default: list[str]) -> list[str]:
    """Names that are given, or those of the files, with their folders where two are alike."""
    if given is not None:
        if len(given) != len(paths):
            raise ValueError(f"{len(paths)} {what} need as many names, got {len(given)}: {', '.join(given)}")
        chosen = list(given)
    elif len(set(default)) == len(default):
        chosen = default
    else:
        chosen = [f"{path.resolve().parent.name}/{name}" for path, name in zip(paths, default, strict=True)]
    for name in chosen:
        if chosen.count(name) > 1:
            raise ValueError(f"two {what} have the same name, {name!r}: name them (--names, --titles)")
    return chosen


def _list_methods(paths: Sequence[Path], dataset: Dataset) -> list[str]:
    """The files' names; less data set and split, where these are the data set's, or the same for all of several."""
    matches = [match for path in paths if (match := _OF_DATASET.fullmatch(path.stem))]
    ends = {match[2] for match in matches}
    alike = len(matches) == len(paths) and len(ends) == 1
    if alike and (len(paths) > 1 or ends == {f"{dataset.name}-{dataset.split}"}):
        return [match[1] for match in matches]
    return [path.stem for path in paths]


def _list_notes(found: Score, participant: str, title: str, several: bool) -> list[str]:
    """What a reader of the figures must know of one score."""
    who, notes = _name(participant, title, several), []
    if found.missing:
        total = found.all_frames.targets
        notes.append(f"{who}: {found.missing} of {total} targets have no estimate and count as infinitely wrong")
    if found.seconds_per_image is None:
        notes.append(f"{who}: the file tells no times")
    return notes


def _name(participant: str, title: str, several: bool) -> str:
    return f"{participant} on {title}" if several else participant


def _compare_objects(entries: Sequence[Entry]) -> list[str]:
    """Means over different objects are not to be compared."""
    union = set().union(*(entry.objects for entry in entries))
    notes = []
    for title in dict.fromkeys(entry.dataset for entry in entries):
        lacking = union - set(next(entry.objects for entry in entries if entry.dataset == title))
        if lacking:
            several = "objects" if len(lacking) > 1 else "object"
            listed = ", ".join(map(str, sorted(lacking)))
            notes.append(f"{title} has no targets of {several} {listed}, so that its means are of fewer objects")
    return notes
