"""Frames read ahead in threads while others are labelled, in their order."""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from ipjax.labelling.sources.records import FrameKey, Source, SourceFrame

READERS = 2  # threads


def read_ahead(
    source: Source, keys: Sequence[FrameKey], batch: int, readers: int = READERS
) -> Iterator[list[tuple[FrameKey, SourceFrame | str]]]:
    """Batches of frames; in the place of one that cannot be read stands the reason.

    While one batch is worked on, the next is read: no more than two batches are in memory.
    """
    waiting: deque[tuple[FrameKey, Future[SourceFrame | str]]] = deque()
    with ThreadPoolExecutor(readers) as pool:
        try:
            for start in range(0, len(keys) + batch, batch):
                found = [(key, future.result()) for key, future in waiting]
                waiting.clear()
                waiting.extend((key, pool.submit(_read, source, key)) for key in keys[start : start + batch])
                if found:
                    yield found
        finally:
            pool.shutdown(cancel_futures=True)


def _read(source: Source, key: FrameKey) -> SourceFrame | str:
    try:
        return source.read(key)
    except (ValueError, OSError, MemoryError) as error:
        return " ".join(str(error).split()) or type(error).__name__
