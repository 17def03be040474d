"""Headways, gaps and cycles on a street with a signal, by Newell's rule of following vehicles."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from functools import partial

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
from datasets import HOUR
from forks import APPROACH, LEFT, STRAIGHT, fork_dataset, strip, through
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import UTM
from shapely import LineString

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import read_hours, write_record
from gis_radar.measures import (
    DRAWN,
    PRESUMED,
    FrontStates,
    Greens,
    LaneNetwork,
    StepGrid,
    TrackedLanes,
    VehicleTable,
    VisibleRuns,
    cycles,
    headways,
)
from gis_radar.measures.cycles import CHANCE, FEW, LINE_HIDDEN, UNEVEN, are_of_another, period_of
from gis_radar.products import service_levels
from gis_radar.products.traffic import HANDBOOKS

BEGIN = HOUR * STEPS_PER_HOUR
GRID = StepGrid(begin=BEGIN, steps=STEPS_PER_HOUR, count=1)
LINE_M, LENGTH_M = 290.0, 4.5
TILES = gpd.GeoDataFrame(strip(1, (0, 0), 0, 300, 0), crs=UTM)
NETWORK = LaneNetwork.of(TILES, {1: LINE_M})
DT_S, SPEED, LAG_S, JAM_M = 0.2, 10.0, 1.2, 7.0
LAG = round(LAG_S / DT_S)


def drive(arrivals, is_red):
    """Drive vehicles that arrive at given seconds to a signal; give their fronts by 0.2 s."""
    ahead, fronts = None, []
    time = np.arange(0.0, 3600.0, DT_S)
    red = np.array([is_red(each) for each in time])
    for arrival in arrivals:
        x = np.full(len(time), np.nan)
        at, x[round(arrival / DT_S)] = 2.0, 2.0
        for k in range(round(arrival / DT_S) + 1, len(time)):
            wanted = at + SPEED * DT_S
            if red[k] and at <= LINE_M - 1.0:
                wanted = min(wanted, LINE_M - 1.0)
            before = ahead[k - LAG] if ahead is not None else np.nan
            at = max(at, min(wanted, before - JAM_M)) if np.isfinite(before) else wanted
            if at >= 299.0:
                break
            x[k] = at
        fronts.append(x)
        ahead = np.where(np.isnan(x) & (np.arange(len(x)) > np.nanargmax(x)), 1e6, x)
    return np.array(fronts)


def states_of(fronts):
    vehicle, k = np.nonzero(np.isfinite(fronts))
    later = np.clip(k + 1, 0, fronts.shape[1] - 1)
    far = np.nan_to_num(fronts[vehicle, later] - fronts[vehicle, k], nan=SPEED * DT_S)
    count = len(k)
    return FrontStates(
        vehicle=vehicle, step=BEGIN + 4 * k, lane=np.zeros(count, np.int64),
        along_m=fronts[vehicle, k], speed=far / DT_S, seen=np.ones(count, np.bool_),
    )  # fmt: skip


def vehicles_of(count):
    return VehicleTable(
        vehicle=np.arange(count), length_m=np.full(count, LENGTH_M), p_heavy=np.zeros(count),
        p_exists=np.full(count, np.nan),
    )  # fmt: skip


def visible(*hidden):
    """All tiles, but for seconds from and to in which none is."""
    edges = [0, *(20 * each for each in np.ravel(hidden).astype(int)), STEPS_PER_HOUR]
    runs = [(BEGIN + a, BEGIN + b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    rows = [(tile, *run) for tile in TILES["tile_id"] for run in runs]
    tile, first, last = np.array(rows, np.int64).T
    return VisibleRuns(tile_id=tile, first=first, last=last)


def told(fronts, *hidden, what=cycles):
    return what(tracked(fronts, visible(*hidden)))


def tracked(fronts, runs, observed=None):
    return TrackedLanes(
        network=NETWORK, grid=GRID, states=states_of(fronts), vehicles=vehicles_of(len(fronts)),
        visible=runs, observed=observed or runs,
    )  # fmt: skip


def never(_time):
    return False


def passed_s(fronts):
    """Give the seconds at which fronts cross the line, interpolated."""
    at = [np.flatnonzero(each >= LINE_M)[0] for each in fronts]
    before = np.array([each[k - 1] for each, k in zip(fronts, at, strict=True)])
    after = np.array([each[k] for each, k in zip(fronts, at, strict=True)])
    return (np.array(at) - 1 + (LINE_M - before) / (after - before)) * DT_S


@settings(max_examples=10)
@given(st.lists(st.floats(2.0, 40.0), min_size=1, max_size=15))
def test_headways_sum_to_the_time_from_first_to_last(apart):
    fronts = drive(10.0 + np.cumsum(apart), never)
    found = told(fronts, what=headways)
    passed = passed_s(fronts)
    assert len(found.headway_s) == len(apart) - 1
    assert found.headway_s == pytest.approx(np.diff(passed), abs=0.051)
    assert found.gap_s == pytest.approx(np.diff(passed) - LENGTH_M / SPEED, abs=0.06)


def test_a_pair_between_which_the_line_was_hidden_is_none():
    fronts = drive(np.array([10.0, 20.0, 30.0, 40.0]), never)  # at the line 28.8 s later
    assert told(fronts, what=headways).headway_s == pytest.approx([10.0] * 3)
    assert len(told(fronts, (52, 53), what=headways).headway_s) == 2
    assert len(told(fronts, (48, 49), what=headways).headway_s) == 1  # one passes unseen


CYCLE_S, RED_S = 70.0, 40.0


def at_signal(rate, seed, *, end=1100.0, green_s=CYCLE_S - RED_S):
    """Drive vehicles that come at random, so many a cycle, to a signal of fixed time."""
    count = round(rate * end / CYCLE_S)
    arrivals = np.sort(np.random.default_rng(seed).uniform(0.0, end, count))
    arrivals = arrivals[np.append(True, np.diff(arrivals) > 2.5)]
    return drive(arrivals, lambda time: time % CYCLE_S >= green_s)


@pytest.mark.parametrize("seed", [3, 8, 21])
def test_cycles_of_a_fixed_time_signal_are_told(seed):
    fronts = at_signal(7, seed)
    found = told(fronts)
    assert {each.reason for each in found} == {""}
    assert len(found) >= 12
    assert abs(found[0].cycle_s - CYCLE_S) <= max(3.0 * found[0].cycle_se_s, 0.5)
    begins = np.array([(each.first - BEGIN) / 20.0 for each in found])
    assert np.all((begins + 0.2) % CYCLE_S < 6.0)  # soon after the signal turns green
    passed = passed_s([each for each in fronts if np.nanmax(each) >= LINE_M])
    for each in found:
        first, after = ((step - BEGIN) / 20.0 for step in (each.first, each.after))
        assert abs(each.counted - np.sum((passed >= first) & (passed < after))) <= 1
        assert each.queue_max_m >= each.queue_mean_m >= 0.0
        assert each.queue_end_m == 0.0  # all leave with their green


def test_who_is_left_over_at_the_end_of_green_is_the_queue_there():
    fronts = at_signal(18, 5, green_s=12.0, end=500.0)  # some six leave with each green
    found = [each for each in told(fronts) if not each.reason]
    passed = passed_s([x for x in fronts if np.nanmax(x) >= LINE_M])
    truth = []
    for each in found:
        first, after = ((step - BEGIN) / 20.0 for step in (each.first, each.after))
        now = round(passed[(passed >= first) & (passed < after)].max() / DT_S)
        there = fronts[np.isfinite(fronts[:, now]) & (fronts[:, now] < LINE_M)]
        ways = np.diff(there[:, round(first / DT_S) : now])
        stood = (np.nan_to_num(ways, nan=1.0) < 0.1).any(axis=1)
        truth.append(max([0.0, *(LINE_M - there[stood, now] + LENGTH_M)]))
    assert max(truth) > 60.0
    assert min(truth) == 0.0
    assert [each.queue_end_m for each in found] == pytest.approx(truth, abs=JAM_M)


def test_the_queue_at_the_end_of_green_goes_on_over_road_that_vehicles_hide():
    """As `queue_max_m` does: nobody is seen from 21 to 65 m before the line."""
    fronts = at_signal(18, 5, green_s=12.0, end=500.0)
    runs, far = visible(), LINE_M - TILES.set_index("tile_id")["s_m"].to_numpy()
    to_line = LINE_M - fronts
    unseen = np.where((to_line > 21.0 - LENGTH_M) & (to_line < 65.0), np.nan, fronts)
    shown = np.isin(runs.tile_id, np.flatnonzero((far <= 21.0) | (far >= 65.0)))
    part = VisibleRuns(tile_id=runs.tile_id[shown], first=runs.first[shown], last=runs.last[shown])
    whole = [each for each in told(fronts) if not each.reason]
    found = cycles(tracked(unseen, part, runs))
    longer = [each.queue_end_m > 80.0 for each in whole]
    assert sum(longer) >= 3
    assert [each.first for each in found] == [each.first for each in whole]
    for of_all, of_seen in zip(whole, found, strict=True):
        if of_all.queue_end_m > 80.0:
            assert of_seen.queue_end_m == pytest.approx(of_all.queue_end_m)
            assert of_seen.queue_max_m == pytest.approx(of_all.queue_max_m)


def test_a_cycle_in_which_the_line_was_hidden_says_so():
    fronts = at_signal(7, 3)
    reasons = [each.reason for each in told(fronts, (400, 403))]
    assert reasons.count(LINE_HIDDEN) == 1
    assert set(reasons) == {"", LINE_HIDDEN}


def test_what_is_not_periodic_is_not_told():
    uneven = np.cumsum([40.0, 75.0, 52.0, 96.0, 61.0, 44.0, 83.0, 70.0])
    assert period_of(uneven) == UNEVEN
    assert period_of(uneven[:3]) == FEW
    assert period_of(60.0 * np.array([1, 2, 4, 7, 11])).length_s == pytest.approx(60.0)  # as seldom
    assert period_of(np.arange(5) * 20.0) == UNEVEN  # no signal is so fast
    late = [60.0, 72.0, 120.0, 180.0, 192.0, 240.0, 300.0, 312.0, 360.0]  # three start late
    assert period_of(np.array(late)).length_s == pytest.approx(60.0)
    even = period_of(60.0 * np.array([1, 2, 3, 5, 6]) + [0.0, 1.0, -1.0, 0.0, 1.0])
    assert even.length_s == pytest.approx(60.0, abs=0.5)
    nobody = told(drive(np.array([10.0]), never))
    assert [(each.reason, each.counted) for each in nobody] == [(FEW, None)]


@pytest.mark.parametrize("cycle_s", [47.0, 90.0, 120.0])
def test_cycles_are_told_though_some_begins_are_missed_and_some_vehicles_start_late(cycle_s):
    rng = np.random.default_rng(round(cycle_s))
    greens = cycle_s * np.arange(40)
    seen = (greens + rng.normal(2.0, 0.7, 40))[rng.random(40) < 0.45]
    late = rng.choice(greens, 8) + rng.uniform(10.0, 0.5 * cycle_s, 8)
    found = period_of(np.sort(np.append(seen, late)))
    assert found.length_s == pytest.approx(cycle_s, abs=0.5)


@pytest.mark.parametrize("between_s", [(50.0, 70.0), (80.0, 120.0)])
def test_signals_that_follow_demand_are_not_told(between_s):
    """Cycles that differ by some seconds lie near a line for a while, but most do not."""
    rng, told = np.random.default_rng(4), 0
    for _ in range(100):
        begins = np.cumsum(rng.uniform(*between_s, 90))
        told += not isinstance(period_of(begins[begins < 3600.0]), str)
    assert told <= 5


def test_a_level_of_service_follows_the_delay():
    line = LineString([(0, 0), (60, 0)])
    delays = [0.0, 10.0, 10.1, 34.0, 54.0, 79.0, 81.0, np.nan, 5.0, 5.0]
    back = [0.0] * 8 + [np.nan, 61.0]  # no stop line, and a queue beyond the lane's begin
    lanes = gpd.GeoDataFrame(
        {"delay_s": delays, "queue_max_m": back, "stop_line": DRAWN}, geometry=[line] * 10
    )
    assert service_levels(lanes, "hcm").tolist() == [*"AABCDEF", None, None, None]
    assert service_levels(lanes.assign(stop_line=PRESUMED), "hcm").isna().all()
    assert [*HANDBOOKS["hcm"]] == [*"ABCDEF"]
    with pytest.raises(gr.UsageError, match="service is 'rilsa', expected one of hcm"):
        service_levels(lanes, "rilsa")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Five cars, 3 s apart, and one a minute later."""
    tracks = [through(n, BEGIN + 200 + 60 * n, STRAIGHT) for n in range(5)]
    tracks.append(through(9, BEGIN + 1700, LEFT))
    folder = tmp_path_factory.mktemp("fork") / "dataset"
    return fork_dataset(folder, tracks, timezone="Europe/Berlin")


