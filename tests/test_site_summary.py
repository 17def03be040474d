"""The summary of a run: titles and names are text in it, no markup."""

import html
import re
from types import SimpleNamespace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from gis_radar.site.run import _literal, _summary

HOSTILE = "<script>alert(1)</script> [a](javascript:x) `b` **c** __d__ | e &lt; \\ ~~f~~\n# g"


def printed(markdown):
    """Return what a reader sees, and the tags that make it."""
    page = MarkdownIt("commonmark").enable(["table", "strikethrough"]).render(markdown)
    return html.unescape(re.sub(r"<[^>]+>", "", page)).strip(), set(re.findall(r"<(\w+)", page))


@given(text=st.text(st.characters(codec="utf-8", exclude_categories=["C"]), min_size=1))
@example(text=HOSTILE)
@example(text="1. one")
@example(text="- list")
@example(text="===")
@example(text="R_1 and _R2_ of R&D, 95 %")
def test_any_name_is_printed_as_it_is(text):
    shown, tags = printed(f"- a: {_literal(text)}")
    assert shown == " ".join(f"a: {text}".split())
    assert tags <= {"ul", "li"}


@pytest.mark.parametrize("name", ["1. one", "- list", "# title", "+ a", "=", "17) b", HOSTILE])
def test_a_name_that_begins_a_line_is_no_list(name):
    shown, tags = printed(_literal(name))
    assert (shown, tags) == (" ".join(name.split()), {"p"})


def test_names_that_are_common_stay_as_they_are():
    for name in ("R1", "R_1", "Karlsruhe, north", "R2_0.parquet: 99.9 %", "https://a.b/c_d?e=f"):
        assert _literal(name) == name


def test_a_hostile_site_makes_no_markup():
    site = SimpleNamespace(
        title=HOSTILE, time_zone="UTC", map=SimpleNamespace(source=HOSTILE), scan=None,
        attribution=[HOSTILE], sensor=[SimpleNamespace(name=HOSTILE)],
    )  # fmt: skip
    page = _summary(site, [])
    shown, tags = printed(page)
    assert tags <= {
        "h1",
        "h2",
        "p",
        "ul",
        "li",
        "table",
        "thead",
        "tbody",
        "tr",
        "th",
        "td",
        "code",
    }
    assert shown.count("<script>alert(1)</script> [a](javascript:x) `b`") == 4
    assert page.count("\n|---") == 1
