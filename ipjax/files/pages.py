"""HTML pages from Jinja templates: what is put into them is escaped, pictures are part of the page."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8


def render_page(template: Path, **values: Any) -> str:
    """The text of a template (``*.html.jinja``), which may include what lies beside it, and ``pages.css``, which all
    pages share.

    Values are escaped. A value that the template names and that is not given is an error (`jinja2.UndefinedError`).
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template.name).render(**values)


def embed_image(image: UInt8[np.ndarray, "h w c"], kind: str = "png", quality: int = 88) -> str:
    """A data URL of an image of three or four channels; ``kind`` is "png", or "jpg" of that ``quality``."""
    import cv2

    channels = image[..., [2, 1, 0, 3]] if image.shape[-1] == 4 else image[..., ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    _, code = cv2.imencode(f".{kind}", np.ascontiguousarray(channels), options)
    mime = "jpeg" if kind == "jpg" else "png"
    return f"data:image/{mime};base64,{base64.b64encode(code.tobytes()).decode()}"
