"""What is withdrawn was never there; what is old is counted, and takes room no more."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pandas as pd
import pytest
from maps import Listener
from measured import EDGE_S, contents, cut, measured, sample_pose

import gis_radar as gr
from gis_radar.dataset import read_hours
from gis_radar.dataset.hours import upkeep

MIDNIGHT = "Etc/GMT+8"  # the edge of the recordings' hours is midnight by these clocks
EVE, DAY = "2025-06-11", "2025-06-12"


def site_of(folder, *recordings):
    return measured(folder, *recordings, hits_only=True, timezone=MIDNIGHT)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Recordings by sensor and day, a second before and after midnight."""
    folder = tmp_path_factory.mktemp("days")
    return {
        (sensor, day): cut(folder / f"{sensor}-{day}.parquet", sensor, *span, edge_s=20.0)
        for sensor in ("R1", "R2")
        for day, span in ((EVE, (19.0, 20.0)), (DAY, (20.0, 21.0)))
    }


def pairs(files, *keys):
    return [(sensor, files[sensor, day]) for sensor, day in keys or files]


@pytest.fixture(scope="module")
def two_days(files, tmp_path_factory):
    """A dataset of all of them, which is only to be looked at or copied."""
    return site_of(tmp_path_factory.mktemp("two days") / "site", *pairs(files))


@pytest.mark.parametrize(
    ("what", "left"),
    [
        ({"sensor": "R1"}, [("R2", EVE), ("R2", DAY)]),
        ({"day": DAY}, [("R1", EVE), ("R2", EVE)]),
        ({"sensor": "R2", "day": EVE}, [("R1", EVE), ("R1", DAY), ("R2", DAY)]),
    ],
)
def test_what_is_withdrawn_was_never_there(files, two_days, tmp_path, what, left):
    site_of(tmp_path / "never", *pairs(files, *left))
    gone = gr.open_dataset(shutil.copytree(two_days.folder, tmp_path / "site")).withdraw(**what)
    assert sorted(gone) == sorted(str(files[key]) for key in files if key not in left)
    assert contents(tmp_path / "site") == contents(tmp_path / "never")


def test_a_sensor_with_vehicles_was_never_there(files, tmp_path):
    measured(tmp_path / "never", *pairs(files, ("R2", EVE), ("R2", DAY)))
    measured(tmp_path / "site", *pairs(files)).withdraw(sensor="R1")
    assert contents(tmp_path / "site") == contents(tmp_path / "never")


def test_a_recording_that_reaches_out_of_the_day_is_named(files, tmp_path):
    over = cut(tmp_path / "over.parquet", "R1", 16.0, 24.0, edge_s=20.0)
    dataset = site_of(tmp_path / "site", ("R1", over), *pairs(files, ("R2", DAY)))
    before = contents(tmp_path / "site")
    with pytest.raises(
        gr.InputError, match=r"over\.parquet: reaches from 2025-06-11 23:59:56-08:00 to 2025-06-12"
    ) as caught:
        dataset.withdraw(day=DAY)
    assert "by its name" in str(caught.value.hint)
    assert contents(tmp_path / "site") == before


def test_a_logger_that_is_late_at_midnight_does_not_move_a_recording(files, tmp_path):
    late = cut(tmp_path / "late.parquet", "R1", 12.0, 20.5, edge_s=20.0)
    dataset = site_of(tmp_path / "site", ("R1", late), *pairs(files, ("R2", DAY)))
    assert dataset.withdraw(day=DAY) == [str(files["R2", DAY])]
    assert dataset.withdraw(day=EVE) == [str(late)]


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ({"sensor": "R7"}, "has no recording of R7"),
        ({"day": "2025-06-13"}, "has no such recording of 2025-06-13"),
    ],
)
def test_what_there_is_not_is_said(two_days, what, said):
    with pytest.raises(gr.InputError, match=said):
        two_days.withdraw(**what)


@pytest.mark.parametrize(
    "what", [{}, {"recordings": ["a.parquet"], "sensor": "R1"}, {"day": "yesterday"}]
)
def test_a_withdrawal_that_says_too_little_or_too_much_is_refused(two_days, what):
    with pytest.raises(gr.UsageError):
        two_days.withdraw(**what)


