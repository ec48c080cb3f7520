"""Where the cache is: what the environment says, else what the operating system says."""

import sys
from pathlib import Path

import pytest

from ipjax.files.storage.cache import cache_folder


def test_the_environment_decides(monkeypatch, tmp_path):
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path and cache_folder("weights") == tmp_path / "weights"
    monkeypatch.setenv("IPJAX_CACHE", "~/elsewhere")
    assert cache_folder() == Path("~/elsewhere").expanduser()
    assert not cache_folder().exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the folders of Linux")
def test_on_linux_it_is_where_it_was_before_platformdirs_said_so(monkeypatch, tmp_path):
    monkeypatch.delenv("IPJAX_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("xla") == tmp_path / "ipjax" / "xla"
    for unset in (lambda: monkeypatch.setenv("XDG_CACHE_HOME", ""), lambda: monkeypatch.delenv("XDG_CACHE_HOME")):
        unset()
        assert cache_folder("weights") == Path("~/.cache").expanduser() / "ipjax" / "weights"
