"""The notebooks run, end in their assertions, and are stored as they stand."""

import os
import subprocess
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = sorted((ROOT / "notebooks").glob("*.py"))


def test_there_are_notebooks():
    assert len(SCRIPTS) >= 4


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_runs(script, tmp_path):
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / "build" / "xla-cache"),
        "MPLBACKEND": "Agg",
        "JAX_PLATFORMS": "cpu",
    }
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=os.environ | cache, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_stored_notebook_is_the_script_executed(script):
    path = script.with_suffix(".ipynb")
    assert path.stat().st_size < 300_000
    stored, fresh = nbformat.read(path, as_version=4), jupytext.read(script)
    assert [(cell.cell_type, cell.source) for cell in stored.cells] == [
        (cell.cell_type, cell.source) for cell in fresh.cells
    ], f"run `make notebooks`: {path.name} is not what {script.name} says"
    code = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code), f"{path.name} was not executed"
    kinds = {output.output_type for cell in code for output in cell.outputs}
    assert "error" not in kinds and kinds & {"display_data", "execute_result", "stream"}
    assert code[-1].source.lstrip().startswith(("assert", "degrees")) and "assert" in code[-1].source
