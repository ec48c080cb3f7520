"""Command lines of ``ipjax`` that are right, to be spoiled, and how tests run them."""

from ipjax import cli

K = {"fx": 110.0, "fy": 108.0, "cx": 63.2, "cy": 47.4}


def estimate_words(folder, *more, **replace) -> list[str]:
    """``ipjax estimate`` on the folder of the fixture `case`; ``replace``: another file for an option, or None.

    ``more`` comes last."""
    given = {"rgb": "rgb.png", "depth": "depth.png", "camera": "camera.json", "mask": "mask.png"} | replace
    words = ["estimate", str(folder / given.pop("object", "mug.ipjax")), "-o", str(folder / "out.json")]
    for name, value in given.items():
        if value is not None:
            words += [f"--{name}", str(folder / value)]
    return [*words, "--overlay", str(folder / "out.png"), *map(str, more)]


def run(argv) -> int:
    """The exit status of ``ipjax``, also where argparse ends the process."""
    try:
        return cli.main(argv)
    except SystemExit as stop:  # argparse
        return int(stop.code or 0)
