"""The rate of a sensor's clock against the recorder's: a slow clock is a rate, not steps."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import Listener
from radars import START, frame_times
from test_formats_order import LATER, capture, convert

from gis_radar.base import InputError
from gis_radar.recordings import Frame
from gis_radar.recordings.frame_clock import FrameClock

EMPTY = np.empty((0, 3), dtype=np.float32)


def frames_at(true, ahead_s, arrival_s, stamp="sensor"):
    """Frames of a sensor whose clock is ahead by some seconds at each true time."""
    none = np.empty(0, dtype=np.float32)
    return [
        Frame(
            sensor="R1", points=EMPTY, range_rate=none, rcs=none, sensor_time=t + o, stamp=stamp,
            recorder_time=t + a,
        )
        for t, o, a in zip(true, ahead_s, arrival_s, strict=True)
    ]  # fmt: skip


def jitter(count, seed=0, size=0.009):
    return LATER + np.random.default_rng(seed).uniform(-size, size, count)


def times_given(frames, clock="auto"):
    notes = Listener()
    chosen = FrameClock("R1", clock, notes)
    timed = [pair for frame in frames for pair in chosen.feed(frame)]
    timed += chosen.finish()
    return np.array([time for time, _ in timed]), chosen.used, notes.text


def every(count, cycle_s=0.05):
    return START + np.arange(count) * cycle_s


@pytest.mark.parametrize("rate", [-0.01, -0.008, 0.008, 0.01])
@pytest.mark.parametrize("cycle_s", [0.05, 0.073])
def test_a_slow_clock_is_a_rate(rate, cycle_s):
    true = every(1000, cycle_s)
    frames = frames_at(true, rate * (true - START), jitter(1000))
    found, used, text = times_given(frames)
    assert used == ["sensor at the recorder's rate"]
    side = "fast" if rate > 0 else "slow"
    stated = re.search(rf"R1: the sensor's clock runs (\d\.\d+) % {side}", text.replace("%", " %"))
    assert abs(float(stated[1]) - 100 * abs(rate)) < 0.1
    # The recorder's times, without their jitter of 5 ms.
    np.testing.assert_allclose(found, true + LATER, atol=0.004)
    assert np.std(np.diff(found) - cycle_s) < 0.0006
    assert np.diff(found).min() > 0.9 * cycle_s


def test_it_stays_a_rate_beyond_the_seconds_that_clocks_may_differ():
    true = every(2400, 0.5)  # 20 minutes: 9.6 s
    found, used, _ = times_given(frames_at(true, -0.008 * (true - START), jitter(2400)))
    assert used == ["sensor at the recorder's rate"]
    np.testing.assert_allclose(found, true + LATER, atol=0.006)


def test_a_pause_is_no_step():
    true = every(1000) + 100.0 * (np.arange(1000) >= 600)  # the offset grows by 0.8 s in it
    found, used, _ = times_given(frames_at(true, 0.008 * (true - START), jitter(1000)))
    assert used == ["sensor at the recorder's rate"]
    np.testing.assert_allclose(found, true + LATER, atol=0.03)


def test_a_step_of_a_slow_clock_is_left_from_there_on():
    true = every(1000)
    ahead = -0.008 * (true - START) - 3.0 * (np.arange(1000) >= 700)
    found, used, text = times_given(frames_at(true, ahead, jitter(1000)))
    assert used == ["sensor at the recorder's rate", "recorder"]
    assert "jumped by -3.0" in text
    np.testing.assert_allclose(found, true + LATER, atol=0.01)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 1000), ppm=st.floats(-500, 500), late_s=st.floats(-2.0, 2.0),
    count=st.integers(1, 500),
)  # fmt: skip
def test_a_clock_that_is_right_is_not_touched(seed, ppm, late_s, count):
    true = every(count)
    ahead = ppm * 1e-6 * (true - START) + late_s
    found, used, text = times_given(frames_at(true, ahead, jitter(count, seed)))
    assert used == ["sensor"]
    assert text == ""
    np.testing.assert_array_equal(found, true + ahead)


@pytest.mark.parametrize("begin", [30, 60, 100, 150, 185])
def test_a_busy_recorder_is_no_rate(begin):
    true = every(400)
    waits = np.where(np.arange(400) >= begin, 1.0 - 0.05 * (np.arange(400) - begin), 0.0)
    frames = frames_at(true, np.zeros(400), jitter(400) + np.maximum(waits, 0.0))
    assert times_given(frames)[1] == ["sensor"]


@pytest.mark.parametrize("rate", [-0.5, -0.05, 0.05, 1.0])
def test_a_replay_is_refused_unless_a_clock_is_named(rate):
    true = every(300)
    frames = frames_at(true, rate * (true - START), jitter(300))
    with pytest.raises(InputError, match=r"the sensor's clock runs .* against the recorder's"):
        times_given(frames)
    assert times_given(frames, "sensor")[1] == ["sensor"]
    assert times_given(frames, "recorder")[1] == ["recorder"]


def test_a_capture_of_a_slow_clock(tmp_path):
    true, late = every(240), jitter(240)
    stamped = [
        (START + 0.992 * (t - START), t + wait, 1) for t, wait in zip(true, late, strict=True)
    ]
    result, text = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.figures()["clock"] == ["sensor at the recorder's rate"]
    assert "slow against the recorder's" in text
    np.testing.assert_allclose(frame_times(result.outputs[0]), true + LATER, atol=0.004)
