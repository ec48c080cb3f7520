"""Downloads from a server of our own: resumed, checked, and never without being asked."""

import dataclasses
import urllib.request

import pytest
from builders.weight_server import replace_catalogue, serving, source_of

from ipjax.files.weights import finding
from ipjax.files.weights.catalogue import WeightsError
from ipjax.files.weights.finding import fetch, find_path, resolve

pytestmark = pytest.mark.usefixtures("weights_cache")


@pytest.fixture
def server():
    with serving() as running:
        yield running


@pytest.fixture
def catalogue(monkeypatch, server):
    """A catalogue of one file, on our server."""
    monkeypatch.setattr(finding, "PREFERRED", ("test",))
    return replace_catalogue(monkeypatch, {"test": source_of(server)})


def test_download(server, weights_cache, catalogue):
    found = fetch()
    assert found.path == weights_cache / "weights.pth" and found.path.read_bytes() == server.data
    assert (found.source, found.pinned) == ("download", True) and "as published" in found.describe()
    assert [p.name for p in weights_cache.iterdir()] == ["weights.pth"]
    assert fetch().source == "cache" and resolve().source == "cache" and find_path() == found.path
    assert len(server.requests) == 1


def test_download_resumes_within_a_call_and_across_calls(server, weights_cache, catalogue):
    server.stop_after = [1_000_000, 500_000]
    assert fetch().path.read_bytes() == server.data
    assert server.requests == ["", "bytes=1000000-", "bytes=1500000-"]
    (weights_cache / "weights.pth").rename(weights_cache / "whole")
    server.requests.clear()
    server.stop_after = [900_000, 10, 10]
    with pytest.raises(OSError, match=r"stopped early .* run it again"):
        fetch()
    assert (
        not (weights_cache / "weights.pth").exists() and (weights_cache / "weights.pth.part").stat().st_size == 900_020
    )
    assert fetch().path.read_bytes() == server.data
    assert server.requests[-1] == "bytes=900020-" and not (weights_cache / "weights.pth.part").exists()


def test_a_complete_part_is_only_checked(server, weights_cache, catalogue):
    weights_cache.mkdir(parents=True)
    (weights_cache / "weights.pth.part").write_bytes(server.data)
    assert fetch().path.read_bytes() == server.data


def test_a_server_that_does_not_resume_starts_again(server, weights_cache, catalogue):
    weights_cache.mkdir(parents=True)
    (weights_cache / "weights.pth.part").write_bytes(b"x" * 70)
    server.ranges = False
    assert fetch().path.read_bytes() == server.data


def test_the_wrong_file_is_not_kept(server, weights_cache, catalogue):
    catalogue["test"] = source_of(server, "0" * 64)
    with pytest.raises(WeightsError, match="not the published file"):
        fetch()
    assert list(weights_cache.iterdir()) == []


def test_an_unpublished_sum_is_recorded_and_said(server, weights_cache, catalogue, caplog):
    catalogue["test"] = source_of(server, None)
    found = fetch()
    assert not found.pinned and "no published value" in found.describe()
    assert "recorded" in caplog.text and found.sha256 in (weights_cache / "weights.pth.sha256").read_text()
    assert resolve().sha256 == found.sha256
    with open(found.path, "r+b") as file:
        file.write(b"tampered")
    with pytest.raises(WeightsError, match="not the file that was published"):
        resolve()


def test_an_unreachable_network_is_a_sentence(server, weights_cache, catalogue):
    server.error = 404
    with pytest.raises(OSError, match="answers 404") as caught:
        fetch()
    assert "\n" not in str(caught.value)
    catalogue["test"] = dataclasses.replace(source_of(server), url="http://127.0.0.1:1/weights.pth")
    with pytest.raises(OSError, match="cannot be reached"):
        fetch()
    with pytest.raises(WeightsError, match=r"cannot be reached.*ipjax weights fetch"):
        resolve(download=True)
    assert list(weights_cache.iterdir()) == []


def test_offline_and_by_default_the_network_is_not_touched(server, catalogue, monkeypatch):
    monkeypatch.setattr(urllib.request, "urlopen", lambda *_, **__: pytest.fail("the network was touched"))
    with pytest.raises(WeightsError, match="run `ipjax weights fetch test`"):
        resolve()
    with pytest.raises(WeightsError):
        resolve(download=True, offline=True)
    for name in ("IPJAX_OFFLINE", "HF_HUB_OFFLINE"):
        monkeypatch.setenv(name, "1")
        with pytest.raises(WeightsError):
            resolve(download=True)
        with pytest.raises(WeightsError, match="downloads are forbidden"):
            fetch()
        monkeypatch.delenv(name)
