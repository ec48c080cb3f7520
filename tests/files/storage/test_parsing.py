"""Structured text: what is read, and that no text can construct an object, recurse or blow up."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.files.storage.parsing import parse, parse_json, parse_yaml, read_json, read_text


def trees(text):
    """Nested lists and dictionaries of what JSON and YAML both know."""
    leaves = st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.floats(-1e9, 1e9) | text
    return st.recursive(leaves, lambda kids: st.lists(kids, max_size=4) | st.dictionaries(text, kids), max_leaves=12)


@given(trees(st.text(max_size=20)))
def test_json_comes_back(tree):
    assert parse_json(json.dumps(tree)) == tree
    assert parse_json(json.dumps(tree).encode()) == tree


@given(trees(st.text("aböß :#-[]{}&*!%'\"", max_size=20)))
def test_yaml_comes_back(tree):
    import yaml

    assert parse_yaml(yaml.safe_dump({"a": tree}, allow_unicode=True)) == {"a": tree}


def test_yaml_as_ros_and_opencv_write_it():
    text = (
        "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [ 1., 2.e-3 ]\n---\nsecond: 1\n"
    )
    assert parse(text) == {"K": {"rows": 1, "cols": 2, "dt": "d", "data": [1.0, 0.002]}}
    assert parse("a: 1e-3\nb:\n- 1\n- -2E5\n- .5e1\nc: '1e3'") == {"a": 1e-3, "b": [1, -2e5, 5.0], "c": "1e3"}
    assert parse("{fx: 1, fy: 2.5}") == {"fx": 1, "fy": 2.5}  # YAML that begins like JSON


def _aliases(merge: bool) -> str:
    lines = ["a: &a {x: 1}"] + [
        f"{c}: &{c} " + (f"{{<<: [{', '.join(['*' + p] * 9)}]}}" if merge else f"[{', '.join(['*' + p] * 9)}]")
        for p, c in zip("abcdefghij", "bcdefghijk", strict=True)
    ]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        ("- " * 5_000, "nested too deeply"),
        ("a: " + "[" * 5_000, "nested too deeply"),
        ("a: " + "{b: " * 5_000, "nested too deeply"),
        (_aliases(merge=False), "more than 50,000 values"),
        (_aliases(merge=True), "more than 50,000 values"),
        ("a: &a [*a]", "inside what it names"),
        ("!!python/object/apply:os.getcwd []", "could not determine a constructor"),
        ("a: !!python/name:os.getcwd", "could not determine a constructor"),
        ("a: !mine 1", "could not determine a constructor"),
        ("a: !!timestamp x", "not valid YAML"),
        ("a: 2020-13-45", "not valid YAML"),
        ("? [a]\n: b", "not valid YAML"),
        ("a: [1, 2", "line 1"),
        ("a: 1\nb: c: d", "line 2"),
        ('{"a": 1,\n "b" 2}', "not valid JSON: line 2"),
        ("[" + "1" * 5_000 + "]", "not valid JSON"),
        ("\x00\x01", "not valid YAML"),
        ("[" + "[]," * 5_000_000 + "[]]", "640 MB"),
        ("[" + "{}," * 5_000_000 + "{}]", "640 MB"),
    ],
)
def test_hostile_text_is_refused_in_one_sentence(text, said):
    with pytest.raises(ValueError, match=said) as caught:
        parse(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_files(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_bytes(b"\xef\xbb\xbf" + b'{"a": [1, 2]}')
    assert read_json(path) == {"a": [1, 2]}
    path.write_bytes(b"[" * 99_999)
    with pytest.raises(ValueError, match=r"a\.json: not valid JSON: it is nested"):
        read_json(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"a\.json: not a text file"):
        read_json(path)
    with pytest.raises(ValueError, match=r"b\.json: no such camera file"):
        read_text(tmp_path / "b.json", "camera file")
    monkeypatch.setenv("IPJAX_FILE_BUDGET", "1")
    path.write_text(" " * 600_000)
    with pytest.raises(ValueError, match="more than the 1 MB"):
        read_text(path)
    monkeypatch.setenv("IPJAX_FILE_BUDGET", "many")
    with pytest.raises(ValueError, match="IPJAX_FILE_BUDGET"):
        read_text(path)
