"""What the numbers rest on: counts by sensor and hour, local time, verdicts."""

from dataclasses import replace
from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from datasets import write_dataset
from hypothesis import given, settings
from hypothesis import strategies as st
from sites import START, crossing, pose, recording

from gis_radar.base import InputError, UsageError, in_language
from gis_radar.dataset import measure
from gis_radar.products import measure_quality
from gis_radar.products.quality.counting import hour_begins

BERLIN = ZoneInfo("Europe/Berlin")
ON_TILE = np.array([12.25, 0.0, -5.0])


def drive(time, rng=None):
    """One detection a frame that moves along the lane, and one beside it that stands."""
    rng = rng or np.random.default_rng(0)
    ahead = np.array([ON_TILE + [rng.uniform(0, 15), 0, 0] for _ in time])
    aside = np.tile([15.0, 30.0, -5.0], (len(time), 1))
    points = np.stack([ahead, aside], axis=1).reshape(-1, 3)
    return np.repeat(time, 2), points, np.tile([5.0, 0.0], len(time))


def measured(folder, name, time, points, rate, **changes):
    path = recording(folder / f"{name}.parquet", time, points, range_rate=np.float32(rate))
    return measure(
        [path], [pose(**changes)], crossing(), None, folder / name, hits_only=True, check=False
    )


def row_of(dataset, **options):
    (row,) = measure_quality(dataset, **options).table.to_dict("records")
    return row


def test_a_sensor_that_is_well(tmp_path):
    row = row_of(measured(tmp_path, "a", *drive(START + np.arange(400) * 0.05)))
    assert row["verdict"] == "good"
    assert (row["frames_expected"], row["frames"], row["dropped"], row["doubled"]) == (
        400, 400, 0, 0,
    )  # fmt: skip
    assert row["detections_per_frame"] == 2.0
    assert row["moving_share"] == 0.5
    assert row["clock_offset_s"] == 0.0


def test_dropped_and_doubled_frames(tmp_path):
    kept = np.setdiff1d(np.arange(400), [50, 51, 52, 200])
    time = np.sort(np.concatenate([START + kept * 0.05, START + np.array([70, 90]) * 0.05 + 0.01]))
    row = row_of(measured(tmp_path, "a", *drive(time)))
    assert (row["frames"], row["dropped"], row["doubled"]) == (398, 4, 2)
    assert row["frames_expected"] == 400


def test_a_sensor_that_stops_is_at_fault_hour_by_hour(tmp_path):
    """R1 delivers over three hours, R2 stops in the second: a slow 0.5 Hz keeps it small."""
    begin = 1_700_002_800.0 - 1800.0
    slow = begin + np.arange(0, 7200, 1.0)
    measured(tmp_path, "a", *drive(slow))
    time, points, rate = drive(slow[:2400], np.random.default_rng(1))
    path = recording(tmp_path / "b.parquet", time, points, range_rate=np.float32(rate))
    both = measure(
        [path], [pose(sensor="R2")], crossing(), None, tmp_path / "a", hits_only=True, check=False
    )
    table = measure_quality(both).table
    seen = table[["sensor", "frames_expected", "frames", "verdict"]].to_numpy().tolist()
    assert seen == [
        ["R1", 1800, 1800, "good"],
        ["R1", 3600, 3600, "good"],
        ["R1", 1800, 1800, "good"],
        ["R2", 1800, 1800, "good"],
        ["R2", 3600, 600, "17 % of the frames expected"],
        ["R2", 1800, 0, "no data"],
    ]
    lines = measure_quality(both).figures()
    assert lines["R1"] == "3 of 3 hours good"
    assert "no data (1 h)" in lines["R2"]


def test_a_sensor_that_came_later_lacks_nothing_before(tmp_path):
    begin = 1_700_002_800.0 + 60.0
    measured(tmp_path, "a", *drive(begin + np.arange(0, 600, 1.0)))
    time, points, rate = drive(begin + 7200.0 + np.arange(0, 600, 1.0), np.random.default_rng(1))
    path = recording(tmp_path / "b.parquet", time, points, range_rate=np.float32(rate))
    both = measure(
        [path], [pose(sensor="R2")], crossing(), None, tmp_path / "a", hits_only=True, check=False
    )
    table = measure_quality(both).table
    assert table["sensor"].tolist() == ["R1", "R1", "R2"]
    (line,) = measure_quality(both).warnings()
    assert line.startswith("R1: no data in the hour from 2023-11-15T01:00Z; 1 of its 2 hours")


