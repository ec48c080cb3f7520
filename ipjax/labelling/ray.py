"""Labels on Ray Data: `label_batch` in actors that keep the encoder, the objects and what was compiled for them.

A data set of Ray has a row for each frame, with the columns id, rgb, depth, camera and, where they are known, mask, box
and object, as `ipjax.labelling.records.Batch` has them::

    import ipjax, ray
    from ipjax.labelling.ray import label_dataset

    def load():  # called once in every actor
        return ipjax.load_encoder(), [ipjax.load("/shared/mug.ipjax"), ipjax.load("/shared/box.ipjax")]

    frames = ray.data.read_parquet("/shared/frames")  # or any other source, and a map that decodes
    label_dataset(frames, load, workers=16, cores=4).write_parquet("/shared/labels")

This needs the extra: ``pip install 'ipjax[ray]'``. Nothing but `label_dataset` imports Ray.
"""

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ipjax.config import Config
from ipjax.files.objects.record import ObjectInfo
from ipjax.inference.compilation_cache import use_compilation_cache
from ipjax.labelling.batch import Labeller
from ipjax.labelling.records import Batch, LabelSettings
from ipjax.records import Templates

MEMORY = 4 * 2**30

Load = Callable[[], tuple[Any, Sequence[tuple[Templates, ObjectInfo]]]]
"""Returns an encoder and objects as `Labeller` takes them."""


class LabelActor:
    """What an actor of ``Dataset.map_batches`` does; its arguments are those of `label_dataset`."""

    def __init__(
        self,
        load: Load,
        config: Config = Config(),
        settings: LabelSettings = LabelSettings(),
        cores: int | None = None,
        keep: Sequence[str] = (),
    ):
        if cores is not None:  # XLA asks for it when it is first used, and else takes all cores of the machine
            os.environ.setdefault("NPROC", str(cores))
        use_compilation_cache()
        encoder, objects = load()
        self._labeller = Labeller(encoder, objects, config, settings)
        self._keep = tuple(keep)

    def __call__(self, batch: Batch) -> Batch:
        """The labels of a batch, in columns that Arrow can hold, and the given columns that are to be kept."""
        made = self._labeller(batch)
        return {name: batch[name] for name in self._keep} | {name: _as_column(made[name]) for name in made}


def label_dataset(
    frames: Any,
    load: Load,
    *,
    workers: int = 1,
    cores: int = 1,
    gpus: float = 0,
    memory: int = MEMORY,
    batch: int = 16,
    config: Config = Config(),
    settings: LabelSettings = LabelSettings(),
    keep: Sequence[str] = (),
    **options: Any,
) -> Any:
    """A data set of Ray, labelled by actors; lazily, as Ray's data sets are.

    An actor that dies is started again, and so is what it was at: the labels of a frame depend on the frame, its id,
    the objects and the settings alone, so that nothing is lost, doubled or different. A frame that cannot be used has
    an ``error`` and stops nothing.

    Args:
        frames: ``ray.data.Dataset`` with a row for each frame; no two have the same id.
        load: called once in every actor: an encoder and objects, from files that every machine can read.
        workers: actors.
        cores: of each, for its threads and for XLA's.
        gpus: of each: 1 = a GPU of its own, 0.5 = two share one.
        memory: bytes of each that Ray sets aside; it starts no actor where they are missing.
        batch: frames that an actor is given at once, most; fewer are padded to the next of the settings' buckets.
        config: of the estimates.
        settings: how frames are labelled; threads, if not given, are as many as cores.
        keep: columns of ``frames`` that the labels are to have, too.
        options: of ``Dataset.map_batches``, such as ``runtime_env``.

    Returns:
        ``ray.data.Dataset`` with the columns that `ipjax.labelling.records.Batch` says are made; texts of a frame's
        instances are lists.

    Raises:
        ValueError: Ray is not installed, or there would be no actor, core, memory or frame.
    """
    try:
        from ray.data import ActorPoolStrategy
    except ImportError as error:
        raise ValueError(f"labelling with Ray needs Ray Data ({error}): pip install 'ipjax[ray]'") from None
    given = {"workers": workers, "cores": cores, "memory": memory, "batch": batch}
    for name, number in given.items():
        if number < 1:
            raise ValueError(f"{name} is a number from 1 on, not {number}")
    if settings.threads is None:
        settings = dataclasses.replace(settings, threads=cores)
    once_more: dict[str, Any] = {"max_restarts": -1, "max_task_retries": -1}
    return frames.map_batches(
        LabelActor,
        fn_constructor_args=(load, config, settings, cores, tuple(keep)),
        compute=ActorPoolStrategy(size=workers),
        batch_size=batch,
        batch_format="numpy",
        num_cpus=cores,
        num_gpus=gpus,
        memory=memory,
        **(once_more | options),
    )


def _as_column(column: np.ndarray) -> np.ndarray:
    """Texts of instances as a list for each frame: Arrow has no tensors of text."""
    if column.dtype != object or column.ndim == 1:
        return column
    rows = np.empty(len(column), object)
    for place, row in enumerate(column):
        rows[place] = row.tolist()
    return rows
