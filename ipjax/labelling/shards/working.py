"""A worker: shards that nobody has labelled yet, one after the other."""

import contextlib
import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipjax.bop.results import write_results
from ipjax.files.storage.folders import writing_folder
from ipjax.files.storage.locks import locked
from ipjax.files.storage.writing import append_json, write_bytes, write_text
from ipjax.inference.drawing import write_image
from ipjax.labelling.entries import Entry, as_batch, as_entries, failed_entry
from ipjax.labelling.outputs.bop_files import as_rows, as_scene_documents, by_scene, metres_per_unit
from ipjax.labelling.outputs.coco import write_coco
from ipjax.labelling.outputs.pictures import draw_entry
from ipjax.labelling.outputs.tables import as_columns, has_parquet, write_table
from ipjax.labelling.records import Batch
from ipjax.labelling.shards.ledger import Ledger, in_words
from ipjax.labelling.shards.plan import LOGS, SHARDS, WORK, LabelledObject, Shard, plan_shards
from ipjax.labelling.shards.reading import read_ahead
from ipjax.labelling.sources.records import FrameKey, Source, SourceFrame

LEDGER = "labels.jsonl"
PREVIEWS = "previews"


@dataclasses.dataclass(frozen=True)
class Report:
    """What a worker did.

    Args:
        labelled: shards that it finished.
        before: shards that were finished before.
        elsewhere: shards that another worker is at.
        frames: that it labelled.
        bad: of all frames of finished shards that it looked at, those that could not be used: name and reason.
    """

    labelled: int
    before: int
    elsewhere: int
    frames: int
    bad: list[tuple[str, str]]


