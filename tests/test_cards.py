"""Results in a notebook: short texts, and HTML that is safe and whole."""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np
import pytest

import gis_radar as gr
from gis_radar.base import card, table_card
from gis_radar.base.notebooks import MOST_ROWS
from gis_radar.calibration import Clocks, Localization, SensorClock, Track
from gis_radar.dataset import measure

SAMPLE = gr.sample_folder()
SIGMA = dict.fromkeys(("easting", "northing", "height", "roll", "pitch", "yaw"), 0.25)


class Reader(HTMLParser):
    """Collects the text of HTML, its tags, and what it would load."""

    def __init__(self, html):
        super().__init__()
        self.open, self.tags, self.loaded, self.text = [], set(), [], ""
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.loaded += [value for name, value in attrs if name in {"src", "href"}]
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += f"{data} "


def a_pose(sensor="R1", **more):
    evidence = {"sigma": SIGMA, "covariance": (np.eye(6) * 0.25**2).tolist(), **more}
    fields = {"easting": 690_000.123, "northing": 5_336_000.0, "height": 520.0,
              "yaw": 30.0, "pitch": 3.0, "roll": -1.0}  # fmt: skip
    return gr.Pose(sensor=sensor, crs="EPSG:25832", **fields, evidence=evidence)


def a_track(events=("", "rejected", "moved")):
    poses = [
        a_pose(event=event, corrected=event == "", vehicles=9, fitness=0.9) for event in events
    ]
    since = 1_749_713_400.0 + 5.0 * np.arange(len(poses))
    return gr.PoseTrack(poses=tuple(poses), since=since)


def a_localization():
    x = np.linspace(5.0, 60.0, 50)
    traces = np.column_stack([x, 0.1 * x, np.zeros(50)])
    rate = np.where(np.arange(50) % 2, 5.0, -5.0)
    return Localization(
        pose=a_pose(), fitness=0.97, observable=False, vehicles=12, traces=traces, range_rate=rate
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory, first_seconds):
    """The results of the sample that take no search."""
    roads = gr.read_map(SAMPLE / "junction.osm")
    tiles = gr.make_tiles(roads)
    dataset = measure(
        [first_seconds(SAMPLE / "R1.parquet", 20)], [gr.read_pose(SAMPLE / "R1.json")], tiles, None,
        tmp_path_factory.mktemp("cards") / "dataset", hits_only=True, check=False,
    )  # fmt: skip
    return {
        "map": roads,
        "dataset": dataset,
        "heat map": gr.make_heatmap(dataset),
        "quality": gr.measure_quality(dataset),
        "clocks": Clocks(
            reference="R1", clocks={"R2": SensorClock(offset_s=0.5, sigma_s=0.01)},
            refused={"R3": "no common traffic"}, pairs={},
        ),
        "pose": a_pose(),
        "pose track": a_track(),
        "track": Track(poses=a_track()),
        "localization": a_localization(),
        "site": gr.read_site(SAMPLE / "SITE.toml"),
    }  # fmt: skip


def test_every_result_has_a_short_text(made):
    for name, result in made.items():
        text = repr(result)
        assert text.startswith(type(result).__name__ + "("), name
        assert "\n" not in text, name
        assert len(text) < 240, f"{name}: {text}"


def test_every_result_of_a_notebook_has_a_card(made):
    for name, result in made.items():
        if name == "site":
            continue
        read = Reader(result._repr_html_())
        assert read.tags <= {"div", "strong", "table", "tr", "th", "td", "img"}
        assert all(url.startswith("data:image/png;base64,") for url in read.loaded), name
        assert ("img" in read.tags) == (name in {"heat map", "localization"}), name


def test_what_cards_say(made):
    def text(name):
        return Reader(made[name]._repr_html_()).text

    assert "690000.123 m ± 0.25" in text("pose")
    assert "2025-06-12T07:30:05Z" in text("pose track")
    assert "rejected" in text("pose track")
    assert "no answer: no common traffic" in text("clocks")
    assert "observable no" in text("localization")
    assert "R1" in text("dataset")
    assert "does not fix" in repr(made["localization"])
    assert "moved 0" not in repr(made["track"])


def test_cards_escape_what_others_wrote():
    bad = '<script>alert("x")</script>'
    for html in (card(bad, {bad: bad}), table_card(bad, [bad], [[bad]]), a_pose()._repr_html_()):
        assert "<script" not in html
    pose = a_pose(sensor="<b>R1</b>", method="<img src=x>")
    read = Reader(pose._repr_html_())
    assert "b" not in read.tags
    assert read.loaded == []
    assert "<b>R1</b>" in read.text


def test_a_long_table_is_cut():
    html = table_card("t", ["n"], [[i] for i in range(MOST_ROWS + 7)])
    assert html.count("<tr>") == MOST_ROWS + 2
    assert "... 7 more" in html
