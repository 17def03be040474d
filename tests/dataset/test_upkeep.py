"""What is withdrawn was never there."""

from __future__ import annotations

import pytest
from measured import contents, cut, measured

import gis_radar as gr

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


@pytest.mark.parametrize(
    ("what", "left"),
    [
        ({"sensor": "R1"}, [("R2", EVE), ("R2", DAY)]),
        ({"day": DAY}, [("R1", EVE), ("R2", EVE)]),
        ({"sensor": "R2", "day": EVE}, [("R1", EVE), ("R1", DAY), ("R2", DAY)]),
    ],
)
def test_what_is_withdrawn_was_never_there(files, tmp_path, what, left):
    site_of(tmp_path / "never", *pairs(files, *left))
    dataset = site_of(tmp_path / "site", *pairs(files))
    gone = dataset.withdraw(**what)
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
def test_what_there_is_not_is_said(files, tmp_path, what, said):
    dataset = site_of(tmp_path / "site", *pairs(files, ("R1", DAY)))
    with pytest.raises(gr.InputError, match=said):
        dataset.withdraw(**what)


@pytest.mark.parametrize(
    "what", [{}, {"recordings": ["a.parquet"], "sensor": "R1"}, {"day": "yesterday"}]
)
def test_a_withdrawal_that_says_too_little_or_too_much_is_refused(files, tmp_path, what):
    dataset = site_of(tmp_path / "site", *pairs(files, ("R1", DAY)))
    with pytest.raises(gr.UsageError):
        dataset.withdraw(**what)


def test_the_command_withdraws_and_says_what(run, files, tmp_path):
    site_of(tmp_path / "site", *pairs(files))
    code, out, _ = run(
        "dataset", tmp_path / "site", "--withdraw-sensor", "R1", "--withdraw-day", DAY
    )
    assert code == 0
    assert files["R1", DAY].name in out
    assert len(gr.open_dataset(tmp_path / "site").recordings()) == 3
