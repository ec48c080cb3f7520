"""Labels on a local cluster of Ray are those of one process, also when an actor dies."""

import sys

import numpy as np
import pytest
from builders import ray_cluster
from builders.labelled_frames import as_batch, labeller, make_frames

from ipjax.labelling.ray import label_dataset


def test_an_actor_that_dies_loses_nothing_and_doubles_nothing(tmp_path):
    pytest.importorskip("ray.data", reason="Ray is not installed: pip install 'ipjax[ray]'")
    batch = as_batch(make_frames(7))
    batch["depth"][-1] = 0
    expected = labeller(threads=2)(batch)
    found, said = ray_cluster.label(7, tmp_path / "died")
    assert (tmp_path / "died").exists(), f"no actor died:\n{said}"
    assert sorted(row["id"] for row in found) == sorted(batch["id"])
    for row in found:
        place = batch["id"].index(row["id"])
        for name in set(row) - {"id", "scene", "mask"}:
            wanted = expected[name][place]
            if np.asarray(wanted).dtype.kind == "f":
                np.testing.assert_allclose(row[name], wanted, rtol=1e-4, atol=1e-5, err_msg=name)
            else:
                assert row[name] == np.asarray(wanted).tolist(), name
        assert bool(row["mask"][0]) == bool(row["success"][0]) and row["scene"] == 7
    assert sum(bool(row["error"]) for row in found) == 1


def test_without_ray_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setitem(sys.modules, "ray.data", None)
    with pytest.raises(ValueError, match=r"ipjax\[ray\]"):
        label_dataset(None, lambda: (None, []))


@pytest.mark.parametrize("name", ["workers", "cores", "memory", "batch"])
def test_senseless_numbers_are_refused(name):
    pytest.importorskip("ray.data", reason="Ray is not installed: pip install 'ipjax[ray]'")
    with pytest.raises(ValueError, match=f"{name} is a number from 1 on"):
        label_dataset(None, lambda: (None, []), **{name: 0})
