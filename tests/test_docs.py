"""The pages of the API and the guides are built without a warning, and none is left out."""

import subprocess
import sys
from pathlib import Path

import ipjax
import ipjax.metrics

BUILDER = Path(__file__).with_name("docs.py")


def test_every_public_name_and_guide_has_a_page(tmp_path):
    # In a process of its own: the shape checker of these tests would show in every signature.
    folder = tmp_path / "docs"
    done = subprocess.run([sys.executable, str(BUILDER), str(folder)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    text = (folder / "ipjax.html").read_text()
    assert all(f'id="{name}"' in text for name in ipjax.__all__)
    errors = (folder / "ipjax/metrics.html").read_text()
    assert all(f'id="{name}"' in errors for name in ipjax.metrics.__all__)
    for guide in ("README.html", "CHANGELOG.html", "notebooks/4_pose.html", "benchmarks/results/accuracy.html"):
        assert (folder / "guide" / guide).is_file() and f"{guide}" in text + (folder / "guide/README.html").read_text()


def test_a_link_that_leads_nowhere_is_an_error(tmp_path):
    (tmp_path / "index.html").write_text('<a href="there.html">there</a><a href="https://example.org">far</a>')
    code = (
        f"import sys; sys.path[:0] = [{str(BUILDER.parent)!r}]; import docs, pathlib; "
        f"docs.check_links(pathlib.Path({str(tmp_path)!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode != 0 and "index.html → there.html" in done.stderr and "example.org" not in done.stderr
    (tmp_path / "there.html").write_text("")
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0
