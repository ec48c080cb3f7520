"""``estimate`` as a file: StableHLO that any JAX process can run, without ipjax, on CPU, CUDA or TPU.

The artifact takes and returns dictionaries of arrays. Templates are inputs, not constants: one artifact serves every
object of the same shapes. The configuration is baked in.
"""

import dataclasses
import json
import platform
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jaxtyping import Array

from ipjax import __version__
from ipjax.config import Config
from ipjax.estimation.pipeline import estimate
from ipjax.files.settings import describe_config
from ipjax.files.storage.writing import write_bytes, write_text
from ipjax.records import Camera, Patches, Query, ReferenceView, Similarity, Surface, Templates, View

PLATFORMS = ("cpu", "cuda", "tpu")
PROMISE = (
    "by a jaxlib built up to six months after the one that wrote the file, or up to three weeks before it: what "
    "jax.export promises. What is older may be refused: export it again"
)

_UNITS = {
    "templates.patches.points": "model units (diameters), object frame",
    "templates.camera_from_object.translation": "model units",
    "templates.photo_centre": "model units (diameters), object frame",
    "templates.surface.along_std": "model units, standard deviation along the photo's ray",
    "templates.reference.patches.points": "model units (diameters), object frame",
    "templates.reference.camera_from_object.translation": "model units",
    "templates.reference.view.depth": "model units along z, 0 = unknown",
    "templates.reference.view.rgb": "[0, 1]",
    "templates.reference.view.camera.focal": "pixels (x, y)",
    "templates.reference.view.camera.centre": "pixels (x, y), first pixel's centre at 0",
    "query.patches.points": "metres, camera frame",
    "query.view.depth": "metres along z, 0 = unknown",
    "query.view.rgb": "[0, 1]",
    "query.view.camera.focal": "pixels (x, y)",
    "query.view.camera.centre": "pixels (x, y), first pixel's centre at 0",
    "key": "two numbers that seed the sampling",
}


def to_dictionary(record: Any) -> dict[str, Any]:
    """A record of ``ipjax.records`` as nested dictionaries of arrays, by field name.

    Without the photo that serves only to choose among drawn candidates: exported graphs hold no encoder to draw with.
    Of how far points of the surface may be off only what the graph uses, of objects from a photo without depth.
    """
    if isinstance(record, Templates):
        guessed = record.reference is not None and not record.reference.measured
        along = record.surface.along_std if guessed else None
        surface = dataclasses.replace(record.surface, along_std=along, across_std=None)
        record = dataclasses.replace(record, surface=surface)
    fields = record.__dataclass_fields__
    values = {name: getattr(record, name) for name, field in fields.items() if not field.metadata.get("static")}
    present = {name: x for name, x in values.items() if x is not None and not getattr(x, "measured", False)}
    return {name: to_dictionary(x) if hasattr(x, "__dataclass_fields__") else x for name, x in present.items()}


def _to_templates(tree: dict[str, Any]) -> Templates:
    return Templates(
        patches=Patches(**tree["patches"]),
        camera_from_object=Similarity(**tree["camera_from_object"]),
        camera=Camera(**tree["camera"]),
        surface=Surface(**tree["surface"]),
        **{name: tree[name] for name in ("mean", "norm", "seen", "extents", "axes")},
        basis=tree.get("basis"),
        reference=_to_reference(tree["reference"]) if "reference" in tree else None,
    )


def _to_reference(tree: dict[str, Any]) -> ReferenceView:
    return ReferenceView(
        view=_to_view(tree["view"]),
        patches=Patches(**tree["patches"]),
        camera_from_object=Similarity(**tree["camera_from_object"]),
    )


def _to_view(tree: dict[str, Any]) -> View:
    return View(tree["rgb"], tree["depth"], tree["mask"], Camera(**tree["camera"]))


def _to_query(tree: dict[str, Any]) -> Query:
    return Query(Patches(**tree["patches"]), _to_view(tree["view"]))


