"""What stands on a table is told apart, also where surfaces are in pieces or touch, and where a person says so."""

import numpy as np
import pytest
import trimesh

from ipjax.capture.models.frames import PosedFrame
from ipjax.capture.models.separation import Hint, separate
from ipjax.capture.models.splitting import Seams
from ipjax.capture.models.support import Support
from ipjax.capture.records import CaptureError
from ipjax.files.meshes.mesh import make_mesh
from ipjax.transforms import Similarity

HOW = {"cut_at": 0.002, "least_area": 1e-3, "least_height": 0.01, "seams": Seams()}
K = np.array([[200.0, 0, 79.5], [0, 200, 59.5], [0, 0, 1]])
# The table is z = 0, its middle the origin; the camera looks down on it from 1 m.
SUPPORT = Support(
    Similarity(np.eye(3), np.zeros(3), np.ones(())), np.array([-0.4, -0.4]), np.ones((80, 80), bool), 1.0, 0.0
)
DOWN = Similarity(np.diag([1.0, -1, -1]), np.array([0.0, 0, 1]), np.ones(()))


def box(low, high):
    return trimesh.creation.box(bounds=[low, high]).subdivide_to_size(0.008)


def surface(*boxes):
    """Of boxes, without their bottoms."""
    whole = trimesh.util.concatenate([box(*one) for one in boxes])
    return make_mesh(whole.vertices, whole.faces, colours=np.full((len(whole.vertices), 3), 120, np.uint8))


def photo(*boxes):
    """Depth of the boxes' tops from above."""
    depth = np.ones((120, 160), np.float32)
    rows, columns = np.mgrid[:120, :160]
    for low, high in boxes:
        z = 1 - high[2]
        x, y = (columns - K[0, 2]) / K[0, 0] * z, -(rows - K[1, 2]) / K[1, 1] * z
        depth[(x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])] = z
    return PosedFrame("above", np.zeros((120, 160, 3), np.uint8), depth, np.ones(depth.shape, bool), K, DOWN)


def pixel(x, y, z):
    return K[0, 0] * x / (1 - z) + K[0, 2], -K[1, 1] * y / (1 - z) + K[1, 2]


ONE, TWO = ([-0.2, -0.05, 0], [-0.1, 0.05, 0.08]), ([0.1, -0.05, 0], [0.16, 0.05, 0.06])
HIGH = ([0.1, -0.05, 0.075], [0.16, 0.05, 0.12])  # above TWO; what is between them was not seen
CRUMB = ([0.0, 0.1, 0], [0.008, 0.108, 0.006])


def test_things_are_in_order_of_size_and_crumbs_are_none():
    parts = separate(surface(ONE, TWO, CRUMB), SUPPORT, [photo(ONE, TWO)], **HOW)
    assert [part.name for part in parts] == ["object_1", "object_2"]
    assert parts[0].mesh.vertices[:, 0].max() < 0 < parts[1].mesh.vertices[:, 0].min()


def test_a_piece_that_floats_belongs_to_what_it_floats_above():
    parts = separate(surface(ONE, TWO, HIGH), SUPPORT, [photo(ONE, HIGH)], **HOW)
    assert len(parts) == 2 and max(part.mesh.vertices[:, 2].max() for part in parts) == pytest.approx(0.12)


def test_hints_name_things_and_come_first():
    x, y = pixel(0.13, 0.0, 0.06)
    for hint in (Hint("mug", "above", x, y), Hint("mug", None, x - 8, y - 8, x + 8, y + 8)):
        parts = separate(surface(ONE, TWO), SUPPORT, [photo(ONE, TWO)], [hint], **HOW)
        assert [part.name for part in parts] == ["mug", "object_1"] and parts[0].hinted
        assert parts[0].mesh.vertices[:, 0].min() > 0


def test_a_hint_makes_a_piece_that_floats_a_thing():
    x, y = pixel(0.13, 0.0, 0.12)
    parts = separate(surface(ONE, TWO, HIGH), SUPPORT, [photo(ONE, HIGH)], [Hint("lid", None, x, y)], **HOW)
    assert len(parts) == 3 and parts[0].mesh.vertices[:, 2].min() > 0.07


@pytest.mark.parametrize(
    ("hint", "message"),
    [
        (Hint("mug", "below", 5, 5), "called below"),
        (Hint("mug", None, 500, 5), "outside"),
        (Hint("mug", None, 80, 60), "cm from anything"),
        (Hint("mug", None, 70, 50, 80, 60), "nothing that stands"),
    ],
)
def test_hints_that_mean_nothing_are_refused_in_a_sentence(hint, message):
    with pytest.raises(CaptureError, match=message):
        separate(surface(ONE, TWO), SUPPORT, [photo(ONE, TWO)], [hint], **HOW)


def test_an_empty_table_is_told():
    with pytest.raises(CaptureError, match="nothing"):
        separate(surface(CRUMB), SUPPORT, [photo()], **HOW)