class Worker:
    """Labels shards of a source into a folder; several may work on one folder, on one machine or on many.

    Args:
        folder: of the labels, with the manifest.
        manifest: of `ipjax.labelling.shards.plan.make_manifest`.
        source: of the frames.
        keys: of all its frames.
        labeller: `ipjax.labelling.batch.Labeller`, or what labels batches as it does.
        objects: with their numbers, in the labeller's order.
        parquet: write tables as Parquet; None = where pyarrow is installed.
    """

    def __init__(
        self,
        folder: Path,
        manifest: Mapping[str, Any],
        source: Source,
        keys: Sequence[FrameKey],
        labeller: Callable[[Batch], Batch],
        objects: Sequence[LabelledObject],
        *,
        parquet: bool | None = None,
    ):
        self.folder, self.source, self.keys, self.labeller = folder, source, keys, labeller
        self.batch, self.previews = int(manifest["batch"]), int(manifest["previews"])
        self.plan = plan_shards(len(keys), manifest["shard_size"])
        self.numbers = [one.number for one in objects]
        self.infos = {one.number: one.info for one in objects}
        self.parquet = has_parquet() if parquet is None else parquet

    def run(self, part: tuple[int, int] = (0, 1), progress: Callable[[int, int], None] | None = None) -> Report:
        """Label every shard of a part that is not finished and that nobody else is at.

        Args:
            part: which of how many: of (1, 4), shards 1, 5, 9 and so on.
            progress: told how many frames of the part are done, and how many there are.

        Raises:
            OSError: something cannot be written; what is finished stays, and the next call goes on.
        """
        mine = [shard for shard in self.plan if shard.index % part[1] == part[0]]
        total, passed = sum(shard.stop - shard.start for shard in mine), 0
        counts = {"labelled": 0, "before": 0, "elsewhere": 0, "frames": 0}
        bad: list[tuple[str, str]] = []
        tell = progress or (lambda done, total: None)
        for shard in mine:
            before = passed
            passed += shard.stop - shard.start
            try:
                with self._locked(shard) as free:
                    if is_finished(self.folder, shard):
                        shutil.rmtree(self._work(shard), ignore_errors=True)
                        counts["before"] += 1
                    elif not free:
                        counts["elsewhere"] += 1
                    else:
                        told = self._label(shard, lambda done, before=before: tell(before + done, total))
                        counts["labelled"] += 1
                        counts["frames"] += told[0]
                        bad += told[1]
            except OSError as error:
                raise in_words(error, self.folder) from error
            tell(passed, total)
        return Report(bad=bad, **counts)

    @contextlib.contextmanager
    def _locked(self, shard: Shard):
        """Whether nobody else is at this shard while the block runs."""
        folder = self.folder / WORK
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as held:
            try:
                held.enter_context(locked(folder / f"{shard.name}.lock", wait=False))
            except BlockingIOError:
                yield False
            else:
                yield True

    def _work(self, shard: Shard) -> Path:
        return self.folder / WORK / shard.name

    def _label(self, shard: Shard, tell: Callable[[int], None]) -> tuple[int, list[tuple[str, str]]]:
        """Label a shard, or what is left of it; the frames that were labelled now, and the bad ones."""
        work, keys = self._work(shard), self.keys[shard.start : shard.stop]
        (work / PREVIEWS).mkdir(parents=True, exist_ok=True)
        ledger = Ledger(work / LEDGER, len(keys), self.batch)
        first = ledger.done
        tell(first)
        for found in read_ahead(self.source, keys[first:], self.batch):
            self._keep(shard, ledger, found)
            tell(ledger.done)
        again = [keys[place] for place in ledger.to_try_again()]
        for found in read_ahead(self.source, again, 1):  # what failed may have failed for a passing reason
            self._keep(shard, ledger, found)
        entries = ledger.collect()
        with contextlib.suppress(FileExistsError):  # made by another worker, where the file system knows no locks
            self._finish(shard, entries)
        shutil.rmtree(work, ignore_errors=True)
        return len(keys) - first, [(entry["name"], entry["error"]) for entry in entries if entry["error"]]

    def _keep(self, shard: Shard, ledger: Ledger, found: list[tuple[FrameKey, SourceFrame | str]]) -> None:
        """Label frames that were read, draw those that are to be drawn, and write them down."""
        start = time.perf_counter()
        # The reasons name files; where the source lies is no part of the labels.
        where = f"{self.source.path}{os.sep}"
        made = {key.name: failed_entry(key, said.replace(where, "")) for key, said in found if isinstance(said, str)}
        seconds: dict[str, float] = {}
        usable = [(key, frame) for key, frame in found if isinstance(frame, SourceFrame)]
        for has_masks in (True, False):
            some = [(key, frame) for key, frame in usable if (frame.masks is not None) == has_masks]
            if not some:
                continue
            keys, frames = [key for key, _ in some], [frame for _, frame in some]
            labels = self.labeller(as_batch(keys, frames))
            made |= {entry["name"]: entry for entry in as_entries(keys, frames, labels, self.numbers)}
            seconds |= dict(zip([key.name for key in keys], labels["seconds"].tolist(), strict=True))
        places = {key.name: place for place, key in enumerate(self.keys[shard.start : shard.stop], shard.start)}
        for key, frame in usable:
            if self.previews and places[key.name] % self.previews == 0 and not made[key.name]["error"]:
                picture = draw_entry(frame.rgb, made[key.name], self.infos)
                write_image(self._work(shard) / PREVIEWS / f"{places[key.name]:08d}.jpg", picture)
        ledger.append([made[key.name] for key, _ in found])
        logs = self.folder / LOGS
        logs.mkdir(exist_ok=True)
        spent = round(time.perf_counter() - start, 6)
        append_json(logs / f"{shard.name}.jsonl", {"frames": len(found), "wall_seconds": spent, "seconds": seconds})

    def _finish(self, shard: Shard, entries: Sequence[Entry]) -> None:
        """Write all that is made of a shard's entries, whole or not at all."""
        names = {number: info.name for number, info in self.infos.items()}
        target = self.folder / SHARDS / shard.name
        with writing_folder(target) as folder:
            write_text(folder / LEDGER, "".join(_line(entry) for entry in entries))
            write_bop(folder, entries, self.infos)
            write_coco(folder / "coco.json", names, lambda: enumerate(entries, shard.start + 1))
            write_table(folder / "table", [as_columns(entries, names)], parquet=self.parquet)
            bad = [{"frame": entry["name"], "reason": entry["error"]} for entry in entries if entry["error"]]
            write_text(folder / "bad_frames.json", _line(bad))
            (folder / PREVIEWS).mkdir()
            for picture in sorted((self._work(shard) / PREVIEWS).iterdir()):
                if picture.stem.isdecimal():  # a writer that was killed leaves others
                    write_bytes(folder / PREVIEWS / picture.name, picture.read_bytes())


def write_bop(folder: Path, entries: Sequence[Entry], infos: Mapping[int, Any]) -> None:
    """Write the poses of frames as BOP has them: labels.csv, labels.sized, and scenes/SCENE/scene_gt.json and the like.

    Raises OSError.
    """
    units = metres_per_unit(infos)
    rows = [row for entry in entries for row in as_rows(entry, units)]
    write_results(folder / "labels.csv", [row for row, _ in rows])
    write_results(folder / "labels.sized", [row for row, _ in rows], scales=[scale for _, scale in rows])
    for scene, mine in by_scene(entries).items():
        place = folder / "scenes" / f"{scene:06d}"
        for name, document in as_scene_documents(mine).items():
            write_text(place / f"{name}.json", _line(document), parents=True)


def is_finished(folder: Path, shard: Shard) -> bool:
    """Whether a shard has been labelled."""
    return (folder / SHARDS / shard.name).is_dir()


def _line(document: Any) -> str:
    return json.dumps(document, allow_nan=False) + "\n"
