"""``ipjax doctor``: one line for each thing, and object files checked to their last byte."""

import json

from builders.command_lines import run


def test_doctor_checks_object_files(case, capfd):
    assert run(["doctor", str(case / "mug.ipjax")]) == 0
    assert "5 templates of 4 patches" in capfd.readouterr().out
    data = bytearray((case / "mug.ipjax").read_bytes())
    data[-1] ^= 1
    (case / "mug.ipjax").write_bytes(data)
    assert run(["doctor", str(case / "mug.ipjax")]) == 2
    assert "checksum" in capfd.readouterr().err


def test_a_machine_reads_what_a_person_does(case, capfd):
    assert run(["doctor", str(case / "mug.ipjax"), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["fine"] and told["objects"][0]["object_file"] == str(case / "mug.ipjax")
    assert any("5 templates of 4 patches" in line for line in told["objects"][0]["said"])


def test_everything_is_looked_at(monkeypatch, capfd):
    """Without the renderers, which have tests of their own and take seconds."""
    monkeypatch.setattr("ipjax.rendering.render.available_backends", lambda: {"egl": "no EGL", "raster": "ok"})
    status = run(["doctor"])
    lines = capfd.readouterr().out.splitlines()
    subjects = [line[4:].split("  ")[0].strip() for line in lines[:-1]]
    assert {"ipjax", "jax", "mujoco", "devices", "renderer egl", "renderer raster", "self-test"} <= set(subjects)
    assert all(line[:4] in ("ok  ", "BAD ") for line in lines[:-1]) and "\x1b" not in "".join(lines)
    assert run(["doctor", "--json"]) == status
    out, error = capfd.readouterr()
    told = json.loads(out)
    assert [check["subject"] for check in told["checks"]] == subjects and error == ""
    assert told["fine"] == (status == 0)
