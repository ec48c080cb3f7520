"""Tests are stricter than users: shapes are checked at run time, warnings are errors, promotion is strict."""

import os
from pathlib import Path

import hypothesis
import jax
import pytest
from jaxtyping import install_import_hook

# Compilation takes most of the tests' time, and half as long with these emitters; `test_pipeline` compares their answer
# with that of the default ones. The processes that tests start compile so, too. JAX 0.12 ends at a flag it has no more.
if jax.__version_info__ < (0, 11):
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}".strip()
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # for the processes that tests start; jax here has read it already
jax.config.update("jax_platforms", os.environ["JAX_PLATFORMS"])
install_import_hook(["ipjax", "ipjax_kernels"], "beartype.beartype")

_CACHE = Path(__file__).resolve().parent.parent / "build" / "xla-cache"
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_numpy_dtype_promotion", "strict")

hypothesis.settings.register_profile("ci", max_examples=30, deadline=None, derandomize=True, database=None)
hypothesis.settings.register_profile("thorough", max_examples=300, deadline=None)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture
def shared() -> Path:
    """The folder of data that is not in the repository; tests that need it skip, and say so."""
    if not SHARED.is_dir():
        pytest.skip(f"no shared data at {SHARED}")
    return SHARED


@pytest.fixture
def x64():
    """Run a test in float64; the library itself never sets it."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def weights_cache(tmp_path, monkeypatch) -> Path:
    """A cache of weights of the test's own, not made yet, whatever the environment says."""
    for name in ("IPJAX_WEIGHTS", "IPJAX_OFFLINE", "HF_HUB_OFFLINE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "weights"


@pytest.fixture
def case(tmp_path, monkeypatch) -> Path:
    """A folder with every input of a frame for the command, all of them well-formed; nothing is kept beyond it."""
    from builders.command_lines import write_case

    monkeypatch.setenv("IPJAX_NO_CACHE", "1")
    monkeypatch.setenv("IPJAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("IPJAX_DEBUG", raising=False)
    write_case(tmp_path)
    return tmp_path
