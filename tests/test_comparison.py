"""Two periods compared: what is told, what is not, and what does not compare."""

import csv
import json
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from datasets import pose_rows, recordings_of, write_dataset
from driven import drive, driven, straight_tiles
from hypothesis import given
from hypothesis import strategies as st
from shapely import LineString
from sites import pose

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR, InputError, NoAnswerError, UsageError, in_language, tr
from gis_radar.dataset import POSES, RECORDINGS, LaneTraffic, write_record, write_single_file
from gis_radar.dataset.files.tables import SIGHTS, TRACKS
from gis_radar.measures import compare_values, holm_corrected
from gis_radar.products.comparison import result
from gis_radar.products.comparison.rows import AlikeRows, compared_rows

HOUR = 472_222  # 2023-11-14, 22 h
BEGIN = HOUR * STEPS_PER_HOUR
TILES = straight_tiles(20, length=3.0)
LANES = gpd.GeoDataFrame(
    {
        "lane": [7], "lanelets": [[7]], "subtype": ["road"], "street": ["<Ring>"],
        "street_part": [None], "turn": ["left"], "stop_line_m": [50.0], "speed_limit_kmh": [36.0],
        "length_m": [60.0],
    },
    geometry=[LineString([(0, 0), (60, 0)])], crs="EPSG:25832",
)  # fmt: skip
BEFORE = ("2023-11-14 22:00", "2023-11-14 23:00")
AFTER = ("2023-11-14 23:00", "2023-11-15 00:00")


def cars(hour, every_s, seed, *, by=0.5):
    """Let cars come at random, so many seconds apart on average, at 10 m/s: 0.5 m a step."""
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.gamma(4.0, every_s / 4.0, 1000)) * 20.0
    steps = steps[steps < STEPS_PER_HOUR - 200].astype(np.int64)
    begin = hour * STEPS_PER_HOUR
    fronts = np.arange(0.0, 59.0, by)
    return [drive(hour * 1_000_000 + n, begin + at, fronts) for n, at in enumerate(steps)]


