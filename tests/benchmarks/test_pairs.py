"""Which pairs of views are tried: of one data set, across several, and that truths belong to their frames."""

import numpy as np
import pytest
from builders.bop_roots import write_ellipsoids

from benchmarks.pairs import dataset_groups, view_angle
from benchmarks.photo_pairs import table


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = [tmp_path_factory.mktemp(name) / name for name in ("one", "other")]
    return [write_ellipsoids(folder, scenes=2, images=2) for folder in made]


def keys(folders):
    return {(g.object, g.reference.name, query.name) for g in dataset_groups(folders) for query in g.queries}


def test_within_a_set_every_frame_meets_all_of_other_scenes(folders):
    found = keys(folders[:1])
    assert found and all(reference[:6] != query[:6] for _, reference, query in found)
    assert all((name, query, reference) in found for name, reference, query in found)


def test_across_sets_pairs_are_of_different_sets_only_both_ways(folders):
    found = keys(folders)
    assert found and all(reference.split()[0] != query.split()[0] for _, reference, query in found)
    assert all((name, query, reference) in found for name, reference, query in found)
    assert {reference.split()[0] for _, reference, _ in found} == {"one", "other"}


def test_the_object_is_where_the_truth_says(folders):
    """The middle of the mask and the projected centre agree without bias."""
    group = next(dataset_groups(folders[:1]))
    off = []
    for shot in (group.reference, *group.queries):
        assert view_angle(shot, shot) == pytest.approx(0, abs=1e-3)
        x, y, z = shot.K @ shot.camera_from_object.translation
        rows, columns = np.nonzero(shot.mask)
        off.append([columns.mean() - x / z, rows.mean() - y / z])
    assert (np.abs(np.mean(off, axis=0)) < 2).all()


def test_the_table_counts_what_was_not_found_as_a_miss():
    right = {"key": ["rgb", "a", "b", "c"], "angle": 20, "add_s": 0.02, "rotation": 4.0, "translation_mm": 5.0}
    right |= {"scale": 1.02, "mssd_recall": 1.0, "mspd_recall": 0.5, "agreement": [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]}
    wrong = right | {"rotation": 170.0, "add_s": 0.3, "agreement": [0.01, 0.01, 0.1, 0.0, 0.0, 1.0]}
    lost = {"key": ["rgb", "a", "b", "d"], "angle": 20, "failure": "no pose found"}
    line = next(line for line in table([right, wrong, lost, right]).splitlines() if "| 15–30° |" in line)
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:6] == ["rgb", "15–30°", "4", "50%", "50%", "50%"]
    assert cells[6:11] == ["4°", "5 mm", "100%", "2", "2"]
