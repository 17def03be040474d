"""What must not be measured, and what a run that is killed leaves behind."""

import json
import os
import re
import shutil
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pyogrio
import pytest
from maps import Listener
from measured import EDGE_S, MAP, contents, cut, measured, sample_pose, tiles

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.dataset import measuring, read_hours
from gis_radar.dataset.files.manifest import locked_for_writing


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Recordings of 2 s before and after an hour's edge."""
    folder = tmp_path_factory.mktemp("files")
    return {
        sensor: cut(folder / f"{sensor}.parquet", sensor, 18.0, 22.0, edge_s=20.0)
        for sensor in ("R1", "R2")
    }


def hits_of(folder, *recordings, **options):
    options = {"hits_only": True, "check": False} | options  # frames are looked at later
    return measured(folder, *recordings, **options)


def refused(folder, *recordings, match, error=gr.InputError, **options):
    """Measure what must be refused in one line; nothing else changes."""
    before = contents(folder) if folder.exists() else None
    with pytest.raises(error, match=match) as caught:
        hits_of(folder, *recordings, **options)
    assert "\n" not in caught.value.message
    assert (contents(folder) if folder.exists() else None) == before
    return caught.value


def test_one_recording_for_two_sensors(files, tmp_path):
    error = refused(
        tmp_path / "site", ("R1", files["R1"]), ("R2", files["R1"]), match="is given for R2"
    )
    assert error.exit_code == 3
    assert "R1" in error.message


def test_one_recording_for_two_sensors_one_after_the_other(files, tmp_path):
    hits_of(tmp_path / "site", ("R1", files["R1"]))
    refused(tmp_path / "site", ("R2", files["R1"]), match="is given for R2, and for R1")


@pytest.mark.parametrize("later_s", [0.0, 0.4])
def test_equal_frames_of_two_sensors(files, tmp_path, later_s):
    """A copy that is cut otherwise, or comes later, is another file with the same frames."""
    copy = cut(
        tmp_path / "copy.parquet", "R1", 18.3, 22.0, edge_s=20.0,
        change=lambda t: t.assign(time=t["time"] + later_s),
    )  # fmt: skip
    error = refused(
        tmp_path / "site", ("R1", files["R1"]), ("R2", copy), match="frames of R2 are those of R1"
    )
    assert str(files["R1"]) in error.message
    assert str(copy) in error.message


def test_equal_frames_added_to_a_dataset_change_nothing(files, tmp_path):
    hits_of(tmp_path / "site", ("R1", files["R1"]))
    copy = cut(tmp_path / "copy.parquet", "R1", 18.3, 22.0, edge_s=20.0)
    refused(tmp_path / "site", ("R2", copy), match="frames of R2 are those of R1")


def test_a_copy_with_other_times_and_places_for_a_second_sensor(files, tmp_path):
    """No frame of it is equal: it would add a sixth to the vehicles."""

    def changed(table):
        noise = np.random.default_rng(1).normal(0.0, 0.02, (len(table), 3)).astype(np.float32)
        return table.assign(
            time=table["time"] + 0.005,
            **dict(zip("xyz", (table[["x", "y", "z"]] + noise).to_numpy().T, strict=True)),
        )

    copy = cut(tmp_path / "copy.parquet", "R1", 18.3, 22.0, edge_s=20.0, change=changed)
    error = refused(
        tmp_path / "site", ("R1", files["R1"]), ("R2", copy),
        match="the numbers of detections of those of R1",
    )  # fmt: skip
    assert str(copy) in error.message


def test_recordings_in_the_order_of_other_poses(files, tmp_path):
    """Each by the other's pose gives a map, with twice the vehicles and nowhere right."""
    error = refused(
        tmp_path / "site", ("R1", files["R2"]), ("R2", files["R1"]),
        match=r"R2\.parquet: is given with the pose of R1, beside one of R2",
    )  # fmt: skip
    assert error.exit_code == 3
    assert "same order" in error.hint