def seen_by(dataset, spans, tiles=TILES["tile_id"]):
    """Say that sensors recorded from step to step, and what each sees; give the dataset anew."""
    names = sorted(spans)
    rows = recordings_of(set(names))
    rows["first_time"], rows["last_time"] = (
        [spans[name][k] * 0.05 for name in names] for k in range(2)
    )
    poses = pose_rows([pose(sensor=name) for name in names])
    ids = np.asarray(tiles)
    sights = {
        "pose": np.repeat(names, len(ids)), "tile_id": np.tile(ids, len(names)),
    }  # fmt: skip
    fingerprint = dataset.manifest.fingerprint
    for table, content in ((RECORDINGS, rows), (POSES, poses), (SIGHTS, sights)):
        write_single_file(table, dataset.folder, content, fingerprint)
    return gr.open_dataset(dataset.folder)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A car every 10 s in the first hour, every 15 s in the second."""
    tracks = [*cars(HOUR, 10.0, 1), *cars(HOUR + 1, 15.0, 2)]
    # a state at either end, so that all of both hours is visible
    ends = [drive(HOUR * 1_000_000 + 900, BEGIN, [0.0]),
            drive((HOUR + 1) * 1_000_000 + 900, BEGIN + 2 * STEPS_PER_HOUR - 1, [0.0])]  # fmt: skip
    folder = tmp_path_factory.mktemp("two") / "dataset"
    return driven(folder, TILES, pd.concat([*tracks, *ends]), lanes=LANES)


@pytest.fixture
def dataset(tmp_path, made):
    shutil.copytree(made.folder, tmp_path / "dataset")
    whole = (BEGIN, BEGIN + 2 * STEPS_PER_HOUR)
    return seen_by(gr.open_dataset(tmp_path / "dataset"), {"R1": whole})


def days(rng, count, rate, *, spread=0.03):
    """Give volumes of days: a profile, a factor a day, and counts by chance."""
    time = np.arange(24, 88)
    profile = rate * (1.0 + 0.5 * np.sin(time / 10.0))
    return pd.concat(
        pd.DataFrame(
            {"day": day, "time": time, "value": 4.0 * rng.poisson(profile * rng.normal(1, spread))}
        )
        for day in range(count)
    )


def test_fewer_vehicles_are_told_and_nothing_where_nothing_changed():
    rng = np.random.default_rng(3)
    told = {
        change: sum(
            compare_values(days(rng, 10, 100.0), days(rng, 10, 100.0 * change)).p < 0.05
            for _ in range(60)
        )
        for change in (1.0, 0.94)
    }
    assert told[1.0] <= 7  # 3 by chance
    assert told[0.94] >= 50


def test_a_day_without_its_peak_is_no_quiet_day():
    rng = np.random.default_rng(4)
    before, after = days(rng, 6, 100.0), days(rng, 6, 100.0)
    cut = after[(after["day"] != 2) | (after["time"] < 40)]
    whole, part = compare_values(before, after), compare_values(before, cut)
    assert whole.units == part.units == "days"
    assert abs(whole.after - part.after) < 0.02 * whole.after
    assert part.p > 0.05


def test_pairs_of_times_hold_a_change_against_the_profile():
    quarter = np.arange(40)
    before = pd.DataFrame({"day": 0, "time": 15 * quarter, "value": 100.0 + 5.0 * quarter})
    rng = np.random.default_rng(5)
    after = before.assign(day=1, value=before["value"] - 10.0 + rng.normal(0.0, 4.0, 40))
    found = compare_values(before, after)
    assert (found.units, found.count) == ("times of day", 40)
    assert found.difference == pytest.approx(-10.0, abs=2.0)
    assert found.p < 1e-6
    assert found.half_width(0.05) == pytest.approx(4.0 / np.sqrt(40) * 2.02, rel=0.6)


def test_equal_values_tell_no_variance():
    """Three vehicles on a quiet lane: three pairs that differ alike are no certainty."""
    three = pd.DataFrame({"day": 0, "time": [1, 2, 3], "value": 0.0})
    found = compare_values(three, three.assign(day=1, value=12.0))
    assert np.isnan(found.p)
    assert np.isnan(found.half_width(0.05))
    assert compare_values(three, three.assign(day=1)).p == 1.0


@pytest.mark.parametrize("count", [6, 24])
def test_short_series_that_are_alike_are_seldom_told(count):
    """Neighbours with a correlation of a half, and no change."""
    rng = np.random.default_rng(count)
    told = 0
    for _ in range(400):
        noise = np.zeros((2, count + 20))
        for k in range(1, count + 20):
            noise[:, k] = 0.5 * noise[:, k - 1] + rng.normal(size=2)
        before, after = (
            pd.DataFrame({"day": day, "time": np.arange(count), "value": row[20:]})
            for day, row in enumerate(noise)
        )
        told += compare_values(before, after).p < 0.05
    assert told < 0.13 * 400  # without the correction 14 to 16 %


def at_signal(rng, cycle_s, *, per_hour=160):
    """Give by minute the time lost by who comes at random to a signal, and their number."""
    come = rng.uniform(0.0, 3600.0, rng.poisson(per_hour))
    lost = np.maximum(0.55 * cycle_s - (come + rng.uniform(0.0, cycle_s)) % cycle_s, 0.0)
    minute = (come // 60).astype(int)
    sums = {"value": np.bincount(minute, lost, 60), "weight": np.bincount(minute, minlength=60)}
    return pd.DataFrame({"day": 0, "time": 600 + np.arange(60), **sums})


def test_a_signal_of_another_cycle_is_told_from_an_hour():
    """By the delays of one lane."""
    rng, told = np.random.default_rng(7), {60: 0, 110: 0}
    for cycle_s in told:
        for _ in range(100):
            found = compare_values(at_signal(rng, 60), at_signal(rng, cycle_s))
            told[cycle_s] += found.p < 0.01
    assert found.units == "times of day"
    assert told[60] <= 4
    assert told[110] >= 70


def test_few_vehicles_tell_little():
    """One who waits and three who do not are no mean of sixty minutes."""
    before, after = (
        pd.DataFrame({"day": 0, "time": np.arange(60), "value": 0.0, "weight": 0.0})
        for _ in range(2)
    )
    before.loc[[5, 17, 40, 51], ["value", "weight"]] = [
        [9.0, 1.0],
        [10.0, 1.0],
        [9.0, 1.0],
        [9.5, 1],
    ]
    after.loc[[8, 21, 44], ["value", "weight"]] = [[12.0, 1.0], [12.5, 1.0], [12.0, 1.0]]
    found = compare_values(before, after)
    assert found.difference == pytest.approx(12.17 - 9.375, abs=0.01)
    assert found.freedom < 5.0
    assert np.isnan(compare_values(before, after[:40]).p)  # of two there is no variance


def test_intervals_count_by_their_traffic():
    minutes = pd.DataFrame({"day": 0, "time": np.arange(60), "value": 30.0, "weight": 10.0})
    minutes.loc[::2, ["value", "weight"]] = [100.0, 1.0]
    found = compare_values(minutes, minutes)
    assert found.before == found.after == pytest.approx(130.0 / 11.0)


@given(st.lists(st.floats(0.0, 1.0) | st.just(np.nan), max_size=9))
def test_correction_for_many_lanes(p):
    """Against Holm's rule step by step: the smallest first, until one is no finding."""
    values = np.array(p, np.float64)
    found, level = holm_corrected(values), 0.05
    assert np.array_equal(np.isnan(found), np.isnan(values))
    known = np.sort(values[~np.isnan(values)])
    rejected = 0
    while rejected < len(known) and known[rejected] * (len(known) - rejected) < level:
        rejected += 1
    assert int((found < level).sum()) == rejected
    assert np.all(found[~np.isnan(found)] >= values[~np.isnan(values)])


