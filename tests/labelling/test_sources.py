"""Every form of a source gives the same frames; what is missing, damaged or hostile is refused in words."""

import io
import json
import os
import tarfile

import numpy as np
import pytest
from builders.labelled_frames import (
    make_frames,
    write_frame_folder,
    write_image_wise,
    write_scenes,
    write_tars,
)

from ipjax.labelling.sources.opening import open_source
from ipjax.labelling.sources.records import Source, SourceError, hash_keys

WRITERS = {
    "scenes": lambda root, frames: write_scenes(root / "scenes", frames),
    "images": lambda root, frames: write_image_wise(root / "images", frames),
    "tars": lambda root, frames: write_tars(root / "tars", frames, 2),
}


def assert_frame(read, frame, obj: int) -> None:
    np.testing.assert_array_equal(read.rgb, frame.rgb)
    np.testing.assert_allclose(read.depth[frame.mask], frame.depth[frame.mask], atol=6e-5)
    np.testing.assert_allclose(read.camera, frame.matrix)
    ((place, mask),) = read.masks
    assert place == obj and np.array_equal(mask, frame.mask)


@pytest.mark.parametrize("form", WRITERS)
def test_all_forms_of_bop_give_the_same_frames(tmp_path, form):
    frames = make_frames(3)
    source = open_source(WRITERS[form](tmp_path, frames), [1, 2])
    assert isinstance(source, Source)
    keys = source.keys()
    assert [(key.scene, key.image) for key in keys] == [(0, 0), (0, 1), (0, 2)]
    for number, key in enumerate(keys):
        assert_frame(source.read(key), frames[number], number % 2)
    # The object that is not asked for is left out, and so are all masks where they are not to be used.
    assert open_source(source.path, [2]).read(keys[0]).masks == ()
    assert open_source(source.path, [1, 2], use_masks=False).read(keys[0]).masks is None
    # The same elsewhere is the same source; other content is not.
    (tmp_path / "elsewhere").mkdir()
    again = open_source(WRITERS[form](tmp_path / "elsewhere", frames), [1, 2])
    assert again.identity() == source.identity() and hash_keys(again.keys()) == hash_keys(keys)
    (tmp_path / "other").mkdir()
    other = open_source(WRITERS[form](tmp_path / "other", make_frames(6)[3:]), [1, 2])
    assert other.identity() != source.identity()


def test_frames_in_tar_files_and_in_folders_have_the_same_names(tmp_path):
    frames = make_frames(4)
    assert (
        open_source(write_tars(tmp_path / "tars", frames, 3), [1]).keys()
        == open_source(write_image_wise(tmp_path / "images", frames), [1]).keys()
    )


def test_a_folder_of_frames(tmp_path):
    frames = make_frames(2)
    source = open_source(write_frame_folder(tmp_path / "scene", frames), [1])
    keys = source.keys()
    assert [(key.name, key.image) for key in keys] == [("000000", 0), ("000001", 1)]
    for number, key in enumerate(keys):
        assert_frame(source.read(key), frames[number], 0)
    (tmp_path / "scene" / "depth" / "000001.png").unlink()
    with pytest.raises(ValueError, match=r"000001\.png: there is no depth image of this name"):
        open_source(tmp_path / "scene", [1]).read(keys[1])


def test_masks_of_a_folder_are_the_objects_in_their_order_or_as_scene_gt_says(tmp_path):
    folder = write_frame_folder(tmp_path / "scene", make_frames(1))
    whole = (folder / "mask" / "000000.png").read_bytes()
    (folder / "mask" / "000000.png").unlink()
    for place in range(3):
        (folder / "mask" / f"000000_{place:06d}.png").write_bytes(whole)

    def masks_of(numbers):
        source = open_source(folder, numbers)
        return [obj for obj, _ in source.read(source.keys()[0]).masks]

    assert masks_of([7, 8]) == [0, 1]
    (folder / "scene_gt.json").write_text(json.dumps({"0": [{"obj_id": 8}, {"obj_id": 7}, {"obj_id": 8}]}))
    assert masks_of([7, 8]) == [1, 0, 1]
    before = open_source(folder, [7, 8]).identity()
    (folder / "scene_gt_info.json").write_text(json.dumps({"0": [{"visib_fract": s} for s in (0.0, 1.0, 1.0)]}))
    assert masks_of([7, 8]) == [0, 1]
    assert open_source(folder, [7, 8]).identity() != before, "other masks are used: it is another source"
    (folder / "scene_gt.json").write_text('{"0": [{"obj_id": 1e999}]}')
    with pytest.raises(ValueError, match="no list of instances of 000000"):
        masks_of([7, 8])


def test_names_that_are_no_numbers_get_a_place(tmp_path):
    folder = write_frame_folder(tmp_path / "scene", make_frames(2))
    for kind in ("rgb", "depth", "mask"):
        (folder / kind / "000000.png").rename(folder / kind / "left.png")
    (folder / "camera.json").write_text(json.dumps({"fx": 100, "fy": 100, "cx": 63.5, "cy": 47.5, "depth_scale": 0.1}))
    (folder / "scene_camera.json").unlink()
    keys = open_source(folder, [1]).keys()
    assert [(key.name, key.image) for key in keys] == [("000001", 0), ("left", 1)]


def add(file: tarfile.TarFile, name: str, content: bytes, **fields) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    for field, value in fields.items():
        setattr(member, field, value)
    file.addfile(member, io.BytesIO(content))