def test_the_command_withdraws_and_says_what(run, files, two_days, tmp_path):
    shutil.copytree(two_days.folder, tmp_path / "site")
    code, out, _ = run(
        "dataset", tmp_path / "site", "--withdraw-sensor", "R1", "--withdraw-day", DAY
    )
    assert code == 0
    assert files["R1", DAY].name in out
    assert len(gr.open_dataset(tmp_path / "site").recordings()) == 3


def test_a_sensor_without_a_name_is_none(run, two_days):
    """As of an empty variable of a script: that nothing was withdrawn is said."""
    code, _, err = run("dataset", two_days.folder, "--withdraw-sensor", "")
    assert code == 3
    assert "its sensors are R1, R2" in err


EXACT = {table.name for table in upkeep.EXACT}
LATER_S = 2 * 3600.0  # of the second pair of recordings


@pytest.fixture(scope="module")
def four_hours(once, tmp_path_factory):
    """A dataset over two edges of hours, two hours apart; only to be looked at or copied."""

    def make(folder):
        pieces = [
            (sensor, cut(folder / f"{sensor}-{k}.parquet", sensor, 19.0, 21.0, edge_s=20.0 - shift))
            for sensor in ("R1", "R2")
            for k, shift in enumerate((0.0, LATER_S))
        ]
        measured(folder / "site", *pieces)
        return folder / "site"

    return once("four hours measured", make)


@pytest.fixture
def site(four_hours, tmp_path):
    return gr.open_dataset(shutil.copytree(four_hours, tmp_path / "site"))


def days_before(hours):
    """How long ago the edge of the recordings' hours was, and so many hours more, in days."""
    return (time.time() - EDGE_S - 3600.0 * hours) / 86_400.0


def files_of(dataset, names=EXACT):
    return [p for name in sorted(names) for p in sorted((dataset.folder / name).rglob("*.parquet"))]


def test_old_hours_lose_their_exact_tables_and_keep_their_counts(site):
    before = contents(site.folder)
    gone = site.keep(days_before(1.5))
    assert gone == ["2025-06-12T07:00Z"]  # that of 8 h is old too, and may go on in 9 h
    after = contents(site.folder)
    assert {name.split("/")[0] for name in before.keys() - after.keys()} == EXACT
    same = {name for name in after if not name.startswith("hours/2025-06-12/07")}
    assert {name: after[name] for name in same} == {name: before[name] for name in same}
    site.check()
    figures = site.figures()
    assert figures["hours_without_exact_tables"] == 1
    assert figures["exact_tables_from"] == "2025-06-12T08:00Z"
    assert site.keep(days_before(1.5)) == []
    assert contents(site.folder) == after
    assert len(site.keep(0.0)) == 3
    assert files_of(site) == []
    assert not (site.folder / "hits" / "date=2025-06-12").exists()


def test_what_counts_suffice_for_is_the_same_without_exact_tables(site, tmp_path):
    def asked():
        dataset = gr.open_dataset(site.folder)
        heat = gr.make_heatmap(dataset, interval="15min")
        return (
            heat.wide(), dataset.traffic(), dataset.turns(), dataset.passages(),
            dataset.tile_counts(), dataset.query("SELECT count(*) FROM passages"),
            gr.make_traffic(dataset, interval="15min").lanes,
        )  # fmt: skip

    before = asked()
    site.keep(0.0)
    for one, other in zip(before, asked(), strict=True):
        pd.testing.assert_frame_equal(pd.DataFrame(one), pd.DataFrame(other))


def test_what_needs_exact_tables_says_so(site, run, tmp_path):
    site.keep(0.0)
    for ask in (site.tracks, site.hits, site.frames, lambda: site.traffic("1min"),
                lambda: gr.make_heatmap(site, interval="1s"),
                lambda: gr.make_heatmap(site, at="2025-06-12 08:00:00.5Z"),
                lambda: gr.measure_quality(site)):  # fmt: skip
        with pytest.raises(gr.InputError) as caught:
            ask()
        assert "\n" not in caught.value.message
    code, out, err = run("query", site.folder, "SELECT count(*) AS n FROM tracks", "--json")
    assert code == 0
    assert '"n": 0' in out
    assert "tracks up to 2025-06-12T11:00Z were deleted" in out + err