def test_recordings_in_the_order_of_other_poses_by_what_convert_wrote_into_them(files, tmp_path):
    named = {}
    for sensor, letter in (("R1", "a"), ("R2", "b")):
        table = pq.read_table(files[sensor])
        named[sensor] = tmp_path / f"{letter}.parquet"
        of = {**(table.schema.metadata or {}), b"gis_radar.sensor": sensor.encode()}
        pq.write_table(table.replace_schema_metadata(of), named[sensor])
    refused(
        tmp_path / "site", ("R1", named["R2"]), ("R2", named["R1"]),
        match=r"b\.parquet: is given with the pose of R1, beside one of R2",
    )  # fmt: skip
    hits_of(tmp_path / "site", *named.items())


def test_a_time_zone_that_is_none(files, tmp_path):
    refused(
        tmp_path / "site", ("R1", files["R1"]), match="no time zone 'Europe/Berlinn'",
        error=gr.UsageError, timezone="Europe/Berlinn",
    )  # fmt: skip


def flip_in_row_group(path, group):
    place = pq.read_metadata(path).row_group(group).column(1)
    whole = bytearray(path.read_bytes())
    middle = place.data_page_offset + place.total_compressed_size // 2
    for k in range(middle, middle + 16):
        whole[k] ^= 0xFF
    path.write_bytes(whole)


def test_a_recording_damaged_in_a_new_hour_takes_none_of_the_others(tmp_path):
    """The hour before is made first: what is there of it stays, if the damaged one cannot be."""
    early = cut(tmp_path / "early.parquet", "R1", 0.0, 2.0, edge_s=300.0)
    hits_of(tmp_path / "site", ("R1", early))
    late = cut(tmp_path / "late.parquet", "R1", 4.0, 6.0, edge_s=300.0)
    later = cut(tmp_path / "later.parquet", "R1", 4.0, 6.0, edge_s=-300.0)
    tables = [pq.read_table(each) for each in (late, later)]
    with pq.ParquetWriter(late, tables[0].schema, write_page_checksum=True) as writer:
        for table in tables:
            writer.write_table(table)
    flip_in_row_group(late, 1)
    refused(tmp_path / "site", ("R1", late), match=r"late\.parquet: ")


def test_what_cannot_be_made_by_other_settings_leaves_the_dataset(files, tmp_path):
    hits_of(tmp_path / "site", ("R1", files["R1"]))
    bad = tmp_path / "R1b.parquet"
    shutil.copy(files["R1"], bad)
    bad.write_bytes(bad.read_bytes()[:-100])
    before = contents(tmp_path / "site")
    other = gr.Filters(min_speed=1.0)
    with pytest.raises(gr.InputError):
        hits_of(tmp_path / "site", ("R1", bad), filters=other, only=True)
    damaged = cut(tmp_path / "later.parquet", "R1", 18.0, 22.0, edge_s=-300.0)
    pq.write_table(pq.read_table(damaged), damaged, write_page_checksum=True)
    flip_in_row_group(damaged, 0)
    with pytest.raises(gr.InputError):
        hits_of(tmp_path / "site", ("R1", files["R1"]), ("R1", damaged), filters=other, only=True)
    assert contents(tmp_path / "site") == before
    hits_of(tmp_path / "site", ("R1", files["R1"]), filters=other, only=True)
    assert contents(tmp_path / "site") != before
    assert not list(tmp_path.glob(".site.*"))


def test_a_few_range_rates_are_none(tmp_path):
    """One number among many empty ones gave an occupancy of 0, where there is none."""

    def only_one(table):
        rates = table["range_rate"].where(np.arange(len(table)) == 5)
        return table.assign(range_rate=rates)

    path = cut(tmp_path / "R1.parquet", "R1", 18.0, 22.0, edge_s=20.0, change=only_one)
    listener = Listener()
    dataset = measured(tmp_path / "site", ("R1", path), reporter=listener)
    assert not dataset.has_vehicles
    assert any("has no range rates" in line for _, line in listener.messages)


