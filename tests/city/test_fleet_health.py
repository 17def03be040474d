"""The health of a city's sensors in a month, against what is laid into the data."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from cities import HOUR, driven_hour, write_run, write_site
from datasets import pose_rows
from sites import pose

import gis_radar as gr
from gis_radar.base import Text, in_language, with_texts, write_json
from gis_radar.calibration import WRONG, Finding
from gis_radar.dataset import POSES, write_single_file
from gis_radar.dataset.files.tables import SIGHTS

DAY = HOUR // 24 * 24  # 2023-11-14, 0 h
HOURS = [DAY + hour for hour in range(6, 12)]
MONTH = "2023-11"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return driven_hour(tmp_path_factory.mktemp("hour") / "dataset", every_s=60.0)


def states(root):
    """Give the state of each sensor, by site and sensor, and the table."""
    table = gr.fleet_health(root, MONTH)
    return dict(
        zip(zip(table["site"], table["sensor"], strict=True), table["state"], strict=True)
    ), table


def test_a_sensor_that_fell_silent_is_first_and_the_time_is_told(tmp_path, source):
    spans = {"R1": [(HOURS[0], HOURS[2])], "R2": [(HOURS[0], HOURS[-1] + 1)]}
    write_site(tmp_path, "a", source, HOURS, sensors=spans)
    known, table = states(tmp_path)
    assert known == {("a", "R1"): "silent", ("a", "R2"): "gaps"}  # the month began before
    first = table.iloc[0]
    assert first["sensor"] == "R1"
    assert first["since"] == pd.Timestamp(HOURS[2] * 3600, unit="s", tz="UTC")
    assert first["gap_begin"] == pd.Timestamp("2023-11-01T00:00Z")


def test_the_share_is_that_of_the_observed_time_where_a_tile_is_a_sensors_own(tmp_path, source):
    """Recordings claim the whole month; the counts know that frames are there in six hours."""
    month = [(DAY - 13 * 24, HOURS[-1] + 1)]
    dataset = write_site(tmp_path, "a", source, HOURS, sensors={"R1": month, "R2": month})
    _, table = states(tmp_path)
    hours = HOURS[-1] + 1 - (DAY - 13 * 24)
    assert table["share"].to_numpy() == pytest.approx(len(HOURS) / hours, rel=1e-3)
    counts = dataset.tile_counts()
    assert counts.groupby("tile_id")["observed_steps"].sum().max() == len(HOURS) * 72_000


def test_all_its_tiles_seen_by_others_leave_its_recordings(tmp_path, source):
    dataset = write_site(
        tmp_path, "a", source, HOURS, sensors={"R1": [(DAY - 13 * 24, HOURS[-1] + 1)]}
    )
    tiles = dataset.tiles()["tile_id"].to_numpy()
    both = {"pose": np.repeat(["R1", "R2"], len(tiles)), "tile_id": np.tile(tiles, 2)}
    write_single_file(SIGHTS, dataset.folder, both, dataset.manifest.fingerprint)
    write_single_file(POSES, dataset.folder, pose_rows([pose(sensor="R1"), pose(sensor="R2")]),
                dataset.manifest.fingerprint)  # fmt: skip
    _, table = states(tmp_path)
    assert table["share"].tolist() == pytest.approx([1.0], abs=1e-4)


def test_it_needs_no_exact_tables(tmp_path, source):
    dataset = write_site(tmp_path, "a", source, HOURS)
    before = gr.fleet_health(tmp_path, MONTH)
    for record in (dataset.folder / "hours").rglob("*.json"):
        document = json.loads(record.read_text())
        record.write_text(json.dumps(document | {"dropped": sorted(document["parts"])}))
    for folder in (dataset.folder / name for name in ("frames", "tracks", "observed", "visible")):
        for part in folder.rglob("*.parquet"):
            part.unlink()
    pd.testing.assert_frame_equal(gr.fleet_health(tmp_path, MONTH), before)


def poses_of(dataset, moved, **further):
    """Write a pose of the sensor, and another one from the third hour on."""
    rows = pose_rows([pose(sensor="R1")])
    second = pose(sensor="R1", **moved)
    other = pose_rows([second])
    rows = {name: [*rows[name], *other[name]] for name in rows}
    rows["pose"] = ["R1", "R1-2"]
    rows["since"] = [None, HOURS[2] * 3600.0]
    rows["document"] = [rows["document"][0], json.dumps(json.loads(rows["document"][1]) | further)]
    write_single_file(POSES, dataset.folder, rows, dataset.manifest.fingerprint)


@pytest.mark.parametrize(
    ("change", "further", "is_moved"),
    [
        ({"easting": pose().easting + 1.0}, {}, True),
        ({"yaw": pose().yaw + 2.0}, {}, True),
        ({"easting": pose().easting + 0.05}, {"event": "moved"}, True),
        ({"easting": pose().easting + 0.05, "yaw": pose().yaw + 0.1}, {}, False),
        ({"yaw": pose().yaw + 359.9}, {}, False),
    ],
)  # fmt: skip
def test_a_sensor_that_was_moved(tmp_path, source, change, further, is_moved):
    dataset = write_site(tmp_path, "a", source, HOURS)
    poses_of(dataset, change, **further)
    known, table = states(tmp_path)
    assert (known["a", "R1"] == "moved") == is_moved
    if is_moved:
        assert table["since"][0] == pd.Timestamp(HOURS[2] * 3600, unit="s", tz="UTC")


def test_a_pose_that_does_not_fit_and_a_clock(tmp_path, source):
    dataset = write_site(tmp_path, "a", source, HOURS, clock_offset=-0.25)
    known, table = states(tmp_path)
    assert known == {("a", "R1"): "clock off"}
    assert table["clock_offset_s"].tolist() == [-0.25]
    assert table["since"][0] == pd.Timestamp(HOURS[0] * 3600, unit="s", tz="UTC")
    found = Finding(sensor="R1", verdict=WRONG, evidence="3 of 90 paths on lanes", cause="yaw")
    replace(dataset.manifest, checks={"R1": found.record}).write(dataset.folder)
    known, table = states(tmp_path)
    assert known == {("a", "R1"): "pose doubtful"}
    assert "3 of 90 paths on lanes" in table["reasons"][0]
    assert "0.250 s" in table["reasons"][0]
    with in_language("de"):
        assert "0,250 s" in gr.fleet_health(tmp_path, MONTH)["reasons"][0]
    since = pd.Timestamp(HOURS[1] * 3600, unit="s", tz="UTC")
    dated = replace(found, since=since.isoformat(), until="2030-01-01T00:00:00Z")
    replace(dataset.manifest, checks={"R1": dated.record}).write(dataset.folder)
    assert states(tmp_path)[1]["since"][0] == since
    later = replace(found, since="2030-01-01T00:00:00Z", until="2030-01-02T00:00:00Z")
    replace(dataset.manifest, checks={"R1": later.record}).write(dataset.folder)
    assert states(tmp_path)[0] == {("a", "R1"): "clock off"}


def test_a_sensor_of_the_site_file_that_never_came(tmp_path, source):
    write_site(tmp_path, "a", source, HOURS)
    write_run(
        tmp_path, "a", sensor=[{"name": "R1"}, {"name": "R9"}],
    )  # fmt: skip
    path = tmp_path / "results" / "a" / "run.json"
    document = json.loads(path.read_text())
    document |= {"sensors_in_heat_maps": ["R1"],
                 "stages": [{"name": "localize R9", "error": "R9.csv: no rows"}]}  # fmt: skip
    path.write_text(json.dumps(document))
    known, table = states(tmp_path)
    assert known["a", "R9"] == "no data"
    assert table.iloc[0]["reasons"] == "R9.csv: no rows"


def test_a_sensor_whose_recordings_were_refused_says_why(tmp_path, source):
    """A mast was knocked: nothing of it comes into the dataset, and the page says so."""
    write_site(tmp_path, "a", source, HOURS)
    write_site(tmp_path, "b", source, [hour + 24 for hour in HOURS])
    for site in "ab":
        write_run(tmp_path, site, sensor=[{"name": "R1"}, {"name": "R9"}])
    why = [{"what": name, "message": Text("{}: {}", name, Text("does not fit"))}
           for name in ("R1", "R9", "10 UTC")]  # fmt: skip
    record = {"sites": {"a": {"failures": why}, "b": {"failures": []}}}
    write_json(tmp_path / "run.json", with_texts(record))
    known, table = states(tmp_path)
    assert known == {("a", "R9"): "no data", ("a", "R1"): "silent", ("b", "R1"): "gaps"}
    assert table["reasons"][0] == "does not fit"
    assert table["reasons"][1].endswith("; does not fit")


def test_a_sensor_taken_down_long_ago_is_not_listed(tmp_path, source):
    write_site(tmp_path, "a", source, HOURS, sensors={
        "old": [(DAY - 90 * 24, DAY - 80 * 24)], "R1": [(HOURS[0], HOURS[-1] + 1)],
        "last_month": [(DAY - 30 * 24, DAY - 29 * 24)],
    })  # fmt: skip
    known, _ = states(tmp_path)
    assert set(known) == {("a", "R1"), ("a", "last_month")}
    assert known["a", "last_month"] == "silent"


def test_a_sensor_that_came_back_in_the_next_month_was_silent(tmp_path, source):
    later = DAY + 20 * 24
    spans = {"R1": [(HOURS[0], HOURS[2]), (later, later + 1)], "R2": [(HOURS[0], HOURS[-1] + 1)]}
    write_site(tmp_path, "a", source, HOURS, sensors=spans)
    known, _ = states(tmp_path)
    assert known["a", "R1"] == "silent"


def test_months_that_are_there_are_named(tmp_path, source):
    write_site(tmp_path, "a", source, HOURS)
    with pytest.raises(gr.InputError, match="has no data of 2023-12") as told:
        gr.fleet_health(tmp_path, "2023-12")
    assert "there are 2023-11" in told.value.hint
    for wrong in ("2023-13", "November", "2023-1", "23-11"):
        with pytest.raises(gr.UsageError, match="is no month"):
            gr.fleet_health(tmp_path, wrong)
