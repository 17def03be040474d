"""A frame covers the steps up to its sensor's next one, at most `hold`: against plain sets."""

import json
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sites import START, crossing, pose, recording
from test_occupancy import FIRST_STEP, Notes, pairs_of, steps_of

from gis_radar.errors import InputError, UsageError
from gis_radar.heatmap import make_heatmap
from gis_radar.occupancy import Occupancy, measure_occupancy, merge_occupancies, read_occupancy
from gis_radar.occupancy.folder import frames_table, views_table
from gis_radar.occupancy.frame_steps import Runs, covered_until, holds_of, steps_held, union
from gis_radar.occupancy.hits import merge_rows

ON_TILE_4 = [12.25, 0.0, -5.0]
STAGGERED_US = np.array([41_300, 51_500, 57_200])  # a recorded ARS548
SENSORS = ("R1", "R2")

# A frame: sensor, step, view, tiles hit. Two sensors, close enough to leave gaps of all lengths.
frames = st.lists(
    st.tuples(
        st.sampled_from(SENSORS), st.integers(0, 40), st.sampled_from("ab"),
        st.frozensets(st.integers(0, 5), max_size=3),
    ),
    min_size=1, max_size=40,
)  # fmt: skip
holds = st.fixed_dictionaries(dict.fromkeys(SENSORS, st.sampled_from([0.0, 0.06, 0.1, 0.225])))


def occupancy_of(found, hold_s, *, size=5, tiles=None):
    """Make an occupancy of frames, without measuring; its hits come in pieces."""
    tiles = tiles or {"a": np.arange(4), "b": np.arange(2, 6)}
    rows = [(sensor, view, FIRST_STEP + step, FIRST_STEP + step) for sensor, step, view, _ in found]
    table = frames_table(pd.DataFrame(rows, columns=["sensor", "view", "first_step", "last_step"]))
    rows = sorted({(FIRST_STEP + s, tile, name) for name, s, _, hit in found for tile in hit})

    def hits(names):
        for low in range(0, len(rows), size):
            step, tile, sensor = zip(*rows[low : low + size], strict=True)
            yield np.array(step), np.array(tile), np.array([names.index(each) for each in sensor])

    return Occupancy(
        fingerprint="x", frames=table, views=views_table(table, tiles), hits_by_sensor=hits,
        sources=[], hold_s=hold_s,
    )  # fmt: skip


def covers(step, delivered, hold_s):
    """Return the steps that a frame covers, step by step from the words of the rule."""
    steps = [step]
    while steps[-1] + 1 not in delivered and (steps[-1] + 1 - step) * 50 <= round(1000 * hold_s):
        steps.append(steps[-1] + 1)
    return steps


def held(found, hold_s):
    """Return covered (sensor, view, step) and held (step, tile), frame by frame."""
    steps = {name: {step for sensor, step, *_ in found if sensor == name} for name in SENSORS}
    end = max(step for _, step, *_ in found)
    covered, hits = set(), set()
    for sensor, step, view, hit in found:
        for each in covers(step, steps[sensor], hold_s[sensor]):
            covered |= {(sensor, view, FIRST_STEP + each)} if each <= end else set()
            hits |= {(FIRST_STEP + each, tile) for tile in hit}
    return covered, hits


def flat(pieces):
    """Return the pairs in pieces of hits; check that they ascend and split no step."""
    pieces = [(step.tolist(), tile.tolist()) for step, tile in pieces if len(step)]
    assert all(one[0][-1] < other[0][0] for one, other in pairwise(pieces))
    pairs = [pair for step, tile in pieces for pair in zip(step, tile, strict=True)]
    assert pairs == sorted(set(pairs))
    return set(pairs)


def covered_of(occupancy):
    return {
        (row.sensor, row.view, step)
        for row in occupancy.covered_frames().itertuples()
        for step in range(row.first_step, row.last_step + 1)
    }