def test_recordings_of_a_sensor_that_contradict_each_other(files, tmp_path):
    other = cut(
        tmp_path / "other.parquet", "R1", 19.0, 23.0, edge_s=20.0,
        change=lambda t: t.assign(x=t["x"] + np.float32(0.5)),
    )  # fmt: skip
    error = refused(tmp_path / "site", ("R1", files["R1"]), ("R1", other), match="differs from")
    assert str(files["R1"]) in error.message
    assert str(other) in error.message


def test_a_clock_that_jumps_by_more_than_a_day(tmp_path):
    path = cut(
        tmp_path / "R1.parquet", "R1", 18.0, 22.0, edge_s=20.0,
        change=lambda t: t.assign(time=t["time"] + 2e5 * (t["time"] >= EDGE_S)),
    )  # fmt: skip
    error = refused(tmp_path / "site", ("R1", path), match="its times jump from 2025-06-12T07:59")
    assert "recordings of different days one by one" in error.hint


def test_other_tiles_and_other_settings(files, tmp_path):
    hits_of(tmp_path / "site", ("R1", files["R1"]))
    refused(
        tmp_path / "site", ("R2", files["R2"]),
        match=r"other settings: filters.*min_speed was not set, is now 1\.0",
        filters=gr.Filters(min_speed=1.0),
    )  # fmt: skip
    longer = gr.make_tiles(gr.read_map(MAP), length_m=1.0)
    heard = Listener()
    with pytest.raises(gr.InputError, match="another set of tiles"):
        gr.measure(
            [files["R2"]], [sample_pose("R2")], longer, MAP, tmp_path / "site", reporter=heard
        )
    assert "checking poses and recordings" not in {str(stage) for stage, *_ in heard.stages}
    with pytest.raises(gr.InputError, match=r"are valid for 150 ms, those of .* for 100 ms"):
        hits_of(
            tmp_path / "site",
            ("R1", cut(tmp_path / "R1.parquet", "R1", 23.0, 24.0, edge_s=20.0)),
            cycles={"R1": 0.1},
        )


def test_a_dataset_of_a_version_that_listed_its_constants(files, tmp_path):
    site = tmp_path / "site"
    hits_of(site, ("R1", files["R1"]))
    manifest = json.loads((site / "dataset.json").read_text())
    manifest["settings"] |= {"vehicles": {"links": {"end_cost": 8.0}}, "hits": {"validity_s": 0.1}}
    del manifest["digest"]  # that version stated none
    (site / "dataset.json").write_text(json.dumps(manifest))
    line = r"other settings: vehicles\.links\.end_cost was 8\.0, is now not set"
    for hits_only in (True, False):
        error = refused(site, ("R2", files["R2"]), match=line, hits_only=hits_only)
    assert "another version's constants" in error.hint
    assert len(gr.open_dataset(site).hits())
    gr.open_dataset(site).withdraw(["R1.parquet"])
    assert len(gr.open_dataset(site).recordings()) == 0


def test_a_folder_of_others_is_left_alone(files, tmp_path):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "thesis.docx").write_text("all my work")
    refused(tmp_path / "site", ("R1", files["R1"]), match="thesis", error=gr.OutputError)


def test_two_writers(files, tmp_path):
    found = pytest.raises(gr.OutputError, match="another run is writing it")
    with locked_for_writing(tmp_path / "site", QUIET), found:
        hits_of(tmp_path / "site", ("R1", files["R1"]))


def test_a_recording_that_an_hour_needs_has_gone_or_changed(files, tmp_path):
    moved = tmp_path / "R1.parquet"
    shutil.copy(files["R1"], moved)
    hits_of(tmp_path / "site", ("R1", moved))
    (tmp_path / "archive").mkdir()
    moved.rename(tmp_path / "archive" / "renamed.parquet")
    (tmp_path / "archive" / "folder.parquet").mkdir()
    (tmp_path / "archive" / "gone.csv").symlink_to("nowhere")
    error = refused(tmp_path / "site", ("R2", files["R2"]), match=r"R1\.parquet: is not there")
    assert "--relink" in error.hint
    shutil.copy(files["R2"], moved)
    refused(tmp_path / "site", ("R2", files["R2"]), match="has changed since it was measured")
    assert gr.open_dataset(tmp_path / "site").relink(tmp_path / "archive") == 1
    assert hits_of(tmp_path / "site", ("R2", files["R2"])).sensors == ["R1", "R2"]