def test_tables_have_headways_and_their_errors(dataset):
    lanes = dataset.traffic("1min", headways=True)
    mine = lanes[lanes["lane"] == APPROACH].reset_index(drop=True)
    assert mine["headways"].tolist() == [4, 1]
    assert mine["headway_mean_s"].iloc[0] == pytest.approx(3.0, abs=0.02)
    assert mine["gap_mean_s"].iloc[0] == pytest.approx(3.0 - 0.45, abs=0.02)
    # of counting alone, as all are alike: 3 s times the error of the number
    assert mine["headway_se_s"].iloc[0] == pytest.approx(3.0 * 0.3 / np.sqrt(4), rel=0.02)
    assert np.isnan(mine["headway_se_s"].iloc[1])  # of one there is no error
    whole = dataset.traffic("1h", headways=True).set_index("lane")
    assert whole.loc[APPROACH, "headways"] == 5
    assert whole.loc[APPROACH, "headway_mean_s"] == pytest.approx(
        (4 * mine["headway_mean_s"][0] + mine["headway_mean_s"][1]) / 5
    )
    assert whole.loc[LEFT, "headways"] == 0
    assert np.isnan(whole.loc[LEFT, "headway_mean_s"])
    with pytest.raises(gr.GisRadarError, match="nothing was measured in that time"):
        dataset.traffic("1min", headways=True, begin="2100-01-01")
    late = {"begin": "2023-11-14 23:01"}
    assert (
        dataset.traffic("1min", headways=True, **late)["headways"].sum()
        == mine["headways"][1] + lanes.loc[lanes["lane"] == STRAIGHT, "headways"].iloc[1]
    )


