"""Recordings in other units are refused in one line that names the unit."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import Listener
from radars import START
from sites import EAST, NORTH, recording

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.cli import main
from gis_radar.recordings import open_recording
from gis_radar.recordings.units import refuse_degrees, refuse_positions_in_other_units


def scene(count=400, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(5, 90, count), rng.uniform(-30, 30, count), rng.uniform(-5, -4, count)]
    )


def written(path, points):
    return recording(path, START + 0.05 * (np.arange(len(points)) // 8), points)


CASES = {
    "millimetres": lambda metres: metres * 1000.0,
    "centimetres": lambda metres: metres * 100.0,
    "degrees": lambda metres: metres * 1e-5 + [11.4, 48.77, 0.0],
    "places in a map": lambda metres: metres + [EAST, 403_600.0, 370.0],
}


@pytest.mark.parametrize("unit", CASES)
def test_another_unit_is_named(tmp_path, unit):
    path = written(tmp_path / "r.parquet", CASES[unit](scene()))
    with pytest.raises(InputError, match=rf"r\.parquet: .*it looks like {unit}"):
        list(open_recording(path).read())
    with pytest.raises(InputError, match=rf"it looks like {unit}"):
        gr.convert(path, tmp_path / "out.parquet")
    assert not (tmp_path / "out.parquet").exists()


def test_a_map_place_over_1000_km_is_refused_as_before(tmp_path):
    path = written(tmp_path / "r.parquet", scene() + [EAST, NORTH, 0.0])
    with pytest.raises(InputError, match="over 1000 km from the sensor"):
        list(open_recording(path).read())


@settings(max_examples=50)
@given(
    reach_m=st.floats(2.0, 1500.0), seed=st.integers(0, 100), ghosts=st.integers(0, 100),
    count=st.integers(1, 500),
)  # fmt: skip
def test_no_recording_in_metres_is_refused(reach_m, seed, ghosts, count):
    rng = np.random.default_rng(seed)
    bearing, away = rng.uniform(-1, 1, count), rng.uniform(0.5, reach_m, count)
    points = np.column_stack([away * np.cos(bearing), away * np.sin(bearing), np.zeros(count)])
    far = np.tile([40_000.0, 0.0, 0.0], (min(ghosts, count // 3), 1))
    refuse_positions_in_other_units(np.vstack([points, far]), "r")


def test_one_still_target_is_not_refused():
    points = np.tile([20.0, 3.0, -4.0], (500, 1))
    refuse_positions_in_other_units(points, "r")
    rng = np.random.default_rng(1)  # as recorded: 0.01 m in range, 0.05 deg in azimuth
    refuse_positions_in_other_units(points + rng.normal(0.0, 0.01, points.shape), "r")


@pytest.mark.parametrize("angle", ["azimuth", "elevation"])
def test_angles_in_degrees_are_refused_with_the_way_out(tmp_path, angle):
    other = "elevation" if angle == "azimuth" else "azimuth"
    lines = [f"time,range,{angle},{other},v"]
    most = {"azimuth": 50, "elevation": 5}[angle]  # hardly any target is steep
    values = most * np.array([-1.0, 0.8, 0.4, 0.2, -0.6, 0.24])
    lines += [f"{START},20,{value},0.1,1.5" for value in values]
    (tmp_path / "r.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=f"{angle}: .*it looks like degrees") as caught:
        gr.convert(tmp_path / "r.csv", tmp_path / "r.parquet")
    named = re.search(r"--columns (\w+)=(\w+)", caught.value.hint)
    assert (named[1], named[2]) == (f"{angle}_deg", angle)
    gr.convert(tmp_path / "r.csv", tmp_path / "r.parquet", columns={named[1]: named[2]})


@pytest.mark.parametrize("most_deg", [1.5, 4.0])
def test_small_angles_in_degrees_are_refused(tmp_path, most_deg):
    """Most elevations of a radar on a mast are under 1.57 degrees, but not all."""
    values = np.linspace(-most_deg, 3.0, 200)
    lines = [f"{START},20,0.1,{value},1.5" for value in values]
    (tmp_path / "r.csv").write_text("\n".join(["time,range,azimuth,elevation,v", *lines]))
    with pytest.raises(InputError, match=r"elevation: .*it looks like degrees"):
        gr.convert(tmp_path / "r.csv", tmp_path / "r.parquet")


def test_azimuths_in_radians_that_are_called_degrees_are_refused(tmp_path):
    lines = [f"{START},20,{value},0.1,1.5" for value in np.linspace(-1.0, 1.0, 200)]
    (tmp_path / "r.csv").write_text("\n".join(["time,range,azimuth_deg,elevation,v", *lines]))
    with pytest.raises(InputError, match=r"azimuth_deg: .*it looks like radians"):
        gr.convert(tmp_path / "r.csv", tmp_path / "r.parquet")


def lost_fractions(kind):
    time = START + 0.05 * (np.arange(12000) // 80)
    return {"float32": time.astype(np.float32), "int64": time.astype(np.int64),
            "six digits": np.round(time + 3e4, -4)}[kind]  # fmt: skip


@pytest.mark.parametrize("kind", ["float32", "int64", "six digits"])
def test_times_without_fractions_are_refused(tmp_path, kind):
    """Times as float32 join the frames of two minutes in one."""
    path = written(tmp_path / "r.parquet", scene(12000))
    pd.read_parquet(path).assign(time=lost_fractions(kind)).to_parquet(path)
    for read in (
        lambda: list(open_recording(path).read()),
        lambda: gr.convert(path, tmp_path / "out.parquet"),
    ):
        with pytest.raises(InputError, match="whole seconds"):
            read()


def test_a_table_whose_positions_are_all_unusable_is_refused(tmp_path):
    path = written(tmp_path / "r.parquet", scene() + [EAST, NORTH, 0.0])
    with pytest.raises(InputError, match="no detection has a usable position"):
        gr.convert(path, tmp_path / "out.parquet")
    assert not (tmp_path / "out.parquet").exists()


def test_two_sensors_merged_into_one_are_doubted(tmp_path):
    paths = [recording(tmp_path / f"R{n}.parquet", START + 0.02 * n + 0.05 * np.arange(40),
                       scene(40, n)) for n in (1, 2)]  # fmt: skip
    heard = Listener()
    gr.convert([paths[0], paths[0]], tmp_path / "out.parquet", reporter=heard)
    assert not any("alternate" in str(each) for each in heard.messages)
    gr.convert(paths, tmp_path / "out.parquet", reporter=heard)
    assert any("are they of one sensor?" in str(each) for each in heard.messages)


def test_one_sensor_in_many_short_files_is_not_doubted(tmp_path):
    paths = [recording(tmp_path / f"{n}.parquet", START + 0.2 * n + 0.05 * np.arange(4),
                       scene(4, n)) for n in range(12)]  # fmt: skip
    heard = Listener()
    gr.convert(paths, tmp_path / "out.parquet", reporter=heard)
    assert not any("alternate" in str(each) for each in heard.messages)


@given(st.lists(st.floats(-np.pi, np.pi), max_size=50), st.integers(0, 2))
def test_no_azimuth_in_radians_is_refused(angles, wrong):
    refuse_degrees(np.array([*angles, *[1e6] * min(wrong, len(angles) // 3)]), "az", "azimuth")


def test_the_commands_exit_with_3(tmp_path, monkeypatch, capsys):
    path = written(tmp_path / "r.parquet", scene() * 1000.0)
    words = ["convert", str(path), "-o", str(tmp_path / "out.parquet")]
    monkeypatch.setattr("sys.argv", ["gis-radar", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3
    assert "it looks like millimetres" in capsys.readouterr().err