def test_a_recording_that_is_not_found_again_is_named(files, tmp_path):
    moved = tmp_path / "R1.parquet"
    shutil.copy(files["R1"], moved)
    hits_of(tmp_path / "site", ("R1", moved))
    moved.unlink()
    notes = Listener()
    assert gr.open_dataset(tmp_path / "site").relink(tmp_path, reporter=notes) == 0
    assert "R1.parquet" in notes.messages[-1][1]
    with pytest.raises(gr.InputError, match="has no recording R7"):
        gr.open_dataset(tmp_path / "site").withdraw(["R7.parquet"])
    gr.open_dataset(tmp_path / "site").withdraw(["R1.parquet"])  # need not be there
    assert len(gr.open_dataset(tmp_path / "site").hours()) == 0


def test_an_hour_names_what_it_was_made_from(files, tmp_path):
    """Other rows at the same times, another pose, filter or validity: another digest."""
    pose, folders = sample_pose("R1"), (tmp_path / f"{number}" for number in count())
    change = {"change": lambda t: t.assign(x=t["x"] + np.float32(0.5))}
    other = cut(tmp_path / "other.parquet", "R1", 18.0, 22.0, edge_s=20.0, **change)

    def digests(path=files["R1"], pose=pose, **options):
        folder = next(folders)
        gr.measure([path], [pose], tiles(), MAP, folder, hits_only=True, check=False, **options)
        return tuple(record.origin.inputs for record in read_hours(folder).values())

    found = [
        digests(), digests(other), digests(pose=replace(pose, yaw=pose.yaw + 0.1)),
        digests(filters=gr.Filters(min_speed=1.0)), digests(cycles={"R1": 0.1}),
    ]  # fmt: skip
    assert [len(each) for each in found] == [2] * len(found)
    assert [len(set(each)) for each in zip(*found, strict=True)] == [len(found)] * 2
    assert digests() == found[0]


def test_a_withdrawn_recording_is_gone_from_the_hour_after_it(files, tmp_path):
    """Its last frame is valid in the first steps of that hour."""
    site = tmp_path / "site"
    hits_of(site, ("R2", files["R2"]))
    alone = contents(site)
    early = cut(tmp_path / "early.parquet", "R1", 18.0, 20.0, edge_s=20.0)
    hits_of(site, ("R1", early))
    after = "observed/date=2025-06-12/08.parquet"
    assert contents(site)[after] != alone[after]
    gr.open_dataset(site).withdraw(["early.parquet"])
    assert contents(site) == alone


def test_a_name_that_two_recordings_have_withdraws_neither(files, tmp_path):
    twin = cut(tmp_path / "twin" / "R1.parquet", "R1", 23.0, 24.0, edge_s=20.0)
    hits_of(tmp_path / "site", ("R1", files["R1"]), ("R1", twin))
    before = contents(tmp_path / "site")
    with pytest.raises(gr.InputError, match=r"has several recordings R1\.parquet"):
        gr.open_dataset(tmp_path / "site").withdraw(["R1.parquet"])
    assert contents(tmp_path / "site") == before
    gr.open_dataset(tmp_path / "site").withdraw([twin])
    left = gr.open_dataset(tmp_path / "site").recordings()["path"]
    assert left.tolist() == [files["R1"].as_posix()]


def test_parts_removed_by_hand_are_made_again(files, tmp_path):
    hits_of(tmp_path / "site", ("R1", files["R1"]))
    whole = contents(tmp_path / "site")
    next((tmp_path / "site" / "hits").rglob("*.parquet")).unlink()
    next((tmp_path / "site" / "hours").rglob("08.json")).unlink()
    hits_of(tmp_path / "site", ("R1", files["R1"]))
    assert contents(tmp_path / "site") == whole