def test_the_command_writes_them(run, dataset, tmp_path):
    options = ("--interval", "1min", "--headways", "--cycles", "--service", "hcm")
    code, _, err = run("traffic", dataset.folder, "-o", tmp_path / "out", *options)
    assert code == 0, err
    rows = list(csv.DictReader((tmp_path / "out" / "traffic.csv").open(encoding="utf-8")))
    assert "levels of service are of 15 minutes in the handbook, here of 1min" in err
    assert rows[0]["headway_mean_s"] == "3.0"
    assert rows[0]["los"] == "A"
    assert {row["los"] for row in rows if row["lane"] != str(APPROACH)} == {""}
    lines = list(csv.DictReader((tmp_path / "out" / "cycles.csv").open(encoding="utf-8")))
    assert [line["reason"] for line in lines] == [FEW]
    assert lines[0]["begin"] == "2023-11-14T23:00:00+01:00"
    assert lines[0]["counted"] == ""
    assert "Cycles" in pyogrio.list_layers(tmp_path / "out" / "traffic.xlsx")[:, 0]
    layer = gpd.read_file(tmp_path / "out" / "traffic.gpkg", layer="lanes")
    assert {"headways", "gap_se_s", "los"} <= set(layer)
    german = dataset.signal_cycles(language="de")
    assert german["reason"].tolist() == ["weniger als 4 Grünbeginne gesehen"]
    assert str(german["begin"].dtype.tz) == "Europe/Berlin"
    assert pd.isna(german["counted"]).all()


