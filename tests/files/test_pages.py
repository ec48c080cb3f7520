"""Pages from templates: whatever is put into them stays text, and pictures are part of the page."""

import base64

import cv2
import numpy as np
import pytest
from jinja2 import UndefinedError

from ipjax.files.pages import embed_image, render_page


def test_values_are_escaped_and_what_lies_beside_is_included(tmp_path):
    (tmp_path / "page.css").write_text("p > a{color:red}")
    template = tmp_path / "page.html.jinja"
    template.write_text('<style>{% include "page.css" %}</style><p title="{{ name }}">{{ name }}</p>')
    escaped = "&lt;script&gt;&amp;&#34;&#39;"
    page = render_page(template, name="<script>&\"'")
    assert page == f'<style>p > a{{color:red}}</style><p title="{escaped}">{escaped}</p>'


def test_a_value_that_is_missing_is_no_empty_place(tmp_path):
    template = tmp_path / "page.html.jinja"
    template.write_text("{{ title }}")
    with pytest.raises(UndefinedError, match="title"):
        render_page(template)


@pytest.mark.parametrize(("kind", "mime", "channels"), [("png", "png", 3), ("png", "png", 4), ("jpg", "jpeg", 3)])
def test_an_embedded_image_is_the_image(kind, mime, channels):
    image = np.zeros((16, 24, channels), np.uint8) + np.arange(40, 40 + channels, dtype=np.uint8)
    head, _, code = embed_image(image, kind).partition(",")
    assert head == f"data:image/{mime};base64"
    read = cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_UNCHANGED)
    order = [2, 1, 0, 3][:channels]
    np.testing.assert_allclose(read[..., order].astype(int), image, atol=0 if kind == "png" else 2)