def lane_rows(lane, rng, queue_m):
    """Give an hour of a lane by minute: every third one in which all stand."""
    minute, moves = np.arange(60), np.arange(60) % 3 > 0
    begin = pd.Timestamp("2023-11-14T22:00Z") + pd.Timedelta(minutes=1) * minute
    flow = np.where(moves, 240.0, 0.0)
    density = np.where(moves, 12.0, 30.0)
    travel = np.where(moves, 3.6 * 100.0 * 12.0 / 240.0, np.nan)
    return gpd.GeoDataFrame(
        {
            "lane": lane, "begin": begin, "end": begin + pd.Timedelta(minutes=1),
            "volume_veh_h": 60.0 * rng.poisson(4.0, 60), "flow_veh_h": flow,
            "density_veh_km": density, "occupancy": 0.1, "travel_time_s": travel,
            "delay_s": travel - 10.0, "queue_max_m": queue_m + rng.normal(5.0, 2.0, 60),
            "queue_mean_m": queue_m + rng.normal(0.0, 2.0, 60),
        },
        geometry=[LineString([(0, 0), (100, 0)])] * 60,
    )  # fmt: skip


def test_stop_lines_are_compared_together_and_time_is_lost_while_all_stand():
    rng = np.random.default_rng(10)
    lanes = {
        lane: AlikeRows(lane_rows(lane, rng, 10.0), lane_rows(lane, rng, 11.0), "R1")
        for lane in (3, 4, 5, 6)
    }
    table = compared_rows(lanes).set_index("measure")
    together = table[table["lane"].isna()]
    assert together.loc["queue_mean_m", "verdict"] == "more"  # no lane is told by itself
    assert set(table.loc[table["lane"].notna(), "verdict"]) == {"not told"}
    one = table[table["lane"] == 3]
    assert together.loc["volume_veh_h", "before"] == pytest.approx(4.0 * 240.0, rel=0.15)
    # 18 vehicles on average on 100 m, of which 160 an hour drive: 40.5 s each, 10 s of them free
    assert one.loc["delay_s", "before"] == pytest.approx(3600.0 * 1.8 / 160.0 - 10.0)
    assert one.loc["speed_kmh", "before"] == pytest.approx(160.0 / 18.0)
    assert one.loc["queue_max_m", "count"] == 56  # of five minutes each


