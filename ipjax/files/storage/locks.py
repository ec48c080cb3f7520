"""Locks between processes: one at a time."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def locked(path: str | Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock file ``path`` while the block runs: one process, or thread, at a time.

    The lock is the operating system's, so it ends with the process that holds it, however that ends; the file itself
    is removed by the last holder and means nothing. Where the file system knows no locks, there is none.

    Args:
        wait: for as long as another holds it; else BlockingIOError.
    """
    path = Path(path)
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            _take(handle, wait)
            # The last holder may have removed the file while we waited: then the name may belong to another file.
            held = _is_same(handle, path)
        except BaseException:
            os.close(handle)
            raise
        if held:
            break
        os.close(handle)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows does not remove open files
            path.unlink()
        os.close(handle)


def _take(handle: int, wait: bool) -> None:
    try:
        import fcntl
    except ImportError:
        return _take_on_windows(handle, wait)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL):
            raise


def _take_on_windows(handle: int, wait: bool) -> None:
    import msvcrt  # pyright: ignore
    import time

    while True:
        try:
            return msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore
        except OSError:
            if not wait:
                raise BlockingIOError(errno.EWOULDBLOCK, "another process holds the lock") from None
            time.sleep(0.1)


def _is_same(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False
