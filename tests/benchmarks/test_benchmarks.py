"""The benchmark commands: what they print is what was measured, and the table goes where it should."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import ablation, calibration, compiling, table
from benchmarks.measure import compile_fresh, summarise, time_in_turns
from benchmarks.photo_pairs import camera_from_true_mesh
from benchmarks.results_page.runs import Study
from ipjax.config import ConfidenceConfig, Config
from ipjax.estimation.confidence import probability
from ipjax.files.settings import describe_config, read_config
from ipjax.inference.estimator import QUICK
from ipjax.records import Agreement, Similarity
from ipjax.synthetic.degradation import degrade
from ipjax.synthetic.objects import make_object

ROOT = Path(__file__).resolve().parents[2]
RESULTS = {
    "device": "a device",
    "platform": "cpu",
    "cores": 2,
    "jax": "0",
    "python": "3",
    "date": "2000-01-01",
    "quick": False,
    "rows": [
        {
            "name": "neighbours",
            "implementation": "nearest (xla)",
            "size": "50 × 576² × 384",
            "dtype": "float32",
            "ratio_to_product": 1.25,
            "ratio_to_large_product": 0.5,
            "temporary_bytes": 2**20,
            **summarise([0.001, 0.002, 0.003]),
        },
        {"name": "neighbours", "implementation": "odd", "size": "1", "dtype": "float32"},
        {"name": "estimate", "implementation": "batch", "size": "2", "dtype": "float32", "queries_per_s": 12.0},
    ],
}


def test_a_table_replaces_what_stands_between_its_marks(tmp_path, monkeypatch):
    results, page = tmp_path / "results.json", tmp_path / "page.md"
    results.write_text(json.dumps(RESULTS))
    page.write_text(f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n")
    for _ in range(2):  # again and again, with the same outcome
        monkeypatch.setattr(sys, "argv", ["table", str(results), "--into", str(page)])
        table.main()
        text = page.read_text()
        assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
        assert "2 ms" in text and "1.25 × product" in text and "12 queries/s" in text and "1 MiB" in text
        assert text.count(table.BEGIN) == 1 and "| odd |" not in text
        assert "| odd |" in results.with_suffix(".md").read_text()  # every row, beside the results
    page.write_text("no marks")
    with pytest.raises(SystemExit):
        table.main()
    assert page.read_text() == "no marks"


def test_the_readme_has_a_place_for_the_table():
    text = (ROOT / "README.md").read_text()
    assert text.count(table.BEGIN) == text.count(table.END) == 1


def test_temporary_bytes_and_turns_are_real():
    run, seconds, temporary = compile_fresh(lambda x: jnp.sum(jnp.sort(x)), jnp.zeros(10_000))
    assert seconds > 0 and temporary >= 40_000
    times = time_in_turns({"one": lambda: run(jnp.zeros(10_000)), "other": lambda: run(jnp.ones(10_000))}, repeats=4)
    assert [len(x) for x in times.values()] == [4, 4] and min(map(min, times.values())) > 0


def test_with_rest_calls_are_made_that_do_not_count():
    """Threads that wake up share a core for a while: what is timed comes after."""
    count = []
    times = time_in_turns({"one": lambda: count.append(0)}, repeats=3, rest=0.01)
    assert len(times["one"]) == 3 and len(count) > 1 + 2 * 3


def test_a_quick_run_writes_its_rows(tmp_path):
    path = tmp_path / "rows.json"
    command = [sys.executable, "-m", "benchmarks", "--quick", "--only", "umeyama", "--json", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    results = json.loads(path.read_text())
    assert {row["implementation"] for row in results["rows"]} == {"umeyama", "vmapped jnp.linalg.svd"}
    for row in results["rows"]:
        assert row["runs"] == 7 and 0 < row["fastest_ms"] <= row["median_ms"]
        assert row["temporary_bytes"] >= 0 and row["compile_s"] > 0
    assert "| umeyama |" in done.stdout and "s in all" in done.stdout


def test_the_page_of_an_accelerator_has_the_forms_of_the_kernel(tmp_path):
    page, path = tmp_path / "page.md", tmp_path / "rows.json"
    command = [sys.executable, "-m", "benchmarks.accelerator", "--quick", "--only", "neighbours"]
    command += ["--page", str(page), "--json", str(path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    rows = json.loads(path.read_text())["parts"]["neighbours"]
    timed = {row["what"]: row for row in rows if "median_ms" in row}
    assert set(timed) == {"nearest (xla)", "one large product", "nearest (pallas)"}
    assert all(row["in_a_row_ms"] > 0 and row["compile_s"] > 0 for row in timed.values())
    assert [row["indices_differ"] for row in rows if "indices_differ" in row] == [0, 0]
    text = page.read_text()
    assert "## Nearest neighbours" in text and text.count("| nearest (pallas) |") == 1


def test_the_ablation_goes_from_the_paper_to_the_default(tmp_path):
    steps = []
    for name, changes in ablation.STEPS.items():
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(changes))
        steps.append(read_config(path))
    assert steps[0] == Config.paper() and steps[-1] == Config()
    assert len({str(describe_config(step)) for step in steps}) == len(steps)


def test_the_ablation_has_a_row_for_each_step_and_a_column_for_each_study():
    def run(step, share):
        part = {"recalls": {"ar": share}, "intervals": {"ar": [share - 0.1, share + 0.1]}}
        medians = {"rotation_deg": 100 * share, "translation_mm": 2.0, "scale_percent": 3.0}
        return {"method": f"ipjax-{step}", "all_frames": part, "medians": medians, "notes": []}

    studies = [
        Study(title, Path(), None, [run("01_paper", share), run("02_more", share + 0.2)])
        for title, share in (("scans", 0.5), ("worse", 0.25))
    ]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in ablation.table(studies).splitlines()]
    assert lines[0][1:] == ["scans", "worse"]
    assert lines[2] == ["01 paper", "50.0 [40.0, 60.0]", "25.0 [15.0, 35.0]"]
    assert lines[3] == ["02 more", "70.0 [60.0, 80.0]", "45.0 [35.0, 55.0]"]
    assert lines[-1] == ["02 more", "70.0 / 2.0 / 3.0", "45.0 / 2.0 / 3.0"]


def test_a_calibration_finds_the_odds_that_made_the_data():
    rng = np.random.default_rng(0)
    features = np.concatenate([np.ones((4000, 1)), rng.normal(size=(4000, 4))], axis=1)
    true = np.array([0.5, 1.0, -2.0, 0.0, 0.7])
    chance = calibration.chances(features, true)
    right = rng.random(4000) < chance
    found = calibration.fit_logistic(features, right)
    np.testing.assert_allclose(found, true, atol=0.2)
    held = calibration.fit_logistic(features, right, signs=(0, 1, 1, 1, 1))
    assert held[2] == 0 and np.all(held[1:] >= 0)
    error, rows = calibration.reliability(calibration.chances(features, found), right)
    assert error < 0.03 and sum(count for _, _, count in rows) == 4000
    assert calibration.reliability(np.full(100, 0.9), np.arange(100) < 50)[0] == pytest.approx(0.4)


def test_chances_are_the_probabilities_of_the_estimate():
    row = make_row(0, True)
    features, _, _ = calibration.cases([row])
    weights = ConfidenceConfig().drawn
    agreement = Agreement(*(jnp.asarray(x, jnp.float32) for x in row["agreement"]))
    expected = float(probability(agreement, jnp.asarray(weights)))
    assert calibration.chances(features, weights)[0] == pytest.approx(expected, rel=1e-4)


def test_shrinkage_is_chosen_on_objects_left_out():
    rows = [make_row(turn, turn % 3 > 0) for turn in range(6)]
    assert calibration.choose_ridge(rows) in calibration.RIDGES


def test_an_estimate_of_a_degraded_mesh_is_one_of_the_true_mesh():
    mesh = make_object("mug")
    _, back = degrade(mesh, 3)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    truth = Similarity(turn * np.sign(np.linalg.det(turn)), np.array([0.1, -0.2, 0.9]), np.asarray(0.2))
    info = SimpleNamespace(object_from_mesh=Similarity(np.eye(3), np.array([0.1, 0.0, 0.3]), np.asarray(2.0)))
    camera_from_object = truth @ back @ info.object_from_mesh.inverse()
    found = camera_from_true_mesh(camera_from_object, info, back)
    np.testing.assert_allclose(found.to_matrix(), truth.to_matrix(), atol=1e-9)


def make_row(turn: int, right: bool, *, squared: float = 6.0) -> dict:
    quality = 0.9 if right else 0.3
    return {
        "key": ["scan", f"{turn:04d} mug-{turn}", "photo", "scene 0"],
        "agreement": [quality, quality, quality, quality, 1.0, 0.2],
        "add": 0.02 if right else 0.5,
        "squared_mahalanobis": squared,
        "scale_deviations": 0.5,
        "scale_free": True,
        "independent": 1.0,
        "absent": {"agreement": [0.2, 0.1, 0.1, 0.0, 1.0, 0.9]},
    }


def test_objects_that_judge_are_not_those_that_fit(tmp_path):
    path = tmp_path / "pairs.jsonl"
    real = make_row(9, True) | {"key": ["scan", "0009 obj_000004", "photo", "scene 0"]}
    rows = [make_row(turn, turn % 3 > 0) for turn in range(8)]
    path.write_text("".join(json.dumps(row) + "\n" for row in [*rows, real]))
    read = calibration.read([path])
    assert len(read) == 8  # those of real data are left out
    fit, held = calibration.split(read)
    assert {r["key"][1] for r in fit}.isdisjoint(r["key"][1] for r in held) and len(fit) == len(held) == 4
    features, right, there = calibration.cases(held)
    assert features.shape == (8, 7) and there.sum() == 4 and not right[~there].any()
    text, diagram = calibration.page(held, ConfidenceConfig())
    assert "expected calibration error" in text and sum(count for *_, count in diagram) == 8
    calibration.draw(diagram, tmp_path / "diagram.png")
    assert (tmp_path / "diagram.png").stat().st_size > 1000


def test_compilation_is_measured_anew_each_time():
    found = [compiling.measure(jnp.sort, (jnp.arange(3.0)[::-1],), options) for options in (None, QUICK)]
    assert all(took[name] > 0 for took, _ in found for name in ("trace", "xla", "clock"))
    assert [float(compiled(jnp.array([2.0, 1.0, 0.0]))[0]) for _, compiled in found] == [0, 0]
    pose = Similarity(jnp.eye(3), jnp.zeros(3), jnp.asarray(2.0))
    moved = Similarity(jnp.eye(3), jnp.array([0.0, 0.2, 0.0]), jnp.asarray(2.0))
    near, off = (SimpleNamespace(camera_from_object=x) for x in (pose, moved))
    assert compiling.far(near, near) == 0 and compiling.far(near, off) == pytest.approx(0.1)