@settings(deadline=None)
@given(found=frames, hold_s=holds, size=st.integers(1, 9))
def test_holding_is_that_of_a_plain_loop(found, hold_s, size):
    occupancy = occupancy_of(found, hold_s, size=size)
    covered, hits = held(found, hold_s)
    assert covered_of(occupancy) == covered
    assert flat(occupancy.held_hits()) == hits
    own = {(FIRST_STEP + step, tile) for _, step, _, hit in found for tile in hit}
    assert flat(occupancy.hits()) == own


@settings(deadline=None, max_examples=50)
@given(found=frames, hold_s=holds, data=st.data())
def test_held_after_merging_any_parts_are_those_of_the_whole(found, hold_s, data):
    """A sensor's next frame may stand in another part: only the whole tells what is covered."""
    part_of = data.draw(st.lists(st.integers(0, 2), min_size=len(found), max_size=len(found)))
    parts = [
        [each for each, number in zip(found, part_of, strict=True) if number == part]
        for part in data.draw(st.permutations(range(3)))
    ]
    merged = merge_occupancies([occupancy_of(part, hold_s) for part in parts if part])
    whole = occupancy_of(found, hold_s)
    pd.testing.assert_frame_equal(merged.frames, whole.frames)
    assert covered_of(merged) == covered_of(whole)
    assert flat(merged.held_hits()) == flat(whole.held_hits())


times_us = st.lists(st.integers(50_000, 400_000), min_size=1, max_size=20).map(
    lambda gaps: round(START * 1e6) + np.cumsum(gaps)
)


@given(times_us=times_us, hold_ms=st.integers(0, 400))
def test_no_frame_covers_a_step_that_begins_later_than_hold(times_us, hold_ms):
    """The words of the rule, with times: exact for whole steps of hold, else never longer."""
    own = times_us // 50_000
    until = covered_until(own, union([Runs(first=own, last=own)]), hold_ms / 1000)
    for time, step, last, following in zip(times_us, own, until, [*own[1:], None], strict=True):
        spoken = step
        while (spoken + 1) * 50_000 <= time + hold_ms * 1000 and spoken + 1 != following:
            spoken += 1
        assert step <= last <= spoken
        assert last == spoken or hold_ms % 50


