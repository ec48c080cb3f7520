"""EXIF as cameras write it: the photo's own tags in a directory of their own."""

from PIL import Image

ORIENTATION, OWN = 0x0112, 0x8769
FOCAL, FOCAL_ON_FILM, WIDTH, HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003


def make_exif(tags: dict, orientation: int | None = None) -> Image.Exif:
    """For `save` of any format; a TIFF keeps the photo's tags only if the main directory names theirs."""
    exif = Image.Exif()
    exif.get_ifd(OWN).update(tags)
    exif[OWN] = 0
    if orientation is not None:
        exif[ORIENTATION] = orientation
    return exif