def test_frames_are_expected_while_something_was_recorded(tmp_path):
    """Two minutes, and two a week later, of R1; R2 recorded the second ones, not all of them."""
    begin, week = 1_700_002_800.0 + 900.0, 7 * 86_400.0
    lossy = np.setdiff1d(np.arange(0, 120, 1.0), np.arange(40, 50))
    parts = [("R1", begin + lossy), ("R1", begin + week + np.arange(0, 120, 1.0))]
    parts.append(("R2", begin + week + np.arange(0, 60, 1.0)))
    for seed, (sensor, frames) in enumerate(parts):
        time, points, rate = drive(frames, np.random.default_rng(seed))
        path = recording(tmp_path / f"{seed}.parquet", time, points, range_rate=np.float32(rate))
        dataset = measure(
            [path], [pose(sensor=sensor)], crossing(), None, tmp_path / "a", hits_only=True,
            check=False,
        )  # fmt: skip
    table = measure_quality(dataset).table[["sensor", "frames_expected", "frames", "verdict"]]
    assert table.to_numpy().tolist() == [
        ["R1", 120, 110, "good"],
        ["R1", 120, 120, "good"],
        ["R2", 120, 60, "50 % of the frames expected"],
    ]


def test_at_a_live_site_frames_are_expected_while_all_sensors_are_silent(tmp_path):
    """From 22:45 on it delivers for two minutes, and for two from 23:30 on."""
    begin = 1_700_002_800.0 - 900.0
    for name in ("early", "late"):
        time, points, rate = drive(begin + np.arange(0, 120, 1.0) + 2700.0 * (name == "late"))
        path = recording(tmp_path / f"{name}.parquet", time, points, range_rate=np.float32(rate))
        dataset = measure(
            [path], [pose(sensor="R1")], crossing(), None, tmp_path / "a", hits_only=True,
            check=False,
        )  # fmt: skip
    live = replace(dataset, manifest=replace(dataset.manifest, live=True))
    for each, expected in ((dataset, [120, 120]), (live, [900, 1920])):
        table = measure_quality(each).table
        assert table["frames_expected"].tolist() == expected
        assert table["frames"].tolist() == [120, 120]


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda time, points, rate: (time, points[:1].repeat(800, axis=0), rate), "frozen"),
        (lambda time, points, rate: (time, points + [0, 40, 0], rate), "no tile is ever hit"),
        (lambda time, points, rate: (time, points, rate * 0), "hits without motion"),
        (lambda time, points, rate: (time, points, rate - 104.0), "absurdly fast"),
        (lambda time, points, rate: (time, points * np.nan, rate), "all frames are empty"),
        (lambda time, points, rate: (time - START, points, rate), "clock not set"),
        (lambda time, points, rate: (time - 0.045 * (np.arange(800) // 2 % 10 == 7), points, rate),
         "10 % of the frames come twice"),
        (lambda time, points, rate: (time, np.column_stack([time % 0.1 + 12.3,
                                     points[:, 1:] * [0, 1]]), rate), "constant"),
    ],
)  # fmt: skip
def test_verdicts(tmp_path, change, verdict):
    healthy = drive(START + np.arange(400) * 0.05 + 0.001)
    assert row_of(measured(tmp_path, "good", *healthy))["verdict"] == "good"
    assert verdict in row_of(measured(tmp_path, "bad", *change(*healthy)))["verdict"]


def test_too_many_tiles_hit(tmp_path):
    tiles = crossing()
    centres = tiles.geometry.centroid
    points = np.column_stack([centres.x - 678_000.0, centres.y - 5_403_600.0, -5.0 + 0 * centres.x])
    time = START + np.arange(120) * 0.05
    dataset = measured(tmp_path, "a", np.repeat(time, len(points)), np.tile(points, (120, 1)), 3.0)
    assert "over 70 % of its tiles hit in 100 % of the frames" in row_of(dataset)["verdict"]


def test_pose_and_its_age(tmp_path):
    late = measured(
        tmp_path, "a", *drive([START]), evidence={"time": "2023-11-14T20:00:00Z"}, yaw=12.5
    )
    row = row_of(late)
    assert row["pose"] == "678000.00 E, 5403600.00 N, 375.00 m, yaw 12.50 pitch 0.00 roll 0.00"
    assert row["pose_age_h"] == 2.0


@given(st.lists(st.integers(-(10**15), 3 * 10**15), min_size=1, max_size=20))
def test_hours_are_those_of_the_calendar(times):
    zones = [ZoneInfo(name) for name in ("Europe/Berlin", "Asia/Kathmandu", "UTC")]
    for zone in zones:
        begins = hour_begins(np.array(times), zone)
        for time_us, begin in zip(times, begins.tolist(), strict=True):
            if time_us < 0:
                continue  # zones of the nineteenth century were off by seconds
            assert begin <= time_us // 1_000_000 < begin + 3600
            local = datetime.fromtimestamp(begin, zone)
            assert (local.minute, local.second) == (0, 0)


