"""A matting package that is installed finds the object where nothing else does; none is needed, nothing is fetched."""

import sys
import types

import numpy as np
import pytest
from PIL import Image

from ipjax import cli
from ipjax.onboarding.foreground import Photo
from ipjax.onboarding.photo import prepare_photo

NAMES = ("U2NET_HOME", "REMBG_HOME", "XDG_DATA_HOME")


def busy_photo():
    """A ball on a chequered ground, and its mask."""
    y, x = np.mgrid[:120, :160]
    mask = (x - 80) ** 2 + (y - 55) ** 2 < 30**2
    tiles = ((x // 8 + y // 8) % 2)[..., None]
    return np.where(mask[..., None], [180, 40, 30], 60 + 90 * tiles * [1, 0, 2]).astype(np.uint8), mask


@pytest.fixture
def rembg(monkeypatch, tmp_path):
    """A module in the package's place, which answers as the package does; what it was asked; and where models are."""
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    module = types.ModuleType("rembg")
    asked = []
    module.new_session = lambda name: asked.append(name) or name
    module.remove = lambda image, session, only_mask: np.where(busy_photo()[1], 255, 30).astype(np.uint8)
    monkeypatch.setitem(sys.modules, "rembg", module)
    return module, asked, tmp_path


@pytest.mark.parametrize(
    ("file", "model"),
    [
        (".rembg/models/isnet-general-use/isnet-general-use.onnx", "isnet-general-use"),
        (".u2net/u2net.onnx", "u2net"),
    ],
)
def test_the_installed_package_finds_the_object(rembg, file, model):
    _, asked, home = rembg
    path = home / file
    path.parent.mkdir(parents=True)
    path.touch()
    rgb, mask = busy_photo()
    found = prepare_photo(Photo(rgb)).foreground
    np.testing.assert_array_equal(found.mask, mask)
    assert found.method == "matting" and asked == [model]
    assert any("cut out by the package rembg" in note for note in found.notes)


def test_it_is_not_asked_where_something_else_tells(rembg):
    _, asked, home = rembg
    (home / ".u2net").mkdir()
    (home / ".u2net" / "u2net.onnx").touch()
    rgb, mask = busy_photo()
    plain = np.where(mask[..., None], rgb, 200).astype(np.uint8)
    assert prepare_photo(Photo(plain)).foreground.method == "background"
    assert prepare_photo(Photo(rgb), box=(45, 20, 70, 70)).foreground.method == "grabcut"
    assert prepare_photo(Photo(rgb), mask=mask).foreground.method == "given"
    assert asked == []


def test_no_model_is_fetched_and_failures_are_one_sentence(rembg, tmp_path, monkeypatch, capsys):
    module, asked, home = rembg
    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    Image.fromarray(busy_photo()[0]).save(tmp_path / "photo.png")
    words = ["onboard", str(tmp_path / "photo.png"), "-o", str(tmp_path / "photo.ipjax")]
    assert cli.main(words) == 2
    told = capsys.readouterr().err.strip()
    assert "none is downloaded without being asked" in told and "\n" not in told and asked == []
    (home / ".u2net").mkdir()
    (home / ".u2net" / "u2net.onnx").touch()

    def end():
        raise SystemExit(1)

    for remove, answer in (
        (lambda *_, **__: end(), "has no ONNX runtime"),
        (lambda *_, **__: 1 / 0, "division by zero"),
        (lambda *_, **__: np.zeros((4, 4), np.uint8), "not that of the photo"),
        (lambda *_, **__: np.zeros((120, 160), np.uint8), "no object in the photo"),
    ):
        module.remove = remove
        assert cli.main(words) == 2
        told = capsys.readouterr().err.strip()
        assert answer in told and "\n" not in told


def test_without_the_package_a_mask_is_asked_for(monkeypatch):
    monkeypatch.delitem(sys.modules, "rembg", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"or a click on it$"):
        prepare_photo(Photo(busy_photo()[0]))
