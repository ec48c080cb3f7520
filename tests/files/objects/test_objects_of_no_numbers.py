"""Object files of which parts are no numbers: patches are left out, an object is refused."""

import numpy as np
import pytest
from builders.objects import make_object, with_reference
from safetensors import safe_open
from safetensors.numpy import save_file

from ipjax.files.objects.loading import load
from ipjax.files.objects.saving import save

BAD = (np.nan, np.inf, -np.inf)


def poison_file(path, name: str, index, bad) -> None:
    """What `save` refuses to write."""
    with safe_open(path, framework="numpy") as file:
        metadata, keys = file.metadata(), file.keys()
        tensors = {key: file.get_tensor(key) for key in keys}
    tensors[name][index] = bad
    save_file(tensors, path, metadata=metadata)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", ["features", "points", "grid", "norm"])
def test_load_leaves_out_patches_that_are_no_numbers(tmp_path, name, bad):
    templates, info = make_object()
    path = save(tmp_path / "mug.ipjax", templates, info)
    poison_file(path, name, (2, 1), bad)
    wanted = np.array(templates.patches.valid)
    wanted[2, 1] = False
    np.testing.assert_array_equal(load(path)[0].patches.valid, wanted)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", ["features", "points", "grid"])
def test_load_leaves_out_patches_of_the_photo_that_are_no_numbers(tmp_path, name, bad):
    templates, info = make_object()
    templates = with_reference(templates)
    path = save(tmp_path / "mug.ipjax", templates, info)
    poison_file(path, f"reference.{name}", 0, bad)
    found = load(path)[0]
    wanted = np.array(templates.reference.patches.valid)
    assert wanted[0]
    wanted[0] = False
    np.testing.assert_array_equal(found.reference.patches.valid, wanted)
    np.testing.assert_array_equal(found.patches.valid, templates.patches.valid)


@pytest.mark.parametrize("name", ["mean", "axes", "rotation", "focal", "extents"])
def test_load_refuses_an_object_that_is_no_numbers(tmp_path, name):
    path = save(tmp_path / "mug.ipjax", *make_object())
    poison_file(path, name, 0, np.nan)
    with pytest.raises(ValueError, match=f"damaged: {name} has values that are not finite"):
        load(path)
