"""``ipjax weights``: what is known and what is here, as columns for people and as JSON for machines."""

import hashlib
import json

import pytest
from builders.command_lines import run
from builders.weight_files import TINY, random_tensors
from safetensors.numpy import save_file

from ipjax.files.weights.catalogue import CATALOGUE
from ipjax.networks import dinov2


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path))
    monkeypatch.delenv("IPJAX_WEIGHTS", raising=False)
    (tmp_path / "weights").mkdir()
    return tmp_path / "weights"


def test_the_list_is_told_twice(cache, capfd):
    file = cache / CATALOGUE["vits14"].file
    file.write_bytes(b"not looked into")
    assert run(["weights", "list", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capfd.readouterr().out)["weights"]}
    assert rows.keys() == CATALOGUE.keys()
    assert (rows["vits14"]["path"], rows["vits14"]["origin"]) == (str(file), "cache")
    assert rows["vitb14"]["path"] is None
    assert run(["weights", "list"]) == 0
    heads, *lines = capfd.readouterr().out.splitlines()
    at = heads.index("file")
    assert heads.split() == ["name", "model", "licence", "origin", "file"] and len(lines) == len(CATALOGUE)
    assert {line[:at].split()[0]: line[at:] for line in lines}["vits14"] == str(file)


def test_a_file_is_verified(cache, capfd, monkeypatch):
    monkeypatch.setitem(dinov2.PRESETS, "tiny", TINY)
    path = cache / "tiny.safetensors"
    save_file(random_tensors(TINY), path)
    sum_ = hashlib.sha256(path.read_bytes()).hexdigest()
    assert run(["weights", "verify", str(path), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert (told["sha256"], told["path"], told["preset"], told["pinned"]) == (sum_, str(path), "tiny", False)
    assert run(["weights", "verify", str(path)]) == 0
    assert f"sha256 {sum_} (no published value to compare with)" in capfd.readouterr().out
    path.write_bytes(path.read_bytes()[:-4])
    assert run(["weights", "verify", str(path), "--json"]) == 2
    out, error = capfd.readouterr()
    assert out == "" and error.count("\n") == 1


def test_the_path_that_would_be_used(cache, capfd, monkeypatch):
    path = cache / "own.safetensors"
    save_file(random_tensors(TINY), path)
    monkeypatch.setenv("IPJAX_WEIGHTS", str(path))
    assert run(["weights", "path"]) == 0
    assert capfd.readouterr().out == f"{path}\n"
    assert run(["weights", "path", "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"path": str(path)}