def test_a_minute_that_is_hidden_loses_no_delay_of_the_others():
    rng = np.random.default_rng(11)
    before, after = (lane_rows(3, rng, 10.0) for _ in range(2))
    hidden = before.index.isin([10, 11])  # two minutes with traffic, of which too little is seen
    before = before.assign(travel_time_s=before["travel_time_s"].mask(hidden))
    before = before.assign(delay_s=before["delay_s"].mask(hidden))
    found = compared_rows({3: AlikeRows(before, after)}).set_index("measure").loc["delay_s"]
    assert found["count"] == 58
    assert found["before"] == pytest.approx(360.0 * (18.0 * 60 - 24) / (160.0 * 60 - 480) - 10.0)
    most = before.index % 10 > 0
    dark = before.assign(travel_time_s=before["travel_time_s"].mask(most))
    rows = compared_rows({3: AlikeRows(dark, after)})  # who stands in sight is not all of it
    assert "delay_s" not in set(rows["measure"])


def test_time_is_lost_in_a_minute_in_which_nobody_drives_the_length_of_the_lane():
    rng = np.random.default_rng(11)
    before, after = (lane_rows(3, rng, 10.0) for _ in range(2))
    creeps = before["flow_veh_h"].eq(0.0)  # all stand but one, which rolls on by some metres
    rolled = before.assign(flow_veh_h=before["flow_veh_h"].mask(creeps, 6.0))
    found, still = (
        compared_rows({3: AlikeRows(rows, after)}).set_index("measure").loc["delay_s"]
        for rows in (rolled, before)
    )
    assert found["count"] == still["count"] == 60
    # 2 veh/h more on average, who would need 10 s at free speed
    assert found["before"] * (160.0 + 2.0) == pytest.approx(still["before"] * 160.0 - 2.0 * 10.0)


def test_who_drives_on_a_lane_in_two_minutes_loses_no_time():
    """In neither of them a vehicle drives its length: there is no travel time, and no delay."""
    rng = np.random.default_rng(11)
    before, after = (lane_rows(3, rng, 0.0) for _ in range(2))
    before, after = (
        each.assign(flow_veh_h=240.0, travel_time_s=11.0, delay_s=1.0,
                    density_veh_km=240.0 * 11.0 / 360.0)
        for each in (before, after)
    )  # fmt: skip
    two = after.index % 2 == 0  # of two minutes each, a vehicle at free speed
    after = after.assign(
        flow_veh_h=after["flow_veh_h"].mask(two, 30.0),
        density_veh_km=after["density_veh_km"].mask(two, 30.0 * 10.0 / 360.0),
        travel_time_s=after["travel_time_s"].mask(two), delay_s=after["delay_s"].mask(two),
    )  # fmt: skip
    found = compared_rows({3: AlikeRows(before, after)}).set_index("measure").loc["delay_s"]
    assert found["count"] == 60
    assert found["before"] == pytest.approx(1.0)
    assert found["after"] == pytest.approx(240.0 / 270.0)


def test_who_drives_over_the_limit_gains_no_time():
    """And a lane on which nobody lost time before is compared."""
    rng, slow = np.random.default_rng(14), np.arange(60) % 10 == 0
    before, after = (lane_rows(3, rng, 0.0).assign(flow_veh_h=240.0) for _ in range(2))
    before = before.assign(travel_time_s=6.0, density_veh_km=4.0, delay_s=0.0)
    after = after.assign(
        travel_time_s=np.where(slow, 17.0, 6.0), density_veh_km=np.where(slow, 34.0 / 3.0, 4.0),
        delay_s=np.where(slow, 10.0, 0.0),
    )  # fmt: skip
    found = compared_rows({3: AlikeRows(before, after)}).set_index("measure").loc["delay_s"]
    assert found["before"] == 0.0
    assert found["after"] == pytest.approx(1.0)


def test_a_lane_without_vehicles_has_no_speed_to_compare():
    rng = np.random.default_rng(12)
    used = lane_rows(3, rng, 10.0)
    closed = used.assign(flow_veh_h=0.0, density_veh_km=0.0, travel_time_s=np.nan, delay_s=np.nan)
    measures = compared_rows({3: AlikeRows(used, closed)})["measure"]
    assert not {"speed_kmh", "delay_s"} & set(measures)
    assert "volume_veh_h" in set(measures)


