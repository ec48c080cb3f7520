"""Grippers from files and to them, and what is said of files that are none."""

import json

import pytest

from ipjax.robot.grippers import FRANKA_HAND, GRIPPERS, describe_gripper, parse_gripper, read_gripper, write_gripper


@pytest.mark.parametrize("name", list(GRIPPERS))
def test_round_trip(name, tmp_path):
    assert read_gripper(name) == GRIPPERS[name]
    assert read_gripper(write_gripper(tmp_path / "hand.json", GRIPPERS[name])) == GRIPPERS[name]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other"}, 'with "format": "ipjax gripper 1"'),
        ({"closing": "z"}, "the axis along which the fingers close"),
        ({"opening_m": 0}, "'opening_m' .* is positive, not 0"),
        ({"opening_m": "wide"}, "'opening_m' .* is a number"),
        ({"opening_m": True}, "'opening_m' .* is a number"),
        ({"reach_m": 1e999}, "'reach_m' .* is finite"),
        ({"pad_m": [0.02]}, "'pad_m' .* is a list of 2 numbers"),
        ({"force_n": None}, "'force_n' .* is a number"),
        ({"opening_m": 10**400}, "'opening_m' .* is finite"),
        ({"opening_m": 80}, "'opening_m' .*: 80 m are no hand's: lengths are in metres"),
        ({"pad_m": [0.2, 0.02]}, "the pads are longer along z than the fingers"),
        ({"boxes": 3}, "'boxes' is a list"),
        ({"boxes": [{"centre_m": [0, 0, 0]}]}, "box 0: 'half_sizes_m' is a list of 3 numbers"),
        ({"boxes": [{"centre_m": [0, 0, 0], "half_sizes_m": [1, 1, -1]}]}, "box 0: 'half_sizes_m' are positive"),
    ],
)
def test_what_is_wrong_is_said(change, said, tmp_path):
    entry = describe_gripper(FRANKA_HAND) | change
    with pytest.raises(ValueError, match=said):
        parse_gripper(entry)
    path = tmp_path / "hand.json"
    path.write_text(json.dumps(entry))
    with pytest.raises(ValueError, match=f"hand.json: .*{said}"):
        read_gripper(path)


def test_a_name_that_is_neither_is_said():
    with pytest.raises(ValueError, match="neither franka, robotiq nor a file"):
        read_gripper("frankly")
