"""The summary of a run: titles and names are text in it, no markup."""

import html
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from gis_radar.base import InputError
from gis_radar.site import Site, Stage, stages
from gis_radar.site.plan import Outcome
from gis_radar.site.summary import markdown_escaped, summary_page

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
    shown, tags = printed(f"- a: {markdown_escaped(text)}")
    assert shown == " ".join(f"a: {text}".split())
    assert tags <= {"ul", "li"}


@pytest.mark.parametrize("name", ["1. one", "- list", "# title", "+ a", "=", "17) b", HOSTILE])
def test_a_name_that_begins_a_line_is_no_list(name):
    shown, tags = printed(markdown_escaped(name))
    assert (shown, tags) == (" ".join(name.split()), {"p"})


def test_names_that_are_common_stay_as_they_are():
    for name in ("R1", "R_1", "Karlsruhe, north", "R2_0.parquet: 99.9 %", "https://a.b/c_d?e=f"):
        assert markdown_escaped(name) == name


def hostile_site(folder, language):
    """Return a site whose texts are markup; a sensor's name is a folder's and cannot be."""
    for name in ("map.osm", "R1.parquet", "R1.json"):
        (folder / name).touch()
    line = " ".join(HOSTILE.split())
    return Site.model_validate(
        {
            "title": line, "language": language, "attribution": [line],
            "map": {"file": "map.osm", "source": line},
            "sensor": [{"name": "R1", "recordings": ["R1.parquet"], "pose": "R1.json"}],
        },
        context={"folder": folder},
    )  # fmt: skip


def ended(work, sensor="", **end):
    stage = Stage(name="any", work=work, inputs={}, outputs=(), sensor=sensor)
    return Outcome(stage=stage, **end)


TAGS = {"h1", "h2", "p", "ul", "li", "table", "thead", "tbody", "tr", "th", "td", "code"}


@pytest.mark.parametrize("language", ["en", "de"])
def test_a_hostile_site_makes_no_markup(tmp_path, language):
    told = {
        "facts": {HOSTILE: HOSTILE},
        "basis": [[HOSTILE, "a"], [HOSTILE, "b"]],
        "lanes_named": [["Lane"], [HOSTILE]],
        "remarks": [HOSTILE],
    }
    span = {"begin": "2026-06-01T05:00:00+00:00", "end": "2026-06-01T06:00:00+00:00"}
    outcomes = [
        ended(stages.pose_stage, "R1", state="failed", error=InputError(HOSTILE)),
        ended(stages.together_stage, state="done", figures={HOSTILE: HOSTILE}),
        ended(stages.heatmap_stage, state="done", figures=span),
        ended(stages.report_stage, state="done", figures=told),
    ]
    page = summary_page(hostile_site(tmp_path, language), outcomes)
    shown, tags = printed(page)
    assert tags <= TAGS
    # title, credits (map and attribution are one), 2 of facts, 2 of basis, and one each of lane,
    # remark and state; 2 of poses found together
    assert shown.count("<script>alert(1)</script> [a](javascript:x) `b`") == 11
    assert page.count("\n|---") == 3
    assert ("Kurz gefasst" if language == "de" else "In short") in shown