def test_lanes_without_any_known_measure_give_no_answer():
    rows = lane_rows(3, np.random.default_rng(13), 10.0)
    unknown = rows.assign(**dict.fromkeys(rows.columns[3:-1], np.nan))
    with pytest.raises(NoAnswerError, match="no measure of any lane is known in both periods"):
        compared_rows({3: AlikeRows(unknown, rows)})


def test_a_third_fewer_cars_are_told(dataset):
    found = gr.compare(dataset, before=BEFORE, after=AFTER)
    volume = found.table[found.table["measure"] == "volume_veh_h"].iloc[0]
    assert volume["before"] == pytest.approx(360.0, rel=0.1)
    assert volume["after"] == pytest.approx(240.0, rel=0.1)
    assert volume["verdict"] == "less"
    assert volume["low"] < -120.0 < volume["high"]
    assert "all_stop_lines" in found.figures()
    assert found.table["lane"].notna().all()  # one stop line needs no sum
    speed = found.table[found.table["measure"] == "speed_kmh"].iloc[0]
    assert speed["verdict"] == "not told"
    assert found.used == (1.0, 1.0)


def test_periods_are_written_as_on_the_command_line_too(dataset):
    found = gr.compare(dataset, before="/".join(BEFORE), after="/".join(AFTER))
    assert found.figures() == gr.compare(dataset, before=BEFORE, after=AFTER).figures()
    told = (found.table["verdict"] != "not told") & found.table["lane"].notna()
    assert f": 1 lanes, {told.sum()} changes told)" in repr(found)
    assert "lanes compared" in found._repr_html_()
    with pytest.raises(UsageError, match="'2023-11-14' is no period"):
        gr.compare(dataset, before="2023-11-14", after=AFTER)
    with pytest.raises(UsageError, match="overlap"):
        gr.compare(dataset, after=AFTER)  # before is all the time


def test_a_difference_below_what_is_resolved_is_not_told(tmp_path):
    """All drive at one speed, but for 8 mm/s."""
    tracks = [*cars(HOUR, 10.0, 1), *cars(HOUR + 1, 10.0, 2, by=0.5004)]
    folder = tmp_path / "dataset"
    made = driven(folder, TILES, pd.concat(tracks), lanes=LANES)
    dataset = seen_by(made, {"R1": (BEGIN, BEGIN + 2 * STEPS_PER_HOUR)})
    found = gr.compare(dataset, before=BEFORE, after=AFTER).table.set_index("measure")
    assert found.loc["speed_kmh", "p"] < 0.05
    assert 0.0 < found.loc["speed_kmh", "difference"] < 0.1
    assert found.loc["speed_kmh", "verdict"] == "not told"


def test_what_reaches_past_the_period_is_left_out(dataset):
    with pytest.raises(InputError, match="no whole interval of 1min lies"):
        gr.compare(
            dataset, before=("2023-11-14 22:00", "2023-11-14 22:00:50"), after=AFTER
        )  # fifty seconds hold no whole interval
    found = gr.compare(dataset, before=("2023-11-14 22:00", "2023-11-14 22:33:40"), after=AFTER)
    assert found.before[1] == pd.Timestamp("2023-11-14 22:33", tz="UTC")


def test_where_nothing_can_be_told_there_is_no_answer(dataset):
    halves = (("2023-11-14 22:00", "2023-11-14 22:02"), ("2023-11-14 22:30", "2023-11-14 22:32"))
    with pytest.raises(NoAnswerError, match="too few intervals to tell a difference: at most 2"):
        gr.compare(dataset, before=halves[0], after=halves[1])


def test_a_period_without_a_whole_minute_of_recording_has_no_answer(dataset):
    dataset = seen_by(dataset, {"R1": (BEGIN, BEGIN + STEPS_PER_HOUR + 800)})  # 40 s of AFTER
    with pytest.raises(NoAnswerError, match="no lane was seen by the same sensors") as caught:
        gr.compare(dataset, before=BEFORE, after=AFTER)
    assert "recorded nine tenths of an interval and more: a minute" in caught.value.hint