def test_a_registry_that_names_an_unknown_pose_is_damaged(files, tmp_path):
    for site, sensor in (("one", "R1"), ("two", "R2")):
        hits_of(tmp_path / site, (sensor, files[sensor]))
    shutil.copy(tmp_path / "two" / "recordings.parquet", tmp_path / "one")
    refused(tmp_path / "one", ("R1", files["R1"]), match="one: damaged: KeyError")


def killed_before(write, work, names=("replace", "unlink")):
    """Do some work in a child that dies before its n-th change of a file; tell whether it died."""
    child = os.fork()
    if child == 0:
        left = [write]

        def dies_at(change):
            def changed(self, *args, **kwargs):
                left[0] -= 1
                if left[0] < 0:
                    os._exit(9)
                return change(self, *args, **kwargs)

            return changed

        try:
            for name in names:
                setattr(Path, name, dies_at(getattr(Path, name)))
            work()
            os._exit(0)
        except BaseException:  # noqa: BLE001 - no child goes on with the tests
            os._exit(3)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert ended in {0, 9}
    return ended == 9


def hour_files(found, record):
    """The parts of an hour, by the name of its record."""
    date, hour = record.split("/")[1:]
    name = f"date={date}/{hour.removesuffix('.json')}.parquet"
    return {each: data for each, data in found.items() if each.endswith(name)}


def test_killed_at_any_write_the_next_run_ends_with_the_same_bytes(files, tmp_path):
    site, (first, second) = tmp_path / "site", files.items()
    hits_of(site, first)
    before = contents(site)
    shutil.copytree(site, tmp_path / "copy")
    hits_of(site, second)
    after, deaths = contents(site), 0
    while True:
        shutil.rmtree(site)
        shutil.copytree(tmp_path / "copy", site)
        if not killed_before(deaths, lambda: hits_of(site, second)):
            break
        deaths += 3
        left = contents(site)
        for record in (name for name in left if re.fullmatch(r"hours/[^/]+/\d\d\.json", name)):
            whole = hour_files(left, record) | {record: left[record]}
            assert whole in (
                hour_files(state, record) | {record: state.get(record)} for state in (before, after)
            )
        gr.open_dataset(site).check()
        if deaths % 9 == 0:
            hits_of(site, second)
            assert contents(site) == after
    assert deaths > 15
    assert contents(site) == after


def test_killed_while_it_begins_the_next_run_makes_it(files, tmp_path):
    site, first = tmp_path / "site", ("R1", files["R1"])
    hits_of(site, first)
    whole = contents(site)
    for deaths in (1, 8):
        shutil.rmtree(site)
        assert killed_before(deaths, lambda: hits_of(site, first))
        hits_of(site, first)
        assert contents(site) == whole


def test_killed_while_one_dataset_replaces_another_the_next_run_leaves_one(files, tmp_path):
    site, first, copy = tmp_path / "a" / "site", ("R1", files["R1"]), tmp_path / "copy"
    other = {"filters": gr.Filters(min_speed=1.0), "only": True}
    site.parent.mkdir()
    hits_of(site, first)
    earlier = contents(site)
    shutil.copytree(site, copy)
    hits_of(site, first, **other)
    whole = contents(site)
    for deaths in (0, 1):
        for options, expected in ((other, whole), ({"only": True}, earlier)):
            shutil.rmtree(site.parent)
            shutil.copytree(copy, site)
            assert killed_before(deaths, lambda: hits_of(site, first, **other), ["rename"])
            shutil.copytree(copy, site.with_name(".site.01234567.part"), dirs_exist_ok=True)
            hits_of(site, first, **options)
            assert contents(site) == expected
            assert [each.name for each in site.parent.iterdir()] == ["site"]


