"""The exported estimate gives the same answer in a process that has never heard of ipjax."""

import json
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from importlib.metadata import version

import jax
import numpy as np
import pytest
from builders.tiny_pipeline import TINY

import ipjax
from ipjax.inference.exporting import blank_query, export, to_dictionary
from ipjax.synthetic import problems

RUN = """
import sys, numpy as np, jax
from jax import export
flat = dict(np.load(sys.argv[2]))
def nest(prefix):
    tree = {}
    for name, value in flat.items():
        first, *rest = name.split(".")
        if first == prefix:
            node = tree
            for part in rest[:-1]:
                node = node.setdefault(part, {})
            node[rest[-1]] = value
    return tree
artifact = export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
found = artifact.call(nest("templates"), nest("query"), flat["key"])
assert "ipjax" not in sys.modules and "ipjax_kernels" not in sys.modules
pose = found["camera_from_object"]
np.savez(sys.argv[3], **pose, view=found["view"])
"""


@pytest.fixture(scope="module")
def templates():
    return problems.make_templates()


def test_the_artifact_runs_without_ipjax(templates, tmp_path):
    query, _ = problems.make_query(3)
    path = export(templates, query, tmp_path / "estimate.stablehlo", TINY)
    key = jax.random.key(5)
    tree = {"templates": to_dictionary(templates), "query": to_dictionary(query)}
    flat = {".".join(k.key for k in keys): np.asarray(x) for keys, x in jax.tree_util.tree_leaves_with_path(tree)}
    np.savez(tmp_path / "in.npz", key=np.asarray(jax.random.key_data(key)), **flat)
    arguments = [str(path), str(tmp_path / "in.npz"), str(tmp_path / "out.npz")]
    subprocess.run([sys.executable, "-c", RUN, *arguments], check=True, capture_output=True, timeout=300)
    out = np.load(tmp_path / "out.npz")
    found = jax.jit(ipjax.estimate)(None, templates, query, key, TINY)
    assert int(out["view"]) == int(found.view)
    np.testing.assert_allclose(out["rotation"], found.camera_from_object.rotation, atol=2e-3)
    np.testing.assert_allclose(out["scale"], found.camera_from_object.scale, rtol=2e-3)
    description = json.loads((tmp_path / "estimate.stablehlo.json").read_text())
    assert description["inputs"]["templates.patches.features"]["shape"] == [8, 64, 32]
    assert description["outputs"]["camera_from_object.rotation"]["shape"] == [3, 3]
    # Who finds a file that is refused reads here by whom it was written, and when.
    versions = description["versions"]
    assert {name: versions[name] for name in ("ipjax", "jax", "jaxlib")} == {
        name: version(name) for name in ("ipjax", "jax", "jaxlib")
    }
    loaded = jax.export.deserialize(bytearray(path.read_bytes()))
    assert versions["calling_convention"] == loaded.calling_convention_version
    age = datetime.now(UTC) - datetime.fromisoformat(description["date"])
    assert timedelta(0) <= age < timedelta(hours=1)
    assert "six months" in description["readable"] and "three weeks" in description["readable"]


def test_a_batch_has_its_axis_on_queries_only(templates, tmp_path):
    from jax import export as jax_export

    path = export(templates, blank_query(templates, 112), tmp_path / "four.stablehlo", TINY, batch=4)
    loaded = jax_export.deserialize(bytearray(path.read_bytes()))
    assert set(loaded.platforms) == {"cpu", "cuda", "tpu"}
    shapes = {len(x.shape) and x.shape[0] for x in jax.tree.leaves(loaded.out_tree.unflatten(loaded.out_avals))}
    assert shapes == {4}


def test_a_batch_of_nothing_is_refused(templates, tmp_path):
    with pytest.raises(ValueError, match="positive number"):
        export(templates, blank_query(templates, 112), tmp_path / "none", TINY, batch=0)
    assert not list(tmp_path.iterdir())
