"""The page needs nothing but itself, shows every figure, and escapes what it is given."""

import re
from dataclasses import replace
from itertools import pairwise

from ipjax.bop.scoring.benchmark.figures import THRESHOLDS
from ipjax.bop.scoring.benchmark.page import render_benchmark, write_page
from ipjax.bop.scoring.benchmark.tables import SHARES


def test_the_page_has_every_figure_and_a_curve_for_each_entry(compared, tmp_path):
    page = write_page(compared.found, tmp_path / "page.html").read_text()
    assert not re.search(r"(src|href)=|@import|url\(|<script", page)
    for key in SHARES:
        for entry in compared.found.entries:
            for one in (*entry.objects.values(), entry.mean, entry.all):
                assert f">{100 * getattr(one, key):.1f}</td>" in page
    curves = re.findall(r'<polyline points="([^"]+)"', page)
    assert len(curves) == 2 * len(compared.found.entries)
    points = [[tuple(map(float, point.split(","))) for point in curve.split()] for curve in curves]
    assert all(len(curve) == len(THRESHOLDS) for curve in points)
    for curve in points:  # shares only grow, and up is less in SVG
        assert all(a[0] < b[0] and a[1] >= b[1] for a, b in pairwise(curve))
    # "sure" is the best everywhere, and in seconds too; bold is the best of its data set alone.
    means = page[page.index("Means over objects") : page.index("</table>")]
    bold = re.findall(r'<td class="(bar[^"]*)"', means)
    assert ["best" in words for words in bold] == [True, False, True, False] * (len(bold) // 4)
    assert "1 of 6 targets have no estimate" in page


def test_names_are_escaped_and_one_participant_is_no_winner(compared):
    found = compared.found
    entry = replace(found.entries[0], participant="<b>&", dataset="real")
    page = render_benchmark(replace(found, participants=("<b>&",), datasets=("real",), entries=(entry,), notes=()))
    assert "<b>&" not in page and "&lt;b&gt;&amp;" in page
    assert not re.search('class="bar[^"]* best', page) and 'class="group' not in page