def test_a_part_of_the_hours_is_still_asked_and_judged(site):
    every = site.query("SELECT * FROM tracks")
    site.keep(days_before(1.5))
    notes = Listener()
    left = site.query("SELECT * FROM tracks", reporter=notes)
    assert 0 < len(left) < len(every)
    assert any("up to 2025-06-12T08:00Z" in text for _, text in notes.messages)
    assert len(site.tracks(begin="2025-06-12 08:00")) == len(left)
    judged = gr.measure_quality(site, reporter=notes)
    assert judged.table["begin"].min() == pd.Timestamp("2025-06-12 08:00Z")
    assert any("are not judged" in text for _, text in notes.messages)


def test_a_kill_at_any_moment_leaves_a_whole_dataset(site, monkeypatch):
    left = set()
    counts = site.tile_counts()
    unlink, done = Path.unlink, 0

    class Killed(BaseException):
        pass

    for most in range(0, 40, 3):
        done = 0

        def stopping(path, *, missing_ok=False, most=most):
            nonlocal done
            if path.suffix == ".parquet":
                if done >= most:
                    raise Killed
                done += 1
            unlink(path, missing_ok=missing_ok)

        with monkeypatch.context() as patch:
            patch.setattr(Path, "unlink", stopping)
            try:
                site.keep(0.0)
            except Killed:
                pass
            else:
                break
        site.check()  # each part that its record has is there
        pd.testing.assert_frame_equal(gr.open_dataset(site.folder).tile_counts(), counts)
        left.add(len(files_of(site)))
    site.keep(0.0)
    assert len(left) > 3
    assert files_of(site) == []


def test_counts_are_made_before_and_damaged_ones_stop_it(site):
    day = site.folder / "tile_counts" / "date=2025-06-12" / "day.parquet"
    bytes_before = day.read_bytes()
    day.unlink()
    assert len(site.keep(0.0)) == 4
    assert day.read_bytes() == bytes_before
    day.unlink()
    with pytest.raises(gr.InputError, match="was deleted after the time to keep"):
        site.keep(0.0), site.tile_counts()


def test_nothing_is_deleted_where_a_part_to_count_is_damaged(site):
    (site.folder / "tile_counts" / "date=2025-06-12" / "day.parquet").unlink()
    part = site.folder / "observed" / "date=2025-06-12" / "07.parquet"
    part.write_bytes(part.read_bytes()[:-9])
    before = contents(site.folder)
    with pytest.raises(gr.InputError, match=r"07\.parquet"):
        site.keep(0.0)
    after = contents(site.folder)
    assert after.keys() - before.keys() <= {"tile_counts/date=2025-06-12/day.parquet"}
    assert all(after[name] == before[name] for name in before)


def test_hours_that_are_kept_as_counted_take_and_lose_nothing(site, tmp_path):
    recordings = site.recordings()["path"].tolist()
    site.keep(0.0)
    before = contents(site.folder)
    with pytest.raises(gr.InputError, match="stays as it was counted"):
        site.withdraw(sensor="R1")
    with pytest.raises(gr.InputError, match="stays as it was counted"):
        site.withdraw(recordings)
    other = cut(tmp_path / "other.parquet", "R1", 24.0, 25.0, edge_s=20.0)
    with pytest.raises(gr.InputError, match="takes no recordings any more"):
        measured(site.folder, ("R1", other))
    assert contents(site.folder) == before


def test_an_hour_that_waits_for_a_recording_keeps_what_it_needs(site, tmp_path):
    late = cut(tmp_path / "late.parquet", "R1", 22.0, 23.0, edge_s=20.0 - 3600.0)
    gr.measure(
        [late], [sample_pose("R1")], site.tiles(), site.folder / "map.osm", site.folder,
        check=False, before_hour=0,
    )  # fmt: skip
    gone = site.keep(0.0)
    assert "2025-06-12T08:00Z" not in gone  # the hour before one that is to be made
    assert {hour for hour, each in read_hours(site.folder).items() if not each.dropped}