def test_no_clock_phase_loses_a_step_of_a_staggered_cycle():
    """Each tenth of a millisecond; without holding up to a third of the steps is lost."""
    lost = []
    for phase_us in range(0, 150_000, 100):
        for turn in range(3):
            gaps = np.tile(np.roll(STAGGERED_US, turn), 40)
            steps = np.unique((phase_us + np.cumsum(gaps)) // 50_000)
            until = covered_until(steps, union([Runs(first=steps, last=steps)]), 0.1)
            assert (until[:-1] + 1 == steps[1:]).all()
            lost.append(1.0 - len(steps) / (steps[-1] - steps[0] + 1))
    assert 0.30 < max(lost) < 0.35


@pytest.mark.parametrize("phase_ms", [0.0, 7.3, 8.7, 21.1, 41.25, 49.9])
@pytest.mark.parametrize("cut", [None, 50, 51])
def test_a_standing_vehicle_under_a_staggered_cycle_is_all_of_the_time(tmp_path, phase_ms, cut):
    """One hit a frame: observed and occupied throughout, also where a file ends in between."""
    time = START + (phase_ms * 1000 + np.cumsum(np.tile(STAGGERED_US, 40))) / 1e6
    parts = [
        measure_occupancy(
            [recording(tmp_path / f"{i}.parquet", some, [ON_TILE_4] * len(some))],
            [pose()], crossing(), tmp_path / f"occ{i}",
        )
        for i, some in enumerate([time] if cut is None else [time[:cut], time[cut:]])
    ]  # fmt: skip
    row = make_heatmap(merge_occupancies(parts), crossing()).wide().iloc[4]
    first, last = np.floor(time[[0, -1]] * 1e6 / 50_000 + 1e-9)
    assert row["observed_s"] == (last - first + 1) / 20
    assert row["occupancy"] == 1.0


def measured(tmp_path, name="a", *, frames=range(40), cycle_s=0.1, **options):
    """Measure a radar before a standing vehicle, from the numbers of its frames."""
    time = START + 0.02 + np.array(frames) * cycle_s
    path = recording(tmp_path / f"{name}.parquet", time, [ON_TILE_4] * len(time))
    return measure_occupancy([path], [pose()], crossing(), tmp_path / name, **options)


def test_time_without_frames_is_not_observed(tmp_path):
    """At 10 Hz, three frames lost: of the 300 ms until the next one the first 50 ms are held."""
    occupancy = measured(tmp_path, frames=[k for k in range(40) if k not in (10, 11, 12)])
    gap = {FIRST_STEP + k for k in range(21, 26)}
    covered = {step for *_, step in covered_of(occupancy)}
    assert covered == {FIRST_STEP + k for k in range(79)} - gap
    assert {step for step, _ in flat(occupancy.held_hits())} - {
        FIRST_STEP + 79,
        FIRST_STEP + 80,
    } == covered
    row = make_heatmap(occupancy, crossing()).wide().iloc[4]
    assert (row["observed_s"], row["occupied_s"]) == (74 / 20, 74 / 20)


def test_a_folder_holds_frames_and_hits_in_their_own_step(tmp_path):
    occupancy = measured(tmp_path, pairs=True)
    own = [(FIRST_STEP + 2 * k, 4) for k in range(40)]
    assert pairs_of(occupancy) == own
    assert {step for _, step in steps_of(occupancy.frames)} == {step for step, _ in own}
    table = pd.read_parquet(tmp_path / "a" / "hits.parquet")
    assert list(table.itertuples(index=False, name=None)) == own
    manifest = json.loads((tmp_path / "a" / "manifest.json").read_text())
    assert (manifest["rules"], manifest["hold_s"]) == (2, {"R1": 0.1})
    measured(tmp_path)
    assert not (tmp_path / "a" / "hits.parquet").exists()


def test_a_slow_radar_holds_by_its_stated_cycle(tmp_path):
    """At 4 Hz 100 ms leave two of five steps empty, which a warning tells; the cycle mends it."""
    notes = Notes()
    occupancy = measured(tmp_path, cycle_s=0.25, reporter=notes)
    row = make_heatmap(occupancy, crossing()).wide().iloc[4]
    assert row["observed_s"] == pytest.approx((39 * 3 + 1) / 20)
    assert any("--cycle R1=250ms" in line and "40 %" in line for _, line in notes.lines)
    notes = Notes()
    occupancy = measured(tmp_path, "b", cycle_s=0.25, cycles={"R1": 0.25}, reporter=notes)
    row = make_heatmap(occupancy, crossing()).wide().iloc[4]
    assert (row["observed_s"], row["occupancy"]) == ((39 * 5 + 1) / 20, 1.0)
    assert occupancy.hold_s == {"R1": 0.375}
    assert not any("delivers every" in line for _, line in notes.lines)


@pytest.mark.parametrize("cycle_s", [0.05, 0.057, 0.066, 0.1, 0.15])
def test_radars_of_usual_cycles_need_no_statement(tmp_path, cycle_s):
    notes = Notes()
    occupancy = measured(tmp_path, cycle_s=cycle_s, reporter=notes)
    row = make_heatmap(occupancy, crossing()).wide().iloc[4]
    first, last = occupancy.frames["first_step"].min(), occupancy.frames["last_step"].max()
    assert (row["observed_s"], row["occupancy"]) == ((last - first + 1) / 20, 1.0)
    assert not any("delivers every" in line for _, line in notes.lines)


def test_a_cycle_sets_hold_and_nothing_else_does():
    assert holds_of(None, SENSORS) == {"R1": 0.1, "R2": 0.1}
    assert holds_of({"R2": 0.057}, SENSORS) == {"R1": 0.1, "R2": 0.0855}
    assert [steps_held(hold_s) for hold_s in (0.0, 0.0499, 0.05, 0.0855, 0.1, 0.3)] == [
        0, 0, 1, 1, 2, 6,
    ]  # fmt: skip


@pytest.mark.parametrize("cycles", [{"R9": 0.1}, {"R1": 0.0}, {"R1": 3.0}, {"R1": np.nan}, "auto"])
def test_cycles_that_make_no_sense(tmp_path, cycles):
    with pytest.raises(UsageError, match="cycle"):
        measured(tmp_path, cycles=cycles)
    assert not (tmp_path / "a").exists()


def test_parts_of_a_sensor_hold_alike_or_do_not_merge(tmp_path):
    one, other = measured(tmp_path), measured(tmp_path, "b", cycles={"R1": 0.15})
    with pytest.raises(InputError, match=r"b: frames of R1 hold 225 ms, in .*a 100 ms"):
        merge_occupancies([one, other])
    two_sensors = [
        occupancy_of([(name, 0, "a", {1})], {name: hold_s})
        for name, hold_s in (("R1", 0.1), ("R2", 0.225))
    ]
    assert merge_occupancies(two_sensors).hold_s == {"R1": 0.1, "R2": 0.225}


def older(tmp_path, name):
    """Turn a folder into one of version 0.1: pairs, no rules, no hold."""
    folder = measured(tmp_path, name, pairs=True).place
    (tmp_path / name / "hits_by_sensor.parquet").unlink()
    path = tmp_path / name / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["rules"], manifest["hold_s"]
    path.write_text(json.dumps(manifest))
    return folder


def test_folders_of_older_rules_are_read_and_named(tmp_path):
    """They count as they did: a frame covers its own step."""
    notes = Notes()
    parts = [read_occupancy(older(tmp_path, name), reporter=notes) for name in "ab"]
    assert [level for level, _ in notes.lines] == ["warning", "warning"]
    assert "a: follows rules 1, not 2" in notes.lines[0][1]
    merged = merge_occupancies(parts)
    row = make_heatmap(merged, crossing()).wide().iloc[4]
    assert (row["observed_s"], row["occupied_s"]) == (2.0, 2.0)
    with pytest.raises(InputError, match="follows rules 1"):
        merged.write(tmp_path / "again")
    new = measured(tmp_path, "new")
    with pytest.raises(InputError, match=r"a: follows rules 1, .*new rules 2: they do not merge"):
        merge_occupancies([new, parts[0]])


@pytest.mark.parametrize("rules", [0, 3, "x", None])
def test_unknown_rules_are_refused(tmp_path, rules):
    measured(tmp_path)
    path = tmp_path / "a" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"rules": rules}))
    with pytest.raises(InputError, match=r"a: follows rules|manifest\.json: damaged"):
        read_occupancy(tmp_path / "a")


@settings(deadline=None)
@given(
    streams=st.lists(
        st.lists(st.tuples(*(st.integers(0, 9),) * 3), max_size=30).map(sorted), max_size=4
    ),
    huge=st.booleans(),
)
def test_rows_of_three_columns_merge_like_sets(streams, huge):
    """Also where a row is too large for one int64."""
    scale = 1 << 40 if huge else 1

    def pieces(rows):
        for low in range(0, len(rows), 4):
            yield tuple(np.array(rows[low : low + 4], np.int64).T * [[1], [scale], [scale]])

    merged = [
        tuple(row)
        for piece in merge_rows([pieces(rows) for rows in streams], 3)
        for row in np.transpose(piece).tolist()
    ]
    known = {(a, b * scale, c * scale) for rows in streams for a, b, c in rows}
    assert merged == sorted(known)