def test_a_second_radar_is_not_more_traffic(dataset):
    """What two radars see is not compared with what one saw."""
    edge, end = BEGIN + STEPS_PER_HOUR, BEGIN + 2 * STEPS_PER_HOUR
    two = seen_by(dataset, {"R1": (BEGIN, end), "R2": (edge, end)})
    with pytest.raises(NoAnswerError, match="no lane was seen by the same sensors alike"):
        gr.compare(two, before=BEFORE, after=AFTER)
    some = seen_by(dataset, {"R1": (BEGIN, end), "R2": (edge + STEPS_PER_HOUR // 2, end)})
    found = gr.compare(some, before=BEFORE, after=AFTER)
    assert set(found.table["watchers"]) == {"R1"}
    assert found.used == (1.0, 0.5)  # the half hour before the second radar


def test_what_two_recordings_hold_counts_once(dataset):
    """Else a minute of which both hold the same 36 s would count as recorded."""
    ends = BEGIN + 3 * STEPS_PER_HOUR // 2 + 36 * 20
    once = seen_by(dataset, {"R1": (BEGIN, ends)})
    used = gr.compare(once, before=BEFORE, after=AFTER).used
    rows = once.single_table(RECORDINGS)
    copy = rows.set_column(0, "path", pa.array(["copy.parquet"]))
    copy = copy.set_column(1, "digest", pa.array(["copy"]))
    both = pa.concat_tables([rows, copy.cast(rows.schema)]).sort_by("path").to_pydict()
    write_single_file(RECORDINGS, once.folder, both, once.manifest.fingerprint)
    twice = gr.open_dataset(once.folder)
    assert len(twice.recordings()) == 2
    assert gr.compare(twice, before=BEFORE, after=AFTER).used == used == (1.0, 0.5)


def test_a_sensor_that_now_sees_another_part_does_not_compare(dataset, tmp_path):
    shutil.copytree(dataset.folder, tmp_path / "later")
    whole = {"R1": (BEGIN, BEGIN + 2 * STEPS_PER_HOUR)}
    later = seen_by(gr.open_dataset(tmp_path / "later"), whole, TILES["tile_id"][:15])
    with pytest.raises(NoAnswerError):
        gr.compare(dataset, later, before=BEFORE, after=AFTER)
    nearly = seen_by(later, whole, TILES["tile_id"][:19])
    assert len(gr.compare(dataset, nearly, before=BEFORE, after=AFTER).table)


def test_what_cannot_be_compared_is_refused(dataset, tmp_path):
    with pytest.raises(UsageError, match="overlap"):
        gr.compare(dataset, before=BEFORE, after=("2023-11-14 22:30", "2023-11-15 00:00"))
    with pytest.raises(UsageError, match="overlap"):  # one dataset named twice is one
        gr.compare(dataset, gr.open_dataset(dataset.folder), before=BEFORE, after=BEFORE)
    with pytest.raises(UsageError, match="names no days"):
        gr.compare(dataset, before=BEFORE, after=AFTER, days="Monday")
    with pytest.raises(InputError, match="no lane is observed from 2023-11-20"):
        gr.compare(dataset, before=BEFORE, after=("2023-11-20", "2023-11-21"))
    with pytest.raises(InputError, match="on the days asked for"):  # a Tuesday
        gr.compare(dataset, before=BEFORE, after=AFTER, days="Sa-Mo")
    shutil.copytree(dataset.folder, tmp_path / "other")
    path = tmp_path / "other" / "dataset.json"
    document = json.loads(path.read_text())
    document["settings"]["filters"] = {"min_speed": 3.0}
    del document["digest"]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="different settings"):
        gr.compare(dataset, gr.open_dataset(tmp_path / "other"), before=BEFORE, after=AFTER)
    manifest, rows = dataset.manifest, {"hits": {"tile_id": [1], "step": [BEGIN]}}
    for what, tiles, method in (("tiles", TILES.iloc[:-1], 1), ("methods", TILES, 2)):
        there = write_dataset(
            tmp_path / what, rows, tiles=tiles, method=method, settings=manifest.settings
        )
        with pytest.raises(InputError, match=f"different {what}"):
            gr.compare(dataset, there, before=BEFORE, after=AFTER)


def of_another_map(dataset, folder, *, timezone="UTC", **lanes):
    """Return a copy of a dataset with another map, and other lanes."""
    shutil.copytree(dataset.folder, folder)
    replace(dataset.manifest, map="another", timezone=timezone).write(folder)
    layer = {"lanelets": ["7"]} | lanes
    LANES.assign(**layer).to_file(folder / "tiles.gpkg", layer="lanes")
    return gr.open_dataset(folder)


def test_lanes_of_two_maps_compare_where_they_are_the_same(dataset, tmp_path):
    periods = {"before": BEFORE, "after": AFTER}
    slower = of_another_map(dataset, tmp_path / "slower", speed_limit_kmh=30.0)
    assert len(gr.compare(dataset, slower, **periods).table)
    for column, value in {"stop_line_m": 40.0, "lanelets": ["8"]}.items():
        other = of_another_map(dataset, tmp_path / column, **{column: value})
        with pytest.raises(InputError, match="different lanes"):
            gr.compare(dataset, other, **periods)


def test_times_of_day_of_two_zones_do_not_compare(dataset, tmp_path):
    other = of_another_map(dataset, tmp_path / "east", timezone="Europe/Berlin")
    with pytest.raises(InputError, match="different time zones") as caught:
        gr.compare(dataset, other, before=BEFORE, after=AFTER)
    with in_language("de"):
        assert tr(caught.value.message).endswith("sind mit verschiedenen Zeitzonen entstanden")


def test_lanes_measured_by_an_earlier_method_do_not_compare(dataset, tmp_path, monkeypatch):
    """Their exact tables are gone, so that they cannot be measured again."""
    shutil.copytree(dataset.folder, tmp_path / "old")
    old = gr.open_dataset(tmp_path / "old")
    for hour, record in old.records().items():
        LaneTraffic.of(old).update(hour)
        write_record(old.folder, replace(record, dropped=(TRACKS.name,)))
    periods = {"before": BEFORE, "after": AFTER}
    assert len(gr.compare(old, dataset, **periods).table)
    monkeypatch.setattr("gis_radar.dataset.days.lane_measures.LANES_METHOD", 99)
    assert len(gr.compare(dataset, **periods).table)
    for pair in ((old, dataset), (dataset, old)):
        with pytest.raises(InputError, match="old: lanes were measured by another"):
            gr.compare(*pair, **periods)


def test_traffic_that_is_compared_with_itself_is_told(run, dataset, tmp_path):
    later, shared = tmp_path / "later", "R1.parquet: is in both periods"
    shutil.copytree(dataset.folder, later)
    words = ["compare", dataset.folder, later, "-o", tmp_path / "out"]
    code, _, said = run(*words, "--before", "/".join(BEFORE))
    assert code == 0, said
    assert f"warning: {shared}" in said
    assert shared in (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    code, _, said = run(*words, "--before", "/".join(BEFORE), "--language", "de")
    assert code == 0, said
    page = (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    assert "R1.parquet: liegt in beiden Zeiträumen" in page
    assert gr.compare(dataset, later, before=BEFORE, after=AFTER).doubts == []
    assert gr.compare(dataset, before=BEFORE, after=AFTER).doubts == []


def test_titles_of_the_maps_stand_on_one_line(dataset, monkeypatch, tmp_path):
    """The longest is wider than its map: it must not give way to the hidden axis of northings."""
    from matplotlib.figure import Figure

    figure = Figure((12.0, 5.2), dpi=130, layout="constrained")
    monkeypatch.setattr(result, "picture_file", lambda *_, **__: nullcontext(figure))
    found = gr.compare(dataset, before=BEFORE, after=AFTER)
    corner = LineString([(690_000, 5_336_000), (690_300, 5_336_000), (690_300, 5_336_400)])
    table = found.table.set_geometry([corner] * len(found.table))
    with in_language("de"):
        result.draw_changes(replace(found, table=table), tmp_path / "compare.png")
    figure.savefig(tmp_path / "drawn.png")
    assert len({round(axes.title.get_window_extent().y0) for axes in figure.axes}) == 1


def test_the_command_writes_page_table_layer_and_maps(run, dataset, tmp_path):
    words = ["compare", dataset.folder, "--before", "/".join(BEFORE), "--after", "/".join(AFTER)]
    code, out, _ = run(*words, "-o", tmp_path / "out", "--json", "--language", "de")
    assert code == 0, out
    summary = json.loads(out.splitlines()[-1])["summary"]
    assert summary["lanes_with_a_change"]["volume_veh_h, less"] == 1
    with (tmp_path / "out" / "compare.csv").open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    assert {row["measure"] for row in rows} >= {"volume_veh_h", "speed_kmh", "occupancy"}
    numbers = [cell for row in rows for cell in row.values() if re.fullmatch(r"-?\d+\.\d+", cell)]
    assert max(len(number.partition(".")[2]) for number in numbers) <= 6
    layer = gpd.read_file(tmp_path / "out" / "compare.gpkg", layer="comparison")
    assert layer["volume_veh_h_change"].iloc[0] == pytest.approx(-33.0, abs=8.0)
    page = (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    assert "&lt;Ring&gt;" in page
    assert "<Ring>" not in page
    assert "weniger Fahrzeuge" in page
    assert '<div class="wide"><img' in page  # on a phone it scrolls, else its letters are too small
    assert (tmp_path / "out" / "compare.png").read_bytes()[:4] == b"\x89PNG"
    for name in ("map.osm", "R1.parquet", "R1.json"):
        (tmp_path / name).touch()
    (tmp_path / "SITE.toml").write_text(
        f'title = "Ring"\n[map]\nfile = "map.osm"\n[[lane]]\nid = {rows[0]["lane"]}\n'
        'name = "To the harbour"\n[[sensor]]\nname = "R1"\nrecordings = ["R1.parquet"]\n'
        'pose = "R1.json"\n'
    )
    named = shutil.copytree(dataset.folder, tmp_path / "named")
    assert run("dataset", named, "--site", tmp_path / "SITE.toml")[0] == 0
    code, out, said = run("compare", named, *words[2:], "-o", tmp_path / "own")
    assert code == 0, said
    assert "To the harbour" in (tmp_path / "own" / "compare.csv").read_text(encoding="utf-8")


def test_the_page_says_that_nothing_told_is_no_proof_of_no_change(dataset, tmp_path):
    found = gr.compare(dataset, before=BEFORE, after=AFTER)
    found.write(tmp_path / "told")
    same = found.table.assign(verdict="")
    replace(found, table=same).write(tmp_path / "none")
    words = "does not prove that nothing changed"
    pages = [(tmp_path / n / "compare.html").read_text(encoding="utf-8") for n in ("told", "none")]
    assert [words in page for page in pages] == [False, True]


def test_the_page_warns_of_times_of_day_only_where_they_differ(dataset, tmp_path):
    found = gr.compare(dataset, before=BEFORE, after=AFTER)
    few = found.table["measure"] == "delay_s"
    for name, units in (
        ("none", "times of day"),
        ("some", few.map({True: "intervals", False: "times of day"})),
        ("all", "intervals"),
    ):
        made = replace(found, table=found.table.assign(units=units))
        made.write(tmp_path / name)
    pages = {
        name: (tmp_path / name / "compare.html").read_text(encoding="utf-8")
        for name in ("none", "some", "all")
    }
    shares, rests = "share no times of day", "What rests on intervals may differ by the time"
    assert [shares in page for page in pages.values()] == [False, False, True]
    assert [rests in page for page in pages.values()] == [False, few.any(), False]


def test_a_period_that_is_missing_or_none(run, dataset, tmp_path):
    words = ["compare", dataset.folder, "-o", tmp_path / "out"]
    code, _, said = run(*words, "--before", "22:00/23:00")
    assert code == 2
    assert "a period is missing" in said
    for period in ("x", ""):
        code, _, said = run(*words, dataset.folder, "--before", period, "--after", "y/z")
        assert code == 2
        assert f"{period!r} is no period" in said


def test_two_datasets_compare_as_a_whole(run, dataset, tmp_path):
    shutil.copytree(dataset.folder, tmp_path / "later")
    code, _, said = run("compare", dataset.folder, tmp_path / "later", "-o", tmp_path / "out")
    assert code == 0, said
    whole = (None, None)
    found = gr.compare(dataset, tmp_path / "later", before=whole, after=whole)
    assert set(found.table["verdict"]) == {"not told"}
    assert found.used == (1.0, 1.0)
