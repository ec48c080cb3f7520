"""Scores with the model at its estimated size, which BOP's figures do not see."""

from dataclasses import replace

import numpy as np
import pytest
from builders.bop_roots import true_rows
from hypothesis import given, settings
from hypothesis import strategies as st

from ipjax import metrics
from ipjax.bop.dataset import Dataset
from ipjax.bop.records import DatasetError
from ipjax.bop.results import ResultRow, read_results, sized_path, write_results
from ipjax.bop.scoring.errors import Model
from ipjax.bop.scoring.scores import score
from ipjax.bop.scoring.tables import format_score


def shrunk(dataset: Dataset, factor: float, seed: int = 0) -> tuple[list[ResultRow], list[float]]:
    """Poses that are a little off, and one size for all."""
    random = np.random.default_rng(seed)
    rows = [replace(r, translation=tuple(np.add(r.translation, random.normal(0, 4, 3)))) for r in true_rows(dataset)]
    return rows, [factor] * len(rows)


@given(factor=st.floats(0.6, 1.6))
@settings(max_examples=10)
def test_a_wrong_size_costs_what_it_must_and_bops_figures_do_not_see_it(small, factor):
    """True poses: MSSD at the estimated size is |f − 1| · the farthest vertex, and ADD(-S) no more than the mean."""
    rows = true_rows(small)
    names = ("mssd", "mspd", "add")
    right = score(rows, small, names, samples=0)
    found = score(rows, small, names, scales=[factor] * len(rows), samples=0)
    assert found.all_frames.recalls == right.all_frames.recalls and found.add == right.add
    assert right.all_frames.sized == {}
    for one in found.instances:
        arms = np.linalg.norm(small.mesh(one.obj_id).vertices, axis=-1)
        assert one.sized_mssd == pytest.approx(abs(factor - 1) * arms.max(), abs=1e-7)
        if one.obj_id == 2:  # three symmetries: ADD-S
            assert one.sized_add <= abs(factor - 1) * arms.mean() + 1e-9
    expected = np.mean(
        [[i.sized_mssd < t * small.models()[i.obj_id].diameter for t in metrics.THRESHOLDS] for i in found.instances]
    )
    assert found.all_frames.sized["mssd"] == pytest.approx(expected)
    shares = [found.all_frames.sized[f"size_{k}"] for k in (2, 5, 10)]
    assert shares == [float(abs(factor - 1) < t) for t in (0.02, 0.05, 0.1)]


def test_sized_errors_are_those_of_the_metrics(small):
    """The scores' float64 figures against the public functions, pose by pose, where pose and size are both off."""
    import jax.numpy as jnp

    from ipjax import metrics
    from ipjax.records import Similarity

    rows, scales = shrunk(small, 1.07)
    found = score(rows, small, ("mssd", "mspd"), scales=scales, samples=0)
    for one in found.instances:
        row = next(r for r in rows if (r.im_id, r.obj_id) == (one.im_id, one.obj_id))
        truth = small.truths(one.scene_id, one.im_id)[one.index]
        model = Model.load(small, one.obj_id)
        pose = lambda R, t, s: Similarity(*(jnp.asarray(x, jnp.float32) for x in (R, t, s)))
        expected = metrics.sized_errors(
            model.diameter,
            jnp.asarray(model.points, jnp.float32),
            model.symmetries.to_jax(),
            pose(truth.rotation, truth.translation, 1.0),
            pose(np.reshape(row.rotation, (3, 3)), np.multiply(row.translation, 1e-3), 1.07),
        )
        assert one.sized_mssd / model.diameter == pytest.approx(float(expected.mssd), rel=1e-3)
        assert one.sized_add / model.diameter == pytest.approx(float(expected.add_s), rel=1e-3)


def test_sizes_are_kept_beside_the_bop_file_and_found_there(small, tmp_path):
    rows, scales = shrunk(small, 1.03)
    path = write_results(tmp_path / "mine_small-test.csv", rows)
    plain = path.read_text()
    beside = write_results(sized_path(path), rows, scales=scales)
    assert beside.name == "mine_small-test.sized" and path.read_text() == plain
    assert beside.read_text().splitlines()[1] == f"{plain.splitlines()[1]},1.03"  # BOP's row and a column
    assert [row.scale for row in read_results(beside)] == scales and read_results(beside) == rows
    names = ("mssd", "mspd")
    given_ = score(rows, small, names, scales=scales, samples=0).all_frames
    run = lambda *a, **k: score(*a, small, names, samples=0, **k)
    assert run(path).all_frames == given_ == run(beside).all_frames
    assert run(path, sizes=False).all_frames.sized == {}
    moved = beside.rename(tmp_path / "elsewhere.csv")
    assert run(path).all_frames.sized == {} and run(path, sizes=moved).all_frames == given_
    assert "size to 5 %" in format_score(run(path, sizes=moved)) and "size to" not in format_score(run(path))
    # Sizes of other estimates: refused where asked for, left out and told where merely found.
    others = write_results(tmp_path / "others.csv", shrunk(small, 1.03, seed=1)[0], scales=scales)
    with pytest.raises(DatasetError, match=r"others.csv: it holds no size for line 2 of mine_small-test.csv"):
        run(path, sizes=others)
    others.rename(beside)
    found = run(path)
    assert found.all_frames.sized == {} and any("so that sizes are left out" in note for note in found.notes)
    whole = beside.read_text()
    for damaged in ("", whole.replace(",1.03", ",-1.03"), whole.replace("time,scale", "time,size")):
        beside.write_text(damaged)
        found = run(path)
        assert found.all_frames.sized == {} and not found.problems
        assert any(str(beside) in note and "so that sizes are left out" in note for note in found.notes)
        with pytest.raises(DatasetError, match=r"mine_small-test\.sized, line"):
            run(path, sizes=beside)
    beside.write_text(whole)
    for scale in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="its scale is"):
            write_results(tmp_path / "bad.csv", rows, scales=[scale] * len(rows))
    (tmp_path / "bad.csv").write_text(beside.read_text().replace(",1.03", ",-1.03"))
    with pytest.raises(DatasetError, match=r"line 2: scale must be positive, got -1.03"):
        read_results(tmp_path / "bad.csv")