def test_a_full_disk_midway(files, tmp_path, monkeypatch):
    site = tmp_path / "site"
    hits_of(site, *files.items())
    whole = contents(site)
    shutil.rmtree(site)
    with monkeypatch.context() as patch:
        from gis_radar.dataset.files import parts

        real, writes = parts.PartWriter.close, []

        def full(self):
            writes.append(self)
            if len(writes) > 7:
                raise OSError(28, "No space left on device")
            return real(self)

        patch.setattr(parts.PartWriter, "close", full)
        with pytest.raises(gr.OutputError, match="the disk is full"):
            hits_of(site, *files.items())
    assert len(read_hours(site)) < 2
    hits_of(site, *files.items())
    assert contents(site) == whole


CLEARANCE = gr.Filters(clearance=(-0.5, 4.5))


def test_no_memory_midway_leaves_no_new_dataset(files, tmp_path, monkeypatch):
    def fails(*_, **__):
        raise MemoryError

    monkeypatch.setattr(measuring, "update_dataset", fails)
    with pytest.raises(MemoryError):
        hits_of(tmp_path / "site", ("R1", files["R1"]))
    assert not (tmp_path / "site").exists()


def test_no_layer_is_read_when_the_hours_are_made(files, tmp_path, monkeypatch):
    """Memory for it may be missing, and the dataset is in its place."""

    def fails(*_, **__):
        raise MemoryError

    def made(*given, **options):
        hours = update_dataset(*given, **options)
        monkeypatch.setattr(pyogrio, "read_dataframe", fails)
        return hours

    update_dataset = measuring.update_dataset
    monkeypatch.setattr(measuring, "update_dataset", made)
    assert hits_of(tmp_path / "site", ("R1", files["R1"]), hits_only=False).has_vehicles


def test_a_clearance_of_a_sensor_without_elevation(tmp_path):
    flat = cut(
        tmp_path / "flat.parquet", "R1", 18.0, 22.0, edge_s=20.0,
        change=lambda t: t.assign(z=np.float32(np.nan)),
    )  # fmt: skip
    site = tmp_path / "site"
    refused(site, ("R1", flat), filters=CLEARANCE, match=r"flat\.parquet: .*no elevation")


def test_a_clearance_over_a_road_without_heights(files, tmp_path):
    unknown = gr.make_tiles(gr.read_map(MAP)).assign(height_m=np.nan)
    with pytest.raises(gr.InputError, match="no road heights"):
        gr.measure(
            [files["R1"]], [sample_pose("R1")], unknown, MAP, tmp_path / "site",
            filters=CLEARANCE, hits_only=True,
        )  # fmt: skip


def said_of(tmp_path, change, **options):
    """Measure R1 as changed, over 3 s, and return what is said of it."""
    listener = Listener()
    path = cut(tmp_path / "odd.parquet", "R1", 10.0, 13.0, edge_s=-300.0, change=change)
    hits_of(tmp_path / "site", ("R1", path), reporter=listener, **options)
    return "\n".join(map(str, listener.lines))


@pytest.mark.parametrize("grid_s", [0.05, 0.1, 1.0])
def test_rounded_times_are_named(tmp_path, grid_s):
    """At 0.1 s two frames become one, and over half as many hits more."""

    def rounded(rows):
        since = rows["time"] - rows["time"].iloc[0]
        since = since * (1.0 if grid_s < 1.0 else 8.0)  # over 20 s
        return rows.assign(time=np.floor((rows["time"].iloc[0] + since) / grid_s) * grid_s)

    named = f"its first times are all multiples of {grid_s:g} s" in said_of(tmp_path, rounded)
    assert named == (grid_s > 0.05)


def test_times_on_the_grid_of_the_stated_cycle_are_right(tmp_path):
    def slow(rows):
        return rows.assign(time=np.floor(rows["time"] / 0.1) * 0.1)

    assert "multiples" not in said_of(tmp_path, slow, cycles={"R1": 0.1})


@pytest.mark.parametrize("later_s", [0.0, 5.0])
def test_a_recording_joined_with_a_later_copy_of_itself_is_named(tmp_path, later_s):
    def joined(rows):
        copy = rows.assign(time=rows["time"] + later_s)
        return pd.concat([rows, copy]) if later_s else rows

    said = said_of(tmp_path, joined)
    assert ("frames are equal to earlier ones" in said) == (later_s > 0.0)
