"""Frames in tar files, as webdataset and BOP's image-wise data sets have them. Nothing is unpacked to disc.

A strange tar file cannot write anywhere, since only regular members are looked at and their content stays in memory; a
member that claims more than a file may take, or more than the archive has, is refused before it is read.
"""

import dataclasses
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipjax.files.storage.budget import check_budget
from ipjax.labelling.sources.records import FrameKey, SourceError, SourceFrame, hash_plain
from ipjax.labelling.sources.samples import number_samples, read_sample, split_name

_BYTES_PER_MEMBER = 2048  # of memory while an archive is listed


@dataclasses.dataclass(frozen=True)
class _Member:
    archive: Path
    offset: int  # bytes
    size: int


class TarShards:
    """Every frame of one tar file, or of those in a folder, in the order in which they stand there.

    Args:
        path: the tar file, or the folder.
        numbers: of the objects in the data set, in their order.
        use_masks: take the visible masks, where there are any.

    Raises:
        SourceError: no tar file, a packed or a damaged one, or no frames in them.
    """

    kind = "tar files"

    def __init__(self, path: Path, numbers: Sequence[int], *, use_masks: bool = True):
        self.path, self.numbers, self.use_masks = path, list(numbers), use_masks
        self.archives = [path] if path.is_file() else sorted(path.glob("*.tar"))
        self.members: dict[str, _Member] = {}
        self.parts: dict[str, dict[str, str]] = {}
        for archive in self.archives:
            for name, member in _list_members(archive):
                known = split_name(name.rpartition("/")[2])
                if known is None:
                    continue
                key = known[0]
                if known[1] in self.parts.get(key, {}):
                    raise SourceError(f"{archive}: {name} is there twice: the names of frames must differ")
                self.members[f"{archive.name}/{name}"] = member
                self.parts.setdefault(key, {})[known[1]] = f"{archive.name}/{name}"
        if not self.parts:
            raise SourceError(f"{path}: there are no frames KEY.rgb.jpg, KEY.depth.png, KEY.camera.json in it")

    def keys(self) -> list[FrameKey]:
        """Archive by archive, in the order of the members."""
        return number_samples(self.parts)

    def read(self, key: FrameKey) -> SourceFrame:
        """One frame from its members."""
        where = f"{self.path}: {key.name}"
        return read_sample(where, self.parts[key.name], self._load, self.numbers, use_masks=self.use_masks)

    def identity(self) -> dict[str, Any]:
        """The names and sizes of all members."""
        sizes = [(name, member.size) for name, member in self.members.items()]
        return {"masks": self.use_masks, "files": hash_plain(sizes)}

    def _load(self, name: str) -> bytes:
        member = self.members[name]
        check_budget(member.size, name)
        with open(member.archive, "rb") as file:
            file.seek(member.offset)
            content = file.read(member.size)
        if len(content) < member.size:
            raise ValueError(f"{name}: the archive ends in the middle of it")
        return content


def _list_members(archive: Path) -> list[tuple[str, _Member]]:
    """The regular members of a tar file: name, place and size."""
    found: list[tuple[str, _Member]] = []
    last = -1
    try:
        with tarfile.open(archive, "r:") as file:
            while (member := file.next()) is not None:
                if member.offset <= last:  # a header of negative size leads back to where it stands
                    raise SourceError(f"{archive}: its headers go in a circle")
                last = member.offset
                check_budget(_BYTES_PER_MEMBER * len(found), f"{archive}: its list of members")
                if member.isreg() and not member.issparse() and member.size >= 0:
                    found.append((member.name, _Member(archive, member.offset_data, member.size)))
    except SourceError:
        raise
    except (tarfile.TarError, OSError, EOFError, OverflowError, UnicodeError, ValueError) as error:
        packed = archive.name.endswith((".gz", ".xz", ".bz2", ".zst", ".tgz"))
        said = "it is packed: unpack it to a plain .tar" if packed else " ".join(str(error).split())
        raise SourceError(f"{archive}: not a readable tar file ({said})") from None
    return found
