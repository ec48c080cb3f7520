"""``ipjax capture check``: is this capture worth hours of work?"""

import argparse
import sys
from typing import Any

from ipjax.commands.capture.opening import add_capture, open_given
from ipjax.commands.interface import options
from ipjax.commands.interface.messages import Messages
from ipjax.commands.interface.parser import add_command

EXAMPLES = """\
examples:
  ipjax capture check table/                           what is there, and what looks wrong
  ipjax capture check table/ -o check.html             with a picture of every frame
  ipjax capture check rgbd_dataset_freiburg3_cabinet/ --camera tum-fr3
  ipjax capture check table/ --json | jq '.findings[] | select(.kind != "is there") | .text'

What is measured: the unit of depth and how much of it is known; whether outlines of depth lie on edges of the photos;
blur against the frames around; over- and underexposure; how much neighbours share, and how many features; whether
poses that are given fit the depth, and in which form; whether something moves with the camera.

A good capture: 20 to 60 frames around a table at 0.5 to 0.9 m, neighbours 10 to 20 degrees apart, something printed on
or beside plain objects, nothing that moves, depth registered to the colours or raw/ with depth_camera.json.

Exits with 1 where a finding says that the capture cannot be used as it is; what only looks wrong leaves it at 0.
"""


def add(steps: Any) -> None:
    """The step and its options."""
    parser = add_command(
        steps,
        "check",
        run,
        "say what a capture has, what is missing, and what looks wrong, before hours are spent",
        EXAMPLES,
    )
    add_capture(parser)
    options.add_output(parser, "PAGE.html", "also write a page with the findings and a picture of every frame")
    options.add_reporting(parser, quiet="no progress bar")


def run(arguments: argparse.Namespace, messages: Messages) -> int:
    """Look through the capture and say what was found; returns the exit status."""
    if arguments.output is not None:
        options.check_output(arguments.output, (".html", ".htm"))
    capture = open_given(arguments)
    from ipjax.capture.checks.findings import FACT, UNUSABLE, WARNING, list_findings
    from ipjax.capture.checks.inspection import inspect
    from ipjax.capture.checks.page import write_page
    from ipjax.progress import bar

    with bar(total=None, desc="looking", unit="frame", disable=arguments.quiet or not sys.stderr.isatty()) as shown:

        def advance(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        inspection = inspect(capture, progress=advance)
    findings = list_findings(inspection)
    for kind in (UNUSABLE, WARNING, FACT):
        mine = [finding for finding in findings if finding.kind == kind]
        if mine:
            messages.say(f"{kind}:" if kind != UNUSABLE else "CANNOT BE USED as it is:")
        for finding in mine:
            messages.say(f"  {finding.topic:<12} {finding.text}")
    if arguments.output is not None:
        write_page(arguments.output, inspection, findings)
    usable = not any(finding.kind == UNUSABLE for finding in findings)
    messages.finish(
        {
            "folder": str(capture.folder),
            "form": capture.form,
            "usable": usable,
            "findings": [
                {"kind": f.kind, "topic": f.topic, "text": f.text, "frames": list(f.frames)} for f in findings
            ],
            "frames": [
                {
                    "name": capture.names[index],
                    "sharpness": round(image.sharpness, 3),
                    "bright": round(image.bright, 4),
                    "dark": round(image.dark, 4),
                    "depth_known": round(image.known, 4),
                    "distance": round(image.distance, 4),
                }
                for index, image in zip(inspection.looked_at, inspection.images, strict=True)
            ],
            "pairs": [
                {
                    "frames": [pair.first, pair.second],
                    "features": pair.matches,
                    "overlap": None if pair.overlap is None else round(pair.overlap, 4),
                    "depth_difference": _first(pair.differences),
                }
                for pair in inspection.pairs
            ],
            "page": None if arguments.output is None else str(arguments.output),
        }
    )
    return 0 if usable else 1


def _first(values: tuple[float | None, ...]) -> float | None:
    return None if not values or values[0] is None else round(values[0], 5)