def blank_query(templates: Templates, resolution: int) -> Query:
    """A query of the shapes that go with the templates, of zeros: square crops of ``resolution`` pixels.

    It has as many patches as the grid has cells, of which compacted templates keep only some.
    """
    columns, rows = (int(side) + 1 for side in np.asarray(templates.patches.grid).reshape(-1, 2).max(axis=0))
    patches, channels = columns * rows, templates.mean.shape[-1]
    zeros = lambda *shape: jnp.zeros(shape, jnp.float32)
    square = (resolution, resolution)
    return Query(
        Patches(zeros(patches, channels), zeros(patches, 3), zeros(patches, 2), jnp.zeros(patches, bool)),
        View(zeros(*square, 3), zeros(*square), jnp.zeros(square, bool), Camera(zeros(2), zeros(2))),
    )


def estimate_dictionaries(
    templates: dict[str, Any],
    query: dict[str, Any],
    key: Array,
    config: Config = Config(),
) -> dict[str, Any]:
    """``estimate`` from and to dictionaries of arrays; ``key`` is uint32 [2]."""
    found = estimate(None, _to_templates(templates), _to_query(query), jax.random.wrap_key_data(key), config)
    return to_dictionary(found)


def export(
    templates: Templates,
    query: Query,
    path: str | Path,
    config: Config = Config(),
    *,
    batch: int | None = None,
) -> Path:
    """Write the artifact ``path`` and its description ``path`` + ``.json``.

    Args:
      templates, query: examples; only their shapes and types count.
      batch: this many queries at once, against one object; None = one query without a batch axis.

    Raises:
      ValueError: the batch is not positive, or ``flatbuffers`` (the extra ``export``) is not installed.
    """
    if batch is not None and batch < 1:
        raise ValueError(f"the batch must be a positive number of queries, not {batch}")
    if find_spec("flatbuffers") is None:
        raise ValueError("exporting needs the package flatbuffers: pip install 'ipjax[export]'")
    from jax import export as jax_export

    shape = lambda tree, lead: jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((*lead, *x.shape), jnp.asarray(x).dtype), tree
    )
    lead = () if batch is None else (batch,)
    arguments = (
        shape(to_dictionary(templates), ()),
        shape(to_dictionary(query), lead),
        jax.ShapeDtypeStruct((*lead, 2), np.uint32),
    )
    one = lambda templates, query, key: estimate_dictionaries(templates, query, key, config)
    run = one if batch is None else jax.vmap(one, (None, 0, 0))
    exported = jax_export.export(jax.jit(run), platforms=PLATFORMS)(*arguments)
    path = Path(path)
    write_bytes(path, bytes(exported.serialize()))
    description = {
        "what": "ipjax.estimate as StableHLO: jax.export.deserialize(open(...).read()).call(templates, query, key)",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            "ipjax": __version__,
            "jax": jax.__version__,
            "jaxlib": jaxlib.__version__,
            "python": platform.python_version(),
            "calling_convention": exported.calling_convention_version,
        },
        "readable": PROMISE,
        "platforms": list(PLATFORMS),
        "batch": batch,
        "config": describe_config(config),
        "encoder": templates.patches.encoder,  # who must describe the queries; null = not known
        "inputs": _describe({"templates": arguments[0], "query": arguments[1], "key": arguments[2]}),
        "outputs": _describe(jax.tree.unflatten(exported.out_tree, exported.out_avals)),
        "frames": "camera_from_object: x_camera [m] = scale * rotation @ x_object [diameters] + translation",
    }
    write_text(path.with_name(path.name + ".json"), json.dumps(description, indent=1) + "\n")
    return path


def _describe(tree: Any) -> dict[str, dict[str, Any]]:
    described = {}
    for keys, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = ".".join(str(getattr(key, "key", key)) for key in keys)
        described[name] = {"shape": list(leaf.shape), "dtype": str(leaf.dtype)}
        if name in _UNITS:
            described[name]["unit"] = _UNITS[name]
    return described
