"""Compiled programs are kept between runs, so that only the first estimate of an object waits for the compiler."""

import os

import jax

from ipjax.files.storage.cache import cache_folder


def use_compilation_cache() -> None:
    """Keep compiled programs in a folder of the cache that only this user can read.

    Does nothing where ``IPJAX_NO_CACHE=1`` is set, where JAX has been given another folder already, or where the folder
    cannot be made or belongs to another user: compiled programs are code, and another user's are never run.
    """
    if os.environ.get("IPJAX_NO_CACHE", "") not in ("", "0"):
        return
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:  # the user has set one
        return
    folder = cache_folder("xla")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return
        folder.chmod(0o700)
    except OSError:  # slower, but no reason to fail
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
