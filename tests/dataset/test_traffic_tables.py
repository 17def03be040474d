"""Lane measures and turns of a date: kept up to date, over the edges of hours, and for people."""

import shutil
from dataclasses import replace
from functools import partial

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from datasets import recordings_of, write_dataset
from driven import drive, driven, straight_tiles
from forks import APPROACH, LEFT, LINE_M, STRAIGHT, fork, fork_dataset, fork_lanes, through
from shapely import LineString
from sites import pose

from gis_radar.base import STEPS_PER_HOUR, InputError, UsageError
from gis_radar.dataset import (
    RECORDINGS,
    STEPS_PER_QUARTER,
    TILE_COUNTS,
    LaneTraffic,
    open_dataset,
    part_path,
    read_hour,
    read_hours,
    record_path,
    write_record,
    write_single_file,
)
from gis_radar.dataset.files.tables import HOUR_TABLES, LANE_MEASURES, TURNS, VISIBLE

HOUR = 472_222  # 2023-11-14, 22 h
EDGE = (HOUR + 1) * STEPS_PER_HOUR
NEXT = (HOUR + 1) * 1_000_000
TILES = straight_tiles(120)
LANES = gpd.GeoDataFrame(
    {
        "lane": [7], "lanelets": [[7]], "subtype": ["road"], "street": ["=Ring"],
        "street_part": [None], "turn": ["left"], "stop_line_m": [50.0], "speed_limit_kmh": [36.0],
        "length_m": [60.0],
    },
    geometry=[LineString([(0, 0), (60, 0)])], crs="EPSG:25832",
)  # fmt: skip


def dataset_of(folder, tracks, **options):
    return driven(folder, TILES, pd.concat(tracks), lanes=LANES, **options)


def over_the_edge(vehicle, begin, fronts, **options):
    """Drive over the hour's edge: states in both hours, under two numbers."""
    one = drive(vehicle, begin, fronts, **options)
    later = one["step"] >= EDGE
    return [one[~later], one[later].assign(vehicle=NEXT + vehicle)]