def test_strange_members_of_a_tar_file_do_nothing(tmp_path):
    """Names that lead out of the folder, links, devices: nothing is written, and the frames beside them are read."""
    before = sorted(tmp_path.iterdir())
    frames = make_frames(1)
    folder = write_tars(tmp_path / "tars", frames, 1)
    with tarfile.open(folder / "shard-000000.tar", "a") as file:
        add(file, "../../escaped.rgb.png", b"x")
        add(file, "/etc/absolute.rgb.png", b"x")
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
            add(file, "000000_000001.rgb.png", b"", type=kind, linkname="/etc/passwd")
        add(file, "000000_000002.rgb.png", b"", type=tarfile.CHRTYPE)
    source = open_source(folder, [1, 2])
    keys = source.keys()
    by_name = {key.name: key for key in keys}
    assert sorted(by_name) == ["000000_000000", "absolute", "escaped"]
    assert_frame(source.read(by_name["000000_000000"]), frames[0], 0)
    with pytest.raises(ValueError, match=r"escaped: it has no depth\.png"):
        source.read(by_name["escaped"])
    assert sorted(tmp_path.iterdir()) == sorted([*before, folder])


def test_members_that_claim_too_much_are_refused_before_they_are_read(tmp_path):
    """One that the archive does not hold, and one that it does, with holes on disc for its gigabytes."""
    folder = write_tars(tmp_path / "tars", make_frames(1), 1)
    archive = folder / "shard-000000.tar"
    whole = archive.read_bytes()
    with tarfile.open(archive) as file:
        at = {member.name: member.offset for member in file}["000000_000000.mask_visib.json"]
    header = tarfile.TarInfo("000000_000000.mask_visib.json")
    header.size = 2**33
    archive.write_bytes(whole[:at] + header.tobuf(tarfile.GNU_FORMAT)[:512] + whole[at + 512 :])
    with pytest.raises(SourceError, match="not a readable tar file"):
        open_source(folder, [1, 2])
    os.truncate(archive, at + 512 + 2**33 + 1024)
    source = open_source(folder, [1, 2])
    with pytest.raises(ValueError, match=r"mask_visib\.json would take 8,192 MB of memory"):
        source.read(source.keys()[0])


def test_an_archive_that_ends_in_the_middle(tmp_path):
    folder = write_tars(tmp_path / "tars", make_frames(2), 2)
    archive = folder / "shard-000000.tar"
    with tarfile.open(archive) as file:
        last = next(member for member in file if member.name.endswith("000001.depth.png"))
    archive.write_bytes(archive.read_bytes()[: last.offset_data + 100])
    try:
        source = open_source(folder, [1, 2])
    except SourceError as error:
        assert "not a readable tar file" in str(error)
    else:
        with pytest.raises(ValueError, match=r"ends in the middle|it has no"):
            source.read(source.keys()[1])


@pytest.mark.parametrize("content", [b"", b"no tar file at all" * 100, b"\x1f\x8b packed"])
def test_what_is_no_tar_file_is_refused_in_words(tmp_path, content):
    (tmp_path / "a.tar").write_bytes(content)
    with pytest.raises(SourceError, match=r"a\.tar"):
        open_source(tmp_path / "a.tar", [1])


def test_headers_in_a_circle_end(tmp_path):
    """A size below zero would lead the reader back to where it stands."""
    header = bytearray(tarfile.TarInfo("a.rgb.png").tobuf(tarfile.GNU_FORMAT)[:512])
    header[124:136] = b"\xff" * 10 + (-1024 & 0xFFFF).to_bytes(2, "big")
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    (tmp_path / "a.tar").write_bytes(bytes(header) + bytes(1024))
    with pytest.raises(SourceError):
        open_source(tmp_path / "a.tar", [1])


def test_a_name_that_is_there_twice_is_refused(tmp_path):
    folder = write_tars(tmp_path / "tars", make_frames(1), 1)
    (folder / "shard-000001.tar").write_bytes((folder / "shard-000000.tar").read_bytes())
    with pytest.raises(SourceError, match="is there twice"):
        open_source(folder, [1])


def test_what_is_no_source_is_told_in_one_sentence(tmp_path):
    with pytest.raises(SourceError, match="no such folder or file"):
        open_source(tmp_path / "none", [1])
    with pytest.raises(SourceError, match="no frames are recognised"):
        open_source(tmp_path, [1])


def test_damaged_parts_are_named(tmp_path):
    folder = write_image_wise(tmp_path / "images", make_frames(1))
    source = open_source(folder, [1, 2])
    (key,) = source.keys()
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}
    damages = (
        ("depth.png", b"x"),
        ("camera.json", b"[]"),
        ("gt.json", b"{"),
        ("gt.json", b'[{"obj_id": 1e999}]'),
        ("gt.json", b'[{"obj_id": "mug"}]'),
        ("mask_visib.json", b"{}"),
        ("mask_visib.json", b'{"1": {"size": [10, 10], "counts": [100]}}'),
    )
    for name, content in damages:
        (folder / f"000000_000000.{name}").write_bytes(content)
        with pytest.raises(ValueError, match=r"000000_000000[.:,]"):
            source.read(key)
        (folder / f"000000_000000.{name}").write_bytes(kept[f"000000_000000.{name}"])
    assert source.read(key).masks
