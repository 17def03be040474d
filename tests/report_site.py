"""A small site with results to report on: a chain of lanelets, a crossing, a lane out of sight."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from sites import EAST, NORTH, lane_quads, pose, recording, tiles_of

import gis_radar as gr
from gis_radar.dataset import measure
from gis_radar.poses import View
from gis_radar.products import Report, make_heatmap

FILES = [
    "lanes.csv", "lanes_by_interval.csv", "quality.csv", "report.html", "report.pdf",
]  # fmt: skip
HOSTILE = "<script>alert(1)</script>"
FORMULA = "=1+1"
BEGIN = 1_750_000_000.0  # 2025-06-15T15:06:40Z, the begin of an aligned 20 s
STEPS = 1200
SIGMA = dict.fromkeys(("easting", "northing", "height", "yaw", "pitch", "roll"), 0.25)


def report_tiles():
    """Lanelets 100 and 101 follow each other; 102 crosses; 103 lies behind the sensor."""
    return tiles_of(
        [
            lane_quads(EAST + 10.0, NORTH, 0.0, count=20),
            lane_quads(EAST + 20.0, NORTH, 0.0, count=30),
            lane_quads(EAST + 24.0, NORTH - 10.0, 90.0),
            lane_quads(EAST - 60.0, NORTH, 0.0, count=10),
        ],
        height_m=370.0,
    )


def write_results(folder: Path, *, names=("R1", "R2"), interval="20s", steps=STEPS) -> Path:
    """Write a dataset and a heat map as `gis-radar run` lays them out."""
    rng = np.random.default_rng(7)
    paths, poses = [], []
    for number, name in enumerate(names):
        time = BEGIN + np.arange(steps) * 0.05
        ahead = 10.0 + (np.arange(steps) * 0.4 + 7 * number) % 25.0
        points = np.column_stack([ahead, rng.normal(0, 0.8, steps), np.full(steps, -4.5)])
        paths.append(recording(folder / f"{number}.parquet", time, points, range_rate=8.0))
        seen = pose(
            sensor=name,
            view=View(max_range_m=60.0 - 25.0 * number, elevation_deg=90.0),
            evidence={"sigma": SIGMA, "method": "lane", "fitness": 0.91},
        )
        poses.append(seen)
    dataset = measure(
        paths, poses, report_tiles(), None, folder / "dataset", hits_only=True, check=False
    )
    make_heatmap(dataset, interval=interval).write(folder / "heatmap")
    return folder


def write_run(folder: Path, *, title: str, zone="Europe/Berlin", **further) -> None:
    """Write what `gis-radar run` notes, as far as a report reads it."""
    document = {
        "site": {
            "title": title,
            "timezone": zone,
            "attribution": [f"Town of {HOSTILE}"],
            "map": {"file": "junction.osm", "source": "ours & theirs"},
            "scan": None,
            "sensor": [],
        },
        "software": {"gis_radar": "9.9", "code": "abc"},
        "stages": [],
    }
    (folder / "run.json").write_text(json.dumps(document | further), encoding="utf-8")


def write_whole_run(folder: Path) -> Path:
    """Write results and what the run notes of them, with letters beyond ASCII."""
    write_results(folder)
    write_run(folder, title="Kreuzung Münchner Straße \u2013 Süd")
    return folder


def reports_of_whole_run(once) -> dict[str, Report]:
    """Return the reports of a whole run in both languages, made once: with the fixture `once`."""
    results = once("whole run", write_whole_run)

    def write(folder):
        made = {}
        for language in ("en", "de"):
            (folder / language).mkdir()
            made[language] = gr.write_report(results, output=folder / language, language=language)
        return made

    return once("reports", write)


class Page(HTMLParser):
    """The tables, pictures and texts of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.tables, self.words = [], [], [], []
        self._cell = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in {"td", "th"}:
            self._cell = ""

    def handle_endtag(self, tag):
        if tag in {"td", "th"}:
            self.tables[-1][-1].append(self._cell)
            self._cell = None

    def handle_data(self, data):
        self.words.append(data)
        if self._cell is not None:
            self._cell += data

    def all(self, tag):
        return [attrs for each, attrs in self.attributes if each == tag]
