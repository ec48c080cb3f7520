"""The encoder of a weights file: built once, identified by its checksum, verified to its end."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from builders.weight_files import TINY, random_tensors
from safetensors.numpy import save_file

from ipjax.files.weights import encoder as encoders
from ipjax.files.weights import finding, hashes
from ipjax.files.weights.catalogue import CATALOGUE, OFFICIAL, Source, WeightsError
from ipjax.files.weights.encoder import default_block, load_encoder, verify
from ipjax.files.weights.hashes import cached_hash
from ipjax.files.weights.matching import load_matching_encoder
from ipjax.networks.dinov2 import PRESETS, find_preset

pytestmark = pytest.mark.usefixtures("weights_cache")


def test_verify_reads_to_the_end(tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    tensors = random_tensors(TINY)
    save_file(tensors, tmp_path / "a.safetensors")
    assert verify(tmp_path / "a.safetensors").preset == "tiny"
    encoder = load_encoder(tmp_path / "a.safetensors", preset="tiny", block=1)
    assert encoder.block == 1 and encoder.identity.startswith("dinov2 tiny block=1 norm=1 float32 sha256:")
    half = load_encoder(str(tmp_path / "a.safetensors"), dtype="bfloat16")
    assert half.block == 1 and half.identity != encoder.identity
    save_file(tensors | {"norm.bias": np.full(12, np.inf, np.float32)}, tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match="not finite"):
        verify(tmp_path / "a.safetensors")


@pytest.fixture
def count(monkeypatch):
    """How often files are hashed and models filled."""
    homes = {"hash_file": hashes, "build_model": encoders}
    calls = dict.fromkeys(homes, 0)

    def counting(name):
        inner = getattr(homes[name], name)

        def call(*args):
            calls[name] += 1
            return inner(*args)

        return call

    for name in calls:
        monkeypatch.setattr(homes[name], name, counting(name))
    return calls


def age(path: Path, seconds: float) -> None:
    os.utime(path, ns=(path.stat().st_mtime_ns, path.stat().st_mtime_ns - int(seconds * 1e9)))


def test_a_file_is_hashed_once_for_as_long_as_it_stays_as_it_is(tmp_path, weights_cache, count, monkeypatch):
    monkeypatch.setattr(hashes, "_SETTLED", 0)
    path = tmp_path / "large.pth"
    data = bytearray(hashes._CACHED_FROM)

    def ask() -> tuple[bool, int]:
        """Whether the sum is right, and how often the file was read for it."""
        before = count["hash_file"]
        return cached_hash(path) == hashlib.sha256(data).hexdigest(), count["hash_file"] - before

    path.write_bytes(data)
    assert ask() == (True, 1) and ask() == (True, 0)
    for place in range(3):  # another content of the same size
        data[place] = 7
        path.write_bytes(data)
        assert ask() == (True, 1) and ask() == (True, 0)
    data[9] = 1
    path.write_bytes(data)
    age(path, 3600)  # whoever sets its time back
    assert ask() == (True, 1)
    data += b"x"
    path.write_bytes(data)
    assert ask() == (True, 1)
    (kept,) = (weights_cache.parent / "hashes").iterdir()
    for damaged in ("", "[" * 100_000, "[1]", json.dumps({"path": str(path)})):
        kept.write_text(damaged)
        assert ask() == (True, 1) and ask() == (True, 0)
    (tmp_path / "small.pth").write_bytes(b"x")
    cached_hash(tmp_path / "small.pth")
    assert len(list((weights_cache.parent / "hashes").iterdir())) == 1
    monkeypatch.setattr(hashes, "_SETTLED", 3600 * 10**9)  # what was changed a moment ago may change again unseen
    path.write_bytes(data)
    assert ask() == (True, 1) and ask() == (True, 1)


def test_verify_does_not_trust_what_is_remembered(tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    save_file(random_tensors(TINY), path)
    monkeypatch.setattr(finding, "cached_hash", lambda _: "0" * 64)
    with pytest.raises(WeightsError, match="is damaged: its sha256 is"):
        verify(path)


def test_the_encoder_that_made_an_object_is_the_only_one_built(tmp_path, weights_cache, count, monkeypatch):
    """Two files of weights are here; the object file's record says which, before any model is made."""
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    weights_cache.mkdir(parents=True)
    identities = {}
    for seed, name in enumerate(("first", "second", "third")):
        save_file(random_tensors(TINY, seed), weights_cache / f"{name}.safetensors")
        sha256 = hashlib.sha256((weights_cache / f"{name}.safetensors").read_bytes()).hexdigest()
        source = Source(name, "tiny", f"{name}.safetensors", "none", sha256 if seed else None, url="http://x")
        monkeypatch.setitem(CATALOGUE, name, source)
        identities[name] = f"dinov2 tiny block=1 norm=1 bfloat16 sha256:{sha256}"
    monkeypatch.setattr(finding, "PREFERRED", ("first",))
    weights_of = lambda names, given=None: load_matching_encoder(
        [Path(f"{name}.ipjax") for name in names], [identities[name] for name in names], given
    )
    for name in identities:
        count["build_model"] = 0
        assert weights_of([name, name]).identity == identities[name] and count["build_model"] == 1
    count["build_model"] = 0
    with pytest.raises(ValueError, match=r"second\.ipjax: made with the encoder .* but first\.ipjax with"):
        weights_of(["first", "second"])
    identities["lost"] = identities["first"][:-64] + "0" * 64
    with pytest.raises(ValueError, match=r"lost\.ipjax: made with .* weights are not here \(here are: .*second"):
        weights_of(["lost"])
    assert count["build_model"] == 0
    with pytest.raises(ValueError, match=r"lost\.ipjax: made with the encoder .* onboard the object again"):
        weights_of(["lost"], "second")
    monkeypatch.setenv("IPJAX_WEIGHTS", str(weights_cache / "own.safetensors"))
    save_file(random_tensors(TINY, 9), weights_cache / "own.safetensors")
    sha256 = hashlib.sha256((weights_cache / "own.safetensors").read_bytes()).hexdigest()
    identities["own"] = f"dinov2 tiny block=0 norm=1 float32 sha256:{sha256}"
    assert weights_of(["own"]).identity == identities["own"]


def test_default_blocks_are_never_the_last():
    found = {name: default_block(name) for name in OFFICIAL}
    assert (found["vits14"], found["vits14_reg"], found["vitl14"], found["vitg14_reg"]) == (8, 9, 18, 30)
    assert all(block < find_preset(name).depth - 1 for name, block in found.items())
