"""Small JPEG pictures of templates."""

import io
from typing import Any

import numpy as np

PICTURE_SIDE = 160  # pixels, longest side of a stored template image
LARGEST_SIDE = 1024  # of one that is read


def decode_picture(picture: bytes) -> np.ndarray | None:
    """A JPEG as RGB; None where it is none, or promises more pixels than a picture here can have."""
    import cv2
    from PIL import Image

    try:
        with Image.open(io.BytesIO(picture), formats=["JPEG"]) as image:
            if max(image.size) > LARGEST_SIDE:
                return None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def compress_pictures(pictures: Any) -> list[bytes]:
    """Template images uint8 ``[views, height, width, 3]`` as JPEGs of at most PICTURE_SIDE; JPEGs stay."""
    if not isinstance(pictures, np.ndarray):
        return [bytes(picture) for picture in pictures]
    import cv2

    if pictures.ndim != 4 or pictures.shape[-1] != 3 or pictures.dtype != np.uint8:
        raise ValueError(
            f"pictures must be uint8 [views, height, width, 3], not {pictures.dtype} {list(pictures.shape)}"
        )
    compressed = []
    for picture in pictures:
        zoom = PICTURE_SIDE / max(picture.shape[:2])
        if zoom < 1:
            picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
        _, code = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 90])
        compressed.append(code.tobytes())
    return compressed