def test_the_hour_that_comes_twice(tmp_path):
    """On 25 October 2026 clocks in Berlin go back from 03:00 to 02:00."""
    begin = datetime(2026, 10, 25, 0, 0, tzinfo=ZoneInfo("UTC")).timestamp()
    dataset = measured(tmp_path, "a", *drive(begin + np.arange(0, 7200, 1.0)))
    table = measure_quality(dataset, timezone="Europe/Berlin").table
    assert table["hour"].tolist() == [2, 2]
    assert table["frames"].tolist() == [3600, 3600]
    assert table["begin"].is_unique
    assert set(table["weekday"]) == {"Sunday"}


def test_hours_are_by_the_clocks_of_the_dataset(tmp_path):
    path = recording(tmp_path / "a.parquet", *drive([START])[:2], range_rate=np.float32(0.0))
    dataset = measure(
        [path], [pose()], crossing(), None, tmp_path / "a", hits_only=True, check=False,
        timezone="Asia/Tokyo",
    )  # fmt: skip
    begin = datetime.fromtimestamp(START, ZoneInfo("Asia/Tokyo"))
    assert row_of(dataset)["hour"] == begin.hour
    assert row_of(dataset, timezone="UTC")["hour"] != begin.hour


@settings(max_examples=5)
@given(seed=st.integers(0, 99), cut=st.integers(1, 599))
def test_quality_of_a_recording_in_two_is_that_of_the_whole(tmp_path_factory, seed, cut):
    folder = tmp_path_factory.mktemp("q")
    rng = np.random.default_rng(seed)
    time = 1_700_002_780.0 + np.sort(rng.choice(700, 600, replace=False)) * 0.06
    rows = drive(time, rng)
    whole = measured(folder, "whole", *rows)
    for name, part in (("b", slice(2 * cut, None)), ("a", slice(2 * cut))):
        time_s, points, rate = (column[part] for column in rows)
        path = recording(folder / f"{name}.parquet", time_s, points, range_rate=np.float32(rate))
        parts = measure(
            [path], [pose()], crossing(), None, folder / "parts", hits_only=True, check=False
        )
    pd.testing.assert_frame_equal(measure_quality(parts).table, measure_quality(whole).table)
    table = measure_quality(whole).table
    assert len(table) == 2
    lost = np.round(np.diff(time) / 0.06).astype(int).sum() - 599
    assert table["dropped"].sum() == lost


def test_written_tables_are_in_utc(tmp_path):
    quality = measure_quality(measured(tmp_path, "a", *drive([START])), timezone="Europe/Berlin")
    quality.write(tmp_path / "q.csv")
    text = (tmp_path / "q.csv").read_text().splitlines()
    assert "2023-11-14T22:00:00Z,2023-11-14T23:00:00Z,2023-11-14,23,Tuesday" in text[1]
    with in_language("de"):  # of the terminal
        quality.write(tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "q.csv").read_bytes()
    quality.write(tmp_path / "german.csv", csv_locale="de")
    german = pd.read_csv(tmp_path / "german.csv", sep=";", decimal=",", encoding="utf-8-sig")
    assert german.loc[0, ["weekday", "verdict"]].tolist() == ["Dienstag", "in Ordnung"]
    english = pd.read_csv(tmp_path / "q.csv").drop(columns=["weekday", "verdict"])
    pd.testing.assert_frame_equal(german[english.columns], english)
    assert (tmp_path / "german.csv").read_bytes().startswith(b"\xef\xbb\xbf")
    quality.write(tmp_path / "q.parquet")
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "q.parquet"), quality.table)
    with pytest.raises(UsageError, match="known table format"):
        quality.write(tmp_path / "q.xlsx")


@pytest.mark.parametrize(("csv_locale", "third"), [("de", "0,333333"), ("en", "0.333333")])
def test_written_numbers_are_rounded(tmp_path, csv_locale, third):
    quality = measure_quality(measured(tmp_path, "a", *drive([START])))
    quality = replace(quality, table=quality.table.assign(moving_share=1.0 / 3.0))
    quality.write(tmp_path / "q.csv", csv_locale=csv_locale)
    text = (tmp_path / "q.csv").read_text()
    assert third in text
    assert f"{third}3" not in text


def test_what_is_refused(tmp_path):
    dataset = measured(tmp_path, "a", *drive([START]))
    with pytest.raises(UsageError, match="no time zone"):
        measure_quality(dataset, timezone="Europe/Bayern")
    with pytest.raises(InputError, match="holds no frame"):
        measure_quality(write_dataset(tmp_path / "empty", hours=[472_222]))