def car(vehicle, begin, low=0.0, high=59.0):
    """Drive at 10 m/s."""
    return drive(vehicle, begin, np.arange(low, high, 0.5))


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Six cars in the first hour, two in the second."""
    first = EDGE - STEPS_PER_HOUR
    tracks = [car(n, first + n * 3 * STEPS_PER_QUARTER // 6 + 99) for n in range(6)]
    tracks += [car(NEXT + n, EDGE + 500 * (n + 1)) for n in range(2)]
    return dataset_of(
        tmp_path_factory.mktemp("cars") / "data", tracks, timezone="Europe/Berlin", p_heavy=0.5
    )


@pytest.fixture
def dataset(tmp_path, measured):
    shutil.copytree(measured.folder, tmp_path / "data")
    return open_dataset(tmp_path / "data")


def update(dataset, hour=HOUR):
    LaneTraffic(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint).update(hour)


def days(dataset, hour=HOUR):
    return [part_path(dataset.folder, table, hour) for table in (LANE_MEASURES, TURNS)]


def test_cars_count_in_their_quarters(measured):
    rows = measured.lane_measures()
    assert rows["counted"].tolist() == [2, 2, 2, 0, 2]
    assert rows["interval"].tolist() == [88, 89, 90, 91, 92]
    assert rows["begin"].iloc[0] == pd.Timestamp("2023-11-14T22:00Z")
    assert rows["speed_mean"].dropna().tolist() == pytest.approx([10.0] * 4, rel=1e-3)
    assert rows["heavy"].tolist() == [1.0, 1.0, 1.0, 0.0, 1.0]
    # of the last quarter too little was visible for travel times
    assert rows["delay_s"].dropna().tolist() == pytest.approx([0.0] * 3, abs=1e-3)


def test_rows_of_hours_not_made_again_are_carried_over(dataset, measured, tmp_path):
    shutil.copytree(measured.folder, tmp_path / "whole")
    whole = open_dataset(tmp_path / "whole")
    update(dataset)
    later = record_path(dataset.folder, HOUR + 1)
    later.rename(later.with_suffix(".aside"))
    update(dataset)
    part_path(dataset.folder, VISIBLE, HOUR).unlink()  # the first hour cannot be made again
    later.with_suffix(".aside").rename(later)
    update(dataset)
    update(whole)
    for mine, theirs in zip(days(dataset), days(whole), strict=True):
        assert mine.read_bytes() == theirs.read_bytes()


def test_tables_of_a_damaged_or_missing_day_are_made_again(dataset):
    whole = dataset.lane_measures()
    assert not days(dataset)[0].exists()  # made on the fly
    update(dataset)
    before = [path.read_bytes() for path in days(dataset)]
    days(dataset)[0].write_bytes(b"PAR1")
    pd.testing.assert_frame_equal(dataset.lane_measures(), whole)
    with pytest.raises(InputError, match="damaged"):
        dataset.check()
    update(dataset)
    assert [path.read_bytes() for path in days(dataset)] == before
    dataset.check()


def test_a_day_of_before_a_column_keeps_its_rows_though_its_hours_are_gone(dataset):
    update(dataset)
    rows, path = dataset.lane_measures(), days(dataset)[0]
    old = pq.read_table(path)
    pq.write_table(old.drop_columns(["stops"]), path)
    for record in read_hours(dataset.folder).values():
        write_record(dataset.folder, replace(record, dropped=tuple(record.parts)))
    for _ in range(2):
        dataset = open_dataset(dataset.folder)
        found = dataset.lane_measures()
        assert found.pop("stops").isna().all()
        pd.testing.assert_frame_equal(found, rows.drop(columns="stops"))
        assert dataset.traffic("1h")["counted"].tolist() == [6, 2]
        told = dataset.query("SELECT count(*) AS rows, count(stops) AS stops FROM lane_measures")
        assert told.iloc[0].tolist() == [len(rows), 0]
        update(dataset)
    assert "stops" in pq.read_schema(path).names  # as other programs read it


@pytest.mark.parametrize("other", [{"inputs": "other"}, {"method": 99}])
def test_an_hour_follows_from_the_one_before(dataset, other):
    """Where the hour before changed it is made again, though its own inputs are the same."""
    update(dataset)
    before, rows = days(dataset)[0].read_bytes(), dataset.lane_measures()
    record = read_hour(dataset.folder, HOUR)
    changed = replace(record, origin=replace(record.origin, **other))
    write_record(dataset.folder, replace(changed, dropped=tuple(record.parts)))
    part_path(dataset.folder, VISIBLE, HOUR + 1).unlink()
    with pytest.raises(InputError, match="is missing"):
        update(dataset)
    write_record(dataset.folder, replace(record, dropped=tuple(record.parts)))
    update(dataset)  # as it was: nothing is made
    assert days(dataset)[0].read_bytes() == before
    pd.testing.assert_frame_equal(dataset.lane_measures(), rows)


def test_a_front_that_wavers_over_the_line_at_an_hours_edge_counts_once(tmp_path):
    fronts = np.concatenate([np.arange(45.0, 50.1, 0.05), np.arange(50.1, 49.9, -0.05),
                             np.arange(49.9, 53.0, 0.05)])  # fmt: skip
    tracks = over_the_edge(1, EDGE - 104, fronts, speed=1.0)
    found = dataset_of(
        tmp_path / "data", tracks, continued={HOUR + 1: [(1, NEXT + 1)]}
    ).lane_measures()
    assert found["counted"].sum() == 1
    alone = dataset_of(tmp_path / "alone", tracks).lane_measures()  # were they two vehicles
    assert alone["counted"].sum() == 2


def test_a_crossing_between_two_hours_counts_in_the_later_one(tmp_path):
    tracks = over_the_edge(1, EDGE - 100, 45.2 + np.arange(120) * 0.05, speed=1.0)
    assert tracks[0]["s_m"].max() < 50.2
    fronts = np.concatenate([np.linspace(40.0, 49.99, 100), np.linspace(50.01, 55.0, 60)])
    tracks = over_the_edge(1, EDGE - 100, fronts, speed=2.0)
    continued = {HOUR + 1: [(1, NEXT + 1)]}
    found = dataset_of(tmp_path / "data", tracks, continued=continued).lane_measures()
    assert dict(zip(found["interval"], found["counted"], strict=True))[92] == 1
    assert found["counted"].sum() == 1


def test_who_stands_over_an_hours_edge_stops_once(tmp_path):
    fronts = np.concatenate([np.arange(40.0, 49.0, 0.25), np.full(200, 49.0)])
    speed = np.where(np.arange(len(fronts)) < 36, 5.0, 0.0)
    tracks = over_the_edge(1, EDGE - 100, fronts, speed=speed)
    continued = {HOUR + 1: [(1, NEXT + 1)]}
    found = dataset_of(tmp_path / "data", tracks, continued=continued).lane_measures()
    assert found["stops"].sum() == 1
    later = found[found["interval"] == 92].iloc[0]
    assert later["queue_max_m"] == pytest.approx(5.5, abs=0.01)
    # from the first step of the hour on, as it has stood for over a second by then
    assert later["queue_mean_m"] == pytest.approx(5.5, abs=0.2)


def test_traffic_is_tidy(measured):
    table = measured.traffic("15min")
    assert table["name"].unique().tolist() == ["=Ring eastbound, lane 1 (left turn)"]
    assert measured.traffic(language="de")["name"].iloc[0] == (
        "=Ring nach Osten, Fahrstreifen 1 (links ab)"
    )
    assert str(table["begin"].dt.tz) == "Europe/Berlin"
    assert table["begin"].iloc[0] == pd.Timestamp("2023-11-14T23:00+01:00")
    assert (table["end"] - table["begin"]).unique().tolist() == [pd.Timedelta("15min")]
    assert table["speed_kmh"].iloc[0] == pytest.approx(36.0, rel=1e-3)
    assert table["volume_veh_h"].iloc[0] == pytest.approx(4.0 * table["volume"].iloc[0])
    assert table.geometry.length.unique().tolist() == [60.0]
    assert table["speed_85_kmh"].iloc[0] == pytest.approx(39.25)  # in the class from 35 to 40


@pytest.mark.parametrize(("last", "intervals"), [(EDGE - 1, 1), (EDGE, 2)])
def test_an_interval_without_a_frame_has_no_rows_while_the_last_frame_is_valid(
    tmp_path, last, intervals
):
    tracks = over_the_edge(0, EDGE - 100, np.arange(0.0, 50.5, 0.5))  # its last step is at the edge
    dataset = dataset_of(tmp_path / "data", tracks)
    rows = recordings_of({"R1"}) | {"first_time": [(EDGE - 100) / 20], "last_time": [last / 20]}
    write_single_file(RECORDINGS, dataset.folder, rows, dataset.manifest.fingerprint)
    dataset = open_dataset(dataset.folder)
    for interval in ("1min", "15min", "1h"):
        assert dataset.traffic(interval)["begin"].nunique() == intervals


def test_intervals_sum_to_the_hour(measured):
    quarters, hours = measured.traffic("15min"), measured.traffic("1h")
    assert hours["counted"].tolist() == [6, 2]
    assert hours["begin"].dt.hour.tolist() == [23, 0]
    part = quarters[quarters["begin"] < hours["begin"].iloc[1]]
    assert hours["volume"].iloc[0] == pytest.approx(part["volume"].sum())
    assert hours["volume_se"].iloc[0] == pytest.approx(np.sqrt((part["volume_se"] ** 2).sum()))
    assert hours["speed_kmh"].iloc[0] == pytest.approx(36.0, rel=1e-3)
    assert hours["stops"].iloc[0] == 0
    fine = measured.traffic("5min")
    assert fine["counted"].sum() == 8
    assert fine.groupby(fine["begin"].dt.floor("15min"))["counted"].sum().tolist() == (
        quarters["counted"].tolist()
    )


def test_the_whole_time_is_its_intervals_by_what_was_seen_of_them(measured):
    """Of the second hour 53 s were recorded: its quarter counts a seventeenth."""
    quarters = measured.traffic()
    (whole,) = measured.traffic("15min", whole=True).to_dict("records")
    assert (whole["begin"], whole["end"]) == (quarters["begin"].min(), quarters["end"].max())
    known = quarters[quarters["volume"].notna()]
    rate = (known["volume"] * known["visible_share"]).sum() / known["visible_share"].sum()
    assert whole["volume"] == pytest.approx(rate * len(quarters))
    assert whole["volume_veh_h"] == pytest.approx(rate * 4.0)
    assert whole["counted"] == 8
    assert whole["visible_share"] == pytest.approx(quarters["visible_share"].mean())
    assert whole["volume_se"] > np.sqrt((known["volume_se"] ** 2).sum())
    assert whole["speed_kmh"] == pytest.approx(36.0, rel=1e-3)
    assert measured.turns(whole=True).empty  # one lane has none


def test_names_and_free_speeds_that_a_site_states_are_those_of_earlier_measures(dataset):
    update(dataset)
    before = dataset.traffic()
    stated = [{"id": 7, "name": "Main Street, bus lane", "speed_kmh": 72.0}]
    after = dataset.with_lanes(stated).traffic()
    assert after["name"].unique().tolist() == ["Main Street, bus lane"]
    assert before["delay_s"].dropna().tolist() == pytest.approx([0.0] * 3, abs=1e-3)
    # 60 m at 36 km/h take 6 s, at 72 km/h 3
    assert after["delay_s"].dropna().tolist() == pytest.approx([3.0] * 3, abs=0.01)
    hours = dataset.with_lanes(stated).traffic("1h")
    assert hours["delay_s"].dropna().tolist() == pytest.approx([3.0], abs=0.01)
    pd.testing.assert_frame_equal(dataset.traffic(), before)
    speed = dataset.with_lanes([{"id": 7, "name": None, "speed_kmh": None}], 18.0)
    assert speed.traffic()["name"].tolist() == before["name"].tolist()
    assert speed.traffic()["delay_s"].dropna().tolist() == pytest.approx([0.0] * 3, abs=1e-3)
    with pytest.raises(InputError, match="has no lane 8"):
        dataset.with_lanes([{"id": 8}])


def test_an_interval_with_less_than_one_vehicle_has_no_travel_time(tmp_path):
    """One that waits in it for minutes would give a travel time that nobody had."""
    begin = EDGE - STEPS_PER_HOUR
    waits = np.concatenate([np.arange(0.0, 4.0, 0.5), np.full(2000, 4.0)])
    row = dataset_of(tmp_path / "one", [drive(1, begin, waits)]).traffic("1min").iloc[0]
    assert row["visible_share"] == 1.0
    assert 0.0 < row["flow_veh_h"] < 60.0
    assert row["speed_kmh"] > 0.0
    assert np.isnan(row["travel_time_s"])
    assert np.isnan(row["delay_s"])
    two = dataset_of(tmp_path / "two", [drive(1, begin, waits), car(2, begin + 300)])
    assert two.traffic("1min")["travel_time_s"].iloc[0] > 60.0


@pytest.mark.parametrize(
    ("stated", "told"),
    [
        ([{"id": 7, "speed": 50.0}], "a lane has 'speed', expected id, name, speed_kmh"),
        ([{"id": 7, "speed_kmh": "50"}], "speed_kmh is '50', expected a number or None"),
        ([{"id": "7"}], "id is '7', expected a whole number"),
        ([{"name": "Main Street"}], "id is None, expected a whole number"),
    ],
)
def test_what_is_no_statement_of_a_lane_is_refused(dataset, stated, told):
    """A mistyped key would change nothing, and nobody would notice."""
    with pytest.raises(InputError, match=told):
        dataset.with_lanes(stated)


def test_sections_of_no_kind_are_refused(dataset):
    with pytest.raises(UsageError, match=r"sections is .*, expected GeoDataFrame"):
        dataset.count_sections([1, 2])


@pytest.mark.parametrize(("until", "volume"), [(1800, 3.0), (720, 2 / 0.6)])
def test_vehicles_followed_over_a_hidden_line_count_while_a_sensor_observes_it(
    tmp_path, until, volume
):
    """Two cars cross it, then it is hidden, and one crosses after 800 steps of a minute's 1200."""
    first, tiles = EDGE - STEPS_PER_HOUR, fork()
    tracks = [through(n, first + step, STRAIGHT) for n, step in enumerate((0, 200, 700, 1300))]
    line = int(tiles.loc[tiles["lane"] == APPROACH, "tile_id"].max())
    found = fork_dataset(
        tmp_path / "data", tracks, until={line: first + until}, hidden={line: first + 600}
    )
    table = found.traffic("1min").set_index(["lane", "begin"]).loc[APPROACH]
    assert table["visible_share"].iloc[0] == 0.5
    assert table["counted"].iloc[0] == 2
    assert table["volume"].iloc[0] == pytest.approx(volume)


