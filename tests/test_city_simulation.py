"""The simulated city: its plan, the files of a site, and days drawn from measured minutes."""

from __future__ import annotations

import shutil
import tomllib
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd
import pytest

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.poses import as_tracks
from simulation.city import LEVELS, city_sites, make_site, write_city_file
from simulation.city_plan import plan_city
from simulation.drawn_days import DRAWN, DayDrawer, DrawnEvents, demand_at
from simulation.measured_minutes import PARTS, MeasuredParts

SAMPLE = gr.sample_folder()
BEGIN_S = 1_749_713_400.0  # of the sample's recordings, 100 s long
FIRST = datetime(2025, 6, 2, tzinfo=UTC)  # a Monday
WEEK = FIRST, FIRST + timedelta(days=7)
JAM = FIRST + timedelta(days=2, hours=12), FIRST + timedelta(days=2, hours=13)
SILENT = FIRST + timedelta(days=3, hours=8), FIRST + timedelta(days=3, hours=20)


@pytest.fixture(scope="module")
def parts_and_week(measure_once, tmp_path_factory):
    """Give the parts of a measured dataset, and that dataset with a week drawn from them."""
    roads = SAMPLE / "junction.osm"
    tiles, pose = gr.make_tiles(gr.read_map(roads)), gr.read_pose(SAMPLE / "R1.json")
    made = measure_once([SAMPLE / "R1.parquet"], [pose], tiles, roads)
    dataset = gr.open_dataset(shutil.copytree(made, tmp_path_factory.mktemp("city") / "site=a"))
    parts = MeasuredParts.of(dataset, [BEGIN_S], 3)
    parts = replace(parts, level=np.array([0, 0, 1]))  # the last 30 s are the jam
    drawer = DayDrawer(
        dataset=dataset, parts={frozenset(["R1"]): parts}, demands=[1.0, 1.01],
        events=DrawnEvents(jam=JAM, silent={"R1": SILENT}),
    )  # fmt: skip
    return parts, drawer.draw(*WEEK, remark="not measured")


def test_a_drawn_week_opens_and_says_that_it_is_drawn(parts_and_week):
    _, week = parts_and_week
    week.check()
    assert gr.open_dataset(week.folder).manifest.settings[DRAWN] == "not measured"
    drawn = week.recordings()["path"].str.startswith(f"{DRAWN}/")
    assert drawn.sum() == 8  # one a day, two on that with a gap
    assert len(week.hours()) == 7 * 24 - 12 + 1
    with pytest.raises(InputError, match="was deleted after the time to keep exact tables"):
        week.tracks(begin=WEEK[0], end=WEEK[1])


def test_sums_of_a_drawn_day_are_those_of_its_rows(parts_and_week):
    _, week = parts_and_week
    span = {"begin": FIRST, "end": FIRST + timedelta(days=1)}
    rows = week.lane_measures(**span)
    by_lane = rows.groupby("lane")["volume"].sum(min_count=1).dropna()
    whole = week.traffic("24h", **span).groupby("lane")["volume"].sum(min_count=1).dropna()
    assert len(by_lane) > 3
    pd.testing.assert_series_equal(by_lane, whole.loc[by_lane.index], check_dtype=False)
    seen = rows[rows["visible_share"] == 1.0]
    assert (seen["speed_counts"].map(sum) == seen["counted"]).all()
    assert (week.tile_counts(**span)["observed_steps"] == 900 * 20).mean() > 0.99
    asked = week.query("SELECT sum(counted) FROM lane_measures")
    assert asked.iloc[0, 0] == week.lane_measures()["counted"].sum()


def test_an_incident_is_drawn_from_the_jam(parts_and_week):
    parts, week = parts_and_week
    counts = week.tile_counts(begin=JAM[0], end=JAM[1])
    of_tile = counts.groupby("tile_id")["occupied_steps"]
    assert (of_tile.min() == of_tile.max()).all()  # the jam has a single part
    jam = dict(zip(parts.tile_id, PARTS * parts.tiles["occupied_steps"][2], strict=True))
    assert of_tile.first().to_dict() == {tile: jam[tile] for tile in of_tile.groups}


def test_a_sensor_that_fails_leaves_a_gap(parts_and_week):
    _, week = parts_and_week
    day = SILENT[0].replace(hour=0)
    hours = week.lane_measures(begin=day, end=day + timedelta(days=1))["begin"].dt.hour
    assert {*hours} == {*range(8), *range(20, 24)}


def test_demand_has_two_peaks_on_workdays_and_one_at_weekends():
    quarters = pd.date_range(FIRST, WEEK[1], freq="15min", inclusive="left")
    demand = demand_at(quarters).reshape(7, 96)
    morning, noon, evening = (demand[:, 4 * hour] for hour in (8, 12, 17))
    workday = np.arange(7) < 5
    assert np.array_equal((morning > noon) & (evening > noon), workday)
    assert demand[0].max() > demand[6].max() > demand[0].min()


def test_streets_of_a_city_meet_half_way():
    crossings = plan_city(20)
    assert len({each.name for each in crossings}) == 20
    places = np.array([each.place for each in crossings])
    apart = np.hypot(*(places[:, None] - places).transpose(2, 0, 1)) + 1e9 * np.eye(20)
    assert apart.min() > 250.0
    ends = Counter(
        (street.name, *np.round(np.array(each.place) + street.line[-1]).astype(int).tolist())
        for each in crossings
        for street in each.streets
    )
    assert sum(count == 2 for count in ends.values()) > 20
    assert max(ends.values()) == 2


@pytest.mark.usefixtures("sumo_installed")
def test_a_site_is_written_as_files_that_a_run_reads(tmp_path):
    sites = city_sites(tmp_path, 20)
    site = next(each for each in sites if len(each.crossing.streets) == 2)
    site = replace(site, sensors=("R1",), levels=LEVELS[1:2], knocked="R1")
    make_site(site, minutes=0.05, seed=3)
    read = gr.read_site(site.site_file)
    assert [each.name for each in read.sensor] == ["R1"]
    (track,) = as_tracks([site.pose_file("R1")])
    assert track.poses[1].yaw - track.poses[0].yaw == pytest.approx(4.0, abs=1e-3)
    names = set(gr.read_map(site.folder / "map.osm").lanes()["street"].dropna())
    assert names == {street.name for street in site.crossing.streets}
    path = write_city_file(tmp_path, [site])
    known = tomllib.loads(path.read_text(encoding="utf-8"))
    assert (tmp_path / known["site"][0]["file"]).is_file()