def test_hours_without_exact_tables_are_refused(dataset, tmp_path):
    shutil.copytree(dataset.folder, tmp_path / "data")
    for record in read_hours(tmp_path / "data").values():
        write_record(tmp_path / "data", replace(record, dropped=tuple(record.parts)))
    old = gr.open_dataset(tmp_path / "data")
    for asked in (old.signal_cycles, partial(old.traffic, headways=True)):
        with pytest.raises(gr.InputError, match="has no exact tables any more"):
            asked()


def test_headways_of_the_whole_time_are_refused(dataset):
    with pytest.raises(gr.UsageError, match="headways are of intervals"):
        dataset.traffic(headways=True, whole=True)


GREEN = (
    "lane;green_begin;green_end\n10;2023-11-14 23:00:10;2023-11-14 23:00:30\n"
    "10;2023-11-14T22:00:40Z;\n10;2023-11-14 23:01:20;\n"
)


def test_known_green_times_are_the_cycles(run, dataset, tmp_path):
    (tmp_path / "green.csv").write_text(GREEN)
    found = dataset.signal_cycles(signals=tmp_path / "green.csv")
    assert found["cycle_s"].tolist() == [30.0, 40.0]
    assert found["begin"].iloc[0] == pd.Timestamp("2023-11-14T23:00:10+01:00")
    assert found["counted"].tolist() == [5, 0]
    assert found["queue_end_m"].tolist() == [0.0, 0.0]
    options = ("--signals", tmp_path / "green.csv", "--interval", "1min")
    code, _, err = run("traffic", dataset.folder, "-o", tmp_path / "out", *options)
    assert code == 0, err
    assert len((tmp_path / "out" / "cycles.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("late_s", "ends", "reason"),
    [(0, True, ""), (1, True, ""), (35, True, CHANCE), (35, False, "")],
)
def test_green_times_in_which_nobody_leaves_are_not_taken(late_s, ends, reason):
    """They are of another signal, or by another clock."""
    begin = BEGIN + 20 * (CYCLE_S * np.arange(15) + late_s).astype(np.int64)
    end = begin + 20 * round(CYCLE_S - RED_S) if ends else np.full(15, -1)
    lanes = tracked(at_signal(6.0, 3), visible())
    found = cycles(lanes, {0: Greens(begin, end)})
    assert {each.reason for each in found} == {reason}
    assert len(found) == (1 if reason else 14)


@pytest.mark.parametrize(("at_green", "at_red"), [(7, 3), (30, 25), (50, 30)])
def test_green_times_are_taken_where_many_turn_at_red(at_green, at_red):
    """Too few of them to tell, or more at green than by chance."""
    begin = BEGIN + 20 * np.arange(0, 3600, 70)
    greens, random = Greens(begin, begin + 20 * 30), np.random.default_rng(7)
    cycle = begin[random.integers(0, len(begin) - 1, at_green + at_red)]
    after_s = np.append(random.uniform(0, 30, at_green), random.uniform(35, 69, at_red))
    assert not are_of_another(greens, np.sort(cycle + np.rint(20 * after_s).astype(np.int64)))


def test_green_times_that_are_not_there_are_named(dataset, tmp_path):
    with pytest.raises(gr.InputError, match=r"green\.csv: cannot be read: No such file"):
        dataset.signal_cycles(signals=tmp_path / "green.csv")


def test_green_times_are_read_as_excel_writes_them_in_germany(dataset, tmp_path):
    name = dataset.traffic(language="de").query(f"lane == {APPROACH}")["name"].iloc[0]
    rows = (
        "lane;green_begin;x",
        f"{name};14.11.2023 23:00:10;grün",
        f"{name};14.11.2023 23:00:40;",
    )
    text = "\n".join(["", ";;", *rows, ";;", ""])
    (tmp_path / "green.csv").write_bytes(text.replace("\n", "\r\n").encode("cp1252"))
    found = dataset.signal_cycles(signals=tmp_path / "green.csv", language="de")
    assert found["cycle_s"].tolist() == [30.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "lacks the columns lane and green_begin"),
        (GREEN.replace("\n10;", "\n10;10;", 1), "line 2: has more values than the header"),
        (GREEN + "\0", "line 5"),
        ("lane;begin\n10;x\n", "lacks the columns green_begin"),
        (GREEN.replace("\n10;", "\n11;", 1), "line 2: lane '11' is none"),
        ('"";"";""\nsep=;\n' + GREEN.replace("\n10;", "\n11;", 1), "line 4: lane '11' is none"),
        (GREEN.replace("23:01:20", "noon"), "line 4: green_begin is '2023-11-14 noon'"),
        (GREEN.replace("23:00:30", "23:00:41"), "ends before it begins, or after the next"),
        (
            GREEN.replace("23:01:20", "23:00:40.3") + "10;2023-11-14 23:00:40.6\n",
            "two greens begin within a second",
        ),
        (GREEN.replace("\n10;", "\n20;", 1), "lane 20 has no stop line"),
        (GREEN.replace("11-14", "11-15"), "none of its greens begins in the time that was meas"),
        (GREEN.partition("\n")[0], "holds no green times"),
        (GREEN + GREEN.partition("\n")[2], "a green of the lane begins then already"),
    ],
)
def test_green_times_that_are_none_are_one_line(run, dataset, tmp_path, text, said):
    (tmp_path / "green.csv").write_text(text)
    options = ("--signals", tmp_path / "green.csv", "--interval", "1min")
    code, _, err = run("traffic", dataset.folder, "-o", tmp_path / "out", *options)
    assert code == 3
    assert said in err
    assert len(err.strip().splitlines()) == 1