def test_the_command_keeps_a_month(site, run):
    code, out, _ = run("dataset", site.folder, "--keep", "30d")
    assert code == 0
    assert "exact_tables_from" in out.replace(" ", "_").lower()
    assert files_of(site) == []


@pytest.mark.parametrize("days", [-1.0, float("nan"), float("inf")])
def test_a_time_to_keep_that_is_none_is_refused(site, days):
    with pytest.raises(gr.UsageError):
        site.keep(days)


def test_counts_that_were_kept_stay_where_their_recordings_are_listed_no_more(files, tmp_path):
    early = cut(tmp_path / "early.parquet", "R1", 2.0, 6.0, edge_s=20.0)
    late = ("R1", files["R1", DAY])
    site = site_of(tmp_path / "site", ("R1", early), late)
    before = site.tile_counts()
    site.keep(0.0)
    left = measured(tmp_path / "site", late, hits_only=True, timezone=MIDNIGHT, only=True)
    assert len(left.recordings()) == 1
    pd.testing.assert_frame_equal(left.tile_counts(), before)


def test_a_recording_that_comes_too_late_for_its_hour_is_not_registered(files, tmp_path):
    site = site_of(tmp_path / "site", ("R1", files["R1", DAY]))
    site.keep(0.0)
    before = contents(tmp_path / "site")
    late = ("R2", files["R2", DAY])
    with pytest.raises(gr.InputError, match=r"R2-2025-06-12\.parquet: .* takes no recordings any"):
        measured(tmp_path / "site", late, hits_only=True, timezone=MIDNIGHT, before_hour=0)
    assert contents(tmp_path / "site") == before


def test_what_a_killed_run_withdrew_is_completed(files, two_days, tmp_path, monkeypatch):
    """The next run finds the recording gone already, and makes the hours that were left."""
    site_of(tmp_path / "never", *pairs(files, ("R1", EVE), ("R2", EVE), ("R2", DAY)))
    dataset = gr.open_dataset(shutil.copytree(two_days.folder, tmp_path / "site"))

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("gis_radar.dataset.hours.registered.make_hour", killed)
        with pytest.raises(KeyboardInterrupt):
            dataset.withdraw([files["R1", DAY]])
    assert contents(tmp_path / "site") != contents(tmp_path / "never")
    with pytest.raises(gr.InputError, match="has no recording"):
        dataset.withdraw([files["R1", DAY]])
    assert contents(tmp_path / "site") == contents(tmp_path / "never")


@pytest.mark.parametrize("at", ["_remove_parts", "_update_tables"])
@pytest.mark.parametrize("what", ["recordings", "day"])
def test_nothing_of_what_a_killed_run_withdrew_is_left(
    files, two_days, tmp_path, monkeypatch, what, at
):
    """Neither tables of its hours, nor sums of its day: its recording and records are gone."""
    site_of(tmp_path / "never", *pairs(files, ("R1", EVE), ("R2", EVE)))
    dataset = gr.open_dataset(shutil.copytree(two_days.folder, tmp_path / "site"))
    named = [path for (_, day), path in files.items() if day == DAY]
    wanted = {"recordings": named} if what == "recordings" else {"day": DAY}

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(f"gis_radar.dataset.hours.making.{at}", killed)
        dataset.withdraw(**wanted)
    with pytest.raises(gr.InputError, match="has no "):
        dataset.withdraw(**wanted)
    assert contents(tmp_path / "site") == contents(tmp_path / "never")


def test_hours_of_what_a_killed_run_withdrew_are_removed(files, two_days, tmp_path, monkeypatch):
    """No recording reaches into them any more, so that none of them is missing."""
    dataset = gr.open_dataset(shutil.copytree(two_days.folder, tmp_path / "site"))

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("gis_radar.dataset.hours.making.remove_record", killed)
        dataset.withdraw(list(files.values()))
    assert read_hours(dataset.folder)
    with pytest.raises(gr.InputError, match="has no recording"):
        dataset.withdraw([files["R1", DAY]])
    assert not read_hours(dataset.folder)
