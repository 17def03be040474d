"""A frame is valid up to its sensor's next one, at most its validity: against plain sets."""

import numpy as np
import pytest
from datasets import measured as measured_by
from hypothesis import given
from hypothesis import strategies as st
from maps import Listener
from sites import START, crossing, pose, recording

from gis_radar.base import UsageError
from gis_radar.measures import valid_steps, validity_of
from gis_radar.measures.hour_hits import valid_until
from gis_radar.products import make_heatmap

ON_TILE_4 = [12.25, 0.0, -5.0]
FIRST_STEP = int(START * 20)
STAGGERED_US = np.array([41_300, 51_500, 57_200])  # a recorded ARS548
SENSORS = ("R1", "R2")


times_us = st.lists(st.integers(50_000, 400_000), min_size=1, max_size=20).map(
    lambda gaps: round(START * 1e6) + np.cumsum(gaps)
)


@given(times_us=times_us, valid_ms=st.integers(0, 400))
def test_no_frame_is_valid_in_a_step_that_begins_later(times_us, valid_ms):
    """The words of the rule, with times: exact for whole steps of validity, else never longer."""
    own = times_us // 50_000
    until = valid_until(own, valid_steps(valid_ms / 1000))
    for time, step, last, following in zip(times_us, own, until, [*own[1:], None], strict=True):
        spoken = step
        while (spoken + 1) * 50_000 <= time + valid_ms * 1000 and spoken + 1 != following:
            spoken += 1
        assert step <= last <= spoken
        assert last == spoken or valid_ms % 50


def test_no_clock_phase_loses_a_step_of_a_staggered_cycle():
    """Each tenth of a millisecond; without it up to a third of the steps is lost."""
    lost = []
    for phase_us in range(0, 150_000, 100):
        for turn in range(3):
            gaps = np.tile(np.roll(STAGGERED_US, turn), 40)
            steps = np.unique((phase_us + np.cumsum(gaps)) // 50_000)
            until = valid_until(steps, valid_steps(0.1))
            assert (until[:-1] + 1 == steps[1:]).all()
            lost.append(1.0 - len(steps) / (steps[-1] - steps[0] + 1))
    assert 0.30 < max(lost) < 0.35


def measured(tmp_path, name="a", *, frames=range(40), cycle_s=0.1, **options):
    """Measure a radar before a standing vehicle, from the numbers of its frames."""
    time = START + 0.02 + np.array(frames) * cycle_s
    path = recording(tmp_path / f"{name}.parquet", time, [ON_TILE_4] * len(time))
    return measured_by([path], [pose()], crossing(), tmp_path / name, **options)


def test_time_without_frames_is_not_observed(tmp_path):
    """At 10 Hz, three frames lost: of the 300 ms until the next one the first 50 ms are valid."""
    found = measured(tmp_path, frames=[k for k in range(40) if k not in (10, 11, 12)])
    valid = found.frame_steps()
    gap = {FIRST_STEP + k for k in range(21, 26)}
    steps = {
        step
        for first, last in zip(valid.first, valid.last, strict=True)
        for step in range(first, last + 1)
    }
    assert steps == {FIRST_STEP + k for k in range(81)} - gap
    row = make_heatmap(found).wide().iloc[4]
    assert (row["observed_s"], row["hit_s"]) == (76 / 20, 76 / 20)


def test_a_slow_radar_is_valid_by_its_stated_cycle(tmp_path):
    """At 4 Hz 100 ms leave two of five steps empty, which a warning tells; the cycle mends it."""
    notes = Listener()
    found = measured(tmp_path, cycle_s=0.25, reporter=notes)
    row = make_heatmap(found).wide().iloc[4]
    assert row["observed_s"] == pytest.approx(40 * 3 / 20)
    assert any("--cycle R1=250ms" in line and "40 %" in line for _, line in notes.messages)
    notes = Listener()
    found = measured(tmp_path, "b", cycle_s=0.25, cycles={"R1": 0.25}, reporter=notes)
    row = make_heatmap(found).wide().iloc[4]
    assert (row["observed_s"], row["hit_share"]) == ((39 * 5 + 8) / 20, 1.0)
    assert found.recordings()["validity_s"].tolist() == [0.375]
    assert not any("delivers every" in line for _, line in notes.messages)


def test_a_stated_cycle_far_longer_than_that_of_the_frames_is_told(tmp_path):
    notes = Listener()
    measured(tmp_path, cycle_s=0.05, cycles={"R1": 1.0}, reporter=notes)
    told = "R1 delivers every 50 ms, but its cycle is given as 1000 ms: up to 1500 ms without"
    assert any(told in line for _, line in notes.messages)


@pytest.mark.parametrize("cycle_s", [0.05, 0.057, 0.066, 0.1, 0.15])
def test_radars_of_usual_cycles_need_no_statement(tmp_path, cycle_s):
    notes = Listener()
    found = measured(tmp_path, cycle_s=cycle_s, reporter=notes)
    row = make_heatmap(found).wide().iloc[4]
    valid = found.frame_steps()
    assert (row["observed_s"], row["hit_share"]) == (valid.steps / 20, 1.0)
    assert len(valid) == 1
    assert not any("delivers every" in line for _, line in notes.messages)


def test_a_cycle_sets_validity_and_nothing_else_does():
    assert validity_of(None, SENSORS) == {"R1": 0.1, "R2": 0.1}
    assert validity_of({"R2": 0.057}, SENSORS) == {"R1": 0.1, "R2": 0.0855}
    assert [valid_steps(validity_s) for validity_s in (0.0, 0.0499, 0.05, 0.0855, 0.1, 0.3)] == [
        0, 0, 1, 1, 2, 6,
    ]  # fmt: skip


@pytest.mark.parametrize("cycles", [{"R9": 0.1}, {"R1": 0.0}, {"R1": 3.0}, {"R1": np.nan}, "auto"])
def test_cycles_that_make_no_sense(tmp_path, cycles):
    with pytest.raises(UsageError, match="cycle"):
        measured(tmp_path, cycles=cycles)
    assert not (tmp_path / "a").exists()


def test_a_clock_that_is_set_on_the_way_is_a_cause_of_missing_frames(tmp_path):
    notes = Listener()
    measured(tmp_path, frames=[*range(40), *range(36_040, 36_080)], reporter=notes)
    told = "a.parquet: its frames fill 8 of 3,608 s: the others are missing, or the clock of R1 was"
    assert any(told in line for _, line in notes.messages)