def test_a_vehicle_that_stands_at_a_hidden_line_makes_its_volume_surer(tmp_path):
    """While it waits nobody else crosses; else up to as many may have come as while it is seen."""
    first, tiles = EDGE - STEPS_PER_HOUR, fork()
    tracks = [through(n, first + step, STRAIGHT) for n, step in enumerate((0, 200, 1300))]
    line = int(tiles.loc[tiles["lane"] == APPROACH, "tile_id"].max())
    errors = []
    for name, front in (("at the line", LINE_M - 3.0), ("two cars before it", LINE_M - 15.0)):
        waits = drive(9, first + 560, np.full(680, front), speed=0.0, lanelet_id=APPROACH)
        found = fork_dataset(tmp_path / name, [*tracks, waits], hidden={line: first + 600})
        row = found.traffic("1min").set_index(["lane", "begin"]).loc[APPROACH].iloc[0]
        assert row["volume"] == pytest.approx(2.0)
        errors.append(row["volume_se"])
    assert errors[0] == pytest.approx(0.3, abs=0.02)  # of two counted ones, 0.3**2 / 2 each
    assert errors[1] > 1.0


@pytest.mark.parametrize(
    "table", ["traffic", "turns", "queues", "signal_cycles", "track_points", "count_sections"]
)
def test_a_time_in_which_nothing_was_recorded_is_refused(tmp_path, table):
    """Without rows it would look like one without traffic; recorded is the half hour from 22:10."""
    first = EDGE - STEPS_PER_HOUR + STEPS_PER_HOUR // 6
    stands = drive(1, first, np.full(STEPS_PER_HOUR // 2, 20.0), speed=0.0)
    dataset = dataset_of(tmp_path / "data", [stands])
    sections = gpd.GeoDataFrame(geometry=[LineString([(30, -5), (30, 5)])], crs="EPSG:25832")
    ask = getattr(dataset, table)
    if table == "count_sections":
        ask = partial(ask, sections)
    day = "2023-11-14 "
    for time in (
        {"begin": "2030-01-01"}, {"end": "2020-01-01"}, {"begin": day + "22:45"},
        {"begin": day + "22:40", "end": day + "22:50"}, {"end": day + "22:00"},
    ):  # fmt: skip
        with pytest.raises(InputError, match="nothing was measured in that time"):
            ask(**time)
    with pytest.raises(InputError, match=r"from 2023-11-14T22:10:00Z to 2023-11-14T22:39:59"):
        ask(begin=day + "22:40", end=day + "22:45")
    ask(begin=day + "22:30", end=day + "22:45")
    if table in {"traffic", "turns", "queues", "count_sections"}:  # no interval begins in it
        with pytest.raises(InputError, match="no interval with a recording begins"):
            ask(begin=day + "22:31", end=day + "22:45")
        with pytest.raises(InputError, match="no interval with a recording begins"):
            ask(begin=day + "22:16", end=day + "22:29")


def test_the_whole_of_a_short_recording_has_volumes_without_an_interval_given(tmp_path):
    """Of a quarter of an hour two minutes are under a fifth."""
    first = EDGE - STEPS_PER_HOUR
    cars = [through(n, first + 100 + 200 * n, STRAIGHT) for n in range(8)]
    found = driven(tmp_path / "data", fork(), pd.concat(cars), lanes=fork_lanes())
    for begin in (None, first + 30):  # the interval in which it begins counts
        fine = found.traffic("1min", whole=True)
        pd.testing.assert_frame_equal(found.traffic(begin=begin, whole=True), fine)
        approach = fine.set_index("lane").loc[APPROACH]
        assert approach["counted"] == 8
        assert approach["volume"] > 8.0  # of whole minutes, of which a part was recorded
    assert found.turns(whole=True)["volume"].notna().any()
    assert found.traffic("15min", whole=True)["volume"].isna().all()


def test_turns_of_the_whole_time_sum_to_their_approach(tmp_path):
    """In a minute of the two nobody came to an exit, whose cars are shared like the others."""
    first = EDGE - STEPS_PER_HOUR
    tracks = [through(n, first + 100 + 100 * n, (STRAIGHT, LEFT)[n % 3 == 0]) for n in range(3)]
    lost = through(9, first + 1500, STRAIGHT)
    tracks.append(lost[lost["lanelet_id"] == APPROACH])
    tracks.append(through(12, first + 2400, LEFT, begin=70.0))
    lanes = fork_lanes(LINE_M - 10.0)
    found = driven(tmp_path / "data", fork(), pd.concat(tracks), lanes=lanes)
    lanes, turns = (getattr(found, n)("1min", whole=True) for n in ("traffic", "turns"))
    approach = lanes.set_index("lane").loc[APPROACH]
    assert approach["counted"] == 4
    assert found.turns("1min")["volume"].isna().any()
    assert turns["volume"].sum() == pytest.approx(approach["volume"])
    share = turns.set_index("to_lane")["volume"] / approach["volume"]
    assert share[STRAIGHT] == pytest.approx(2 / 3)


def test_turns_are_not_known_where_nobody_was_followed_to_an_exit(tmp_path):
    """In times without cars nobody turns: from these alone follows no 0 of the whole time."""
    first = EDGE - STEPS_PER_HOUR
    tracks = [through(n, first + 100 + 2400 * n, STRAIGHT) for n in range(3)]
    lost = [each[each["lanelet_id"] == APPROACH] for each in tracks]
    lost.append(through(9, EDGE - STEPS_PER_QUARTER, STRAIGHT, begin=70.0))  # never at the line
    found = driven(tmp_path / "data", fork(), pd.concat(lost), lanes=fork_lanes(LINE_M - 10.0))
    approach = found.traffic("1min", whole=True).set_index("lane").loc[APPROACH]
    assert approach["counted"] == 3
    assert (found.turns("1min")["volume"] == 0.0).any()
    for turns in (found.turns("1min", whole=True), found.turns("1h")):
        assert len(turns) == 2
        assert turns[["volume", "volume_se", "volume_veh_h"]].isna().all(axis=None)


def test_turns_of_the_whole_time_have_that_of_their_lanes(tmp_path):
    """After five of ten minutes nobody looks at the approach, so that turns have no rows."""
    first = EDGE - STEPS_PER_HOUR
    tracks = [through(n, first + 40 + 500 * n, (STRAIGHT, LEFT)[n % 2]) for n in range(10)]
    late = through(11, first + 11_800, STRAIGHT)
    tiles = fork()
    approach = tiles.loc[tiles["lane"] == APPROACH, "tile_id"]
    found = fork_dataset(
        tmp_path / "data", [*tracks, late[late["lanelet_id"] == STRAIGHT]],
        until=dict.fromkeys(approach, first + 6000),
    )  # fmt: skip
    lanes, turns = (getattr(found, n)("1min", whole=True) for n in ("traffic", "turns"))
    assert found.turns("1min")["begin"].nunique() == 5
    for name in ("begin", "end"):
        assert set(turns[name]) == set(lanes[name])
    mine = lanes.set_index("lane").loc[APPROACH]
    for name in ("volume", "volume_veh_h"):
        assert turns[name].sum() == pytest.approx(mine[name])
    assert turns["visible_share"].tolist() == pytest.approx([mine["visible_share"]] * 2)


def test_an_hour_of_which_a_part_is_known_is_estimated_with_a_larger_error(measured):
    """Of the second hour a twentieth was recorded: there is no volume."""
    hour = measured.traffic("1h").iloc[1]
    assert np.isnan(hour["volume"])
    assert hour["visible_share"] == pytest.approx(measured.traffic()["visible_share"].iloc[-1] / 4)
    half = measured.traffic("1h", end="2023-11-14 23:15").iloc[0]
    quarter = measured.traffic(end="2023-11-14 23:15").iloc[0]
    assert half["volume"] == pytest.approx(4.0 * quarter["volume"])
    assert half["volume_se"] > 4.0 * quarter["volume_se"]


@pytest.mark.parametrize(
    ("day", "hours"), [("2023-10-29", 25), ("2023-03-26", 23), ("2023-11-14", 24)]
)
def test_days_follow_the_clocks_of_the_site(tmp_path, day, hours):
    noon = int(pd.Timestamp(f"{day} 12:00", tz="Europe/Berlin").timestamp()) * 20
    dataset = dataset_of(tmp_path / "data", [car(1, noon)], timezone="Europe/Berlin")
    row = dataset.traffic("24h").iloc[0]
    assert row["begin"].isoformat().startswith(f"{day}T00:00:00")
    assert (row["end"] - row["begin"]) == pd.Timedelta(hours=hours)
    assert row["counted"] == 1


@pytest.mark.parametrize("interval", ["7min", "20s", "40min", "48h", "35min"])
def test_other_intervals_are_refused(measured, interval):
    with pytest.raises(UsageError, match="neither a part of 15 min"):
        measured.traffic(interval)


def test_fine_intervals_need_exact_tables(dataset):
    update(dataset)
    record = read_hour(dataset.folder, HOUR)
    write_record(dataset.folder, replace(record, dropped=tuple(record.parts)))
    for table in HOUR_TABLES:
        part_path(dataset.folder, table, HOUR).unlink()
    with pytest.raises(InputError, match="no exact tables any more"):
        dataset.traffic("5min")
    assert dataset.traffic("5min", begin="2023-11-15 00:00")["counted"].sum() == 2
    update(dataset)  # and what was measured before stays
    assert dataset.traffic()["counted"].sum() == 8


def test_hours_without_vehicles_have_no_traffic(tmp_path):
    dataset = write_dataset(tmp_path / "data", hours=[HOUR], vehicles=False)
    update(dataset)
    assert dataset.lane_measures().empty
    assert not days(dataset)[0].exists()
    assert part_path(dataset.folder, TILE_COUNTS, HOUR).exists()
    for read in (dataset.traffic, dataset.turns, dataset.queues, dataset.signal_cycles):
        with pytest.raises(InputError, match="holds no vehicles"):
            read()


def test_an_hour_of_which_little_is_visible_has_no_volume(tmp_path):
    """Ten minutes are two thirds of a quarter, and a sixth of the hour."""
    first = EDGE - STEPS_PER_HOUR
    tracks = [car(n, first + 1_900 * n) for n in range(7)]
    tracks[-1] = car(6, first + 12_000 - 118)
    made = dataset_of(tmp_path / "data", tracks)
    quarter, hour = made.traffic("15min").iloc[0], made.traffic("1h").iloc[0]
    assert quarter["volume"] > 0.0
    assert 0.1 < hour["visible_share"] < 0.2
    assert np.isnan(hour["volume"])
    assert np.isnan(hour["volume_se"])
    assert hour["counted"] == quarter["counted"] > 0


def two_lanes(folder, **sigma):
    """Drive six cars in the first half hour on one lane, three on the lane on its left."""
    left = straight_tiles(120, lanelet_id=8).assign(tile_id=np.arange(120, 240))
    left.geometry = left.translate(0.0, 3.0)
    tiles = pd.concat([TILES, left], ignore_index=True)
    both = pd.concat([LANES, LANES.assign(lane=8, lanelets=[[8]])], ignore_index=True)
    first = EDGE - STEPS_PER_HOUR
    tracks = [car(n, first + n * STEPS_PER_QUARTER // 3 + 99) for n in range(6)]
    tracks += [
        car(10 + n, first + n * STEPS_PER_QUARTER // 2 + 99).assign(lanelet_id=8) for n in range(4)
    ]
    stands = replace(pose(), evidence={"sigma": sigma})
    return driven(folder, tiles, pd.concat(tracks), lanes=both, seen_from=stands)


def test_a_pose_that_may_be_a_lane_off_widens_errors_in_all_intervals_alike(tmp_path):
    """With a sigma of half a lane a third of all poses are on another one."""
    sure = two_lanes(tmp_path / "sure", easting=0.1, northing=0.1)
    off = two_lanes(tmp_path / "off", easting=0.1, northing=1.5)
    for interval, (mine, other) in {"5min": (1, 1), "15min": (3, 2), "1h": (6, 4)}.items():
        before, after = (
            each.traffic(interval).groupby("lane").nth(0).set_index("lane") for each in (sure, off)
        )
        assert before["counted"].to_dict() == {7: mine, 8: other}
        for name in ("volume", "occupancy"):
            here, beside = (float(before[name][lane]) for lane in (7, 8))
            more = 0.3173 * ((beside - here) ** 2 + here**2) / 2.0  # there is none on its right
            added = after[f"{name}_se"] ** 2 - before[f"{name}_se"] ** 2
            assert added[7] == pytest.approx(more, rel=1e-3)
    assert off.lane_measures().equals(sure.lane_measures())  # as they are stored


def test_turns_share_what_a_pose_leaves_open_of_their_approach(tmp_path):
    first = EDGE - STEPS_PER_HOUR
    cars = [through(n, first + 4_000 * n, LEFT if n == 0 else STRAIGHT) for n in range(4)]
    errors = []
    for northing in (0.1, 1.5):
        stands = replace(pose(), evidence={"sigma": {"easting": 0.1, "northing": northing}})
        made = fork_dataset(tmp_path / str(northing), cars, seen_from=stands)
        turns = made.turns("15min")
        assert turns["volume"].notna().all()
        errors.append(turns["volume_se"] ** 2)
    # nothing is beside the approach
    np.testing.assert_allclose(errors[1] - errors[0], 0.3173 * turns["volume"] ** 2, rtol=1e-3)
