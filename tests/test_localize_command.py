"""The command `localize`: options reach their arguments, and a pose file comes out."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from pyproj import Transformer
from sites import UTM
from streets import Street, errors

import gis_radar as gr
from gis_radar.base import tr, yaw_from_compass
from gis_radar.calibration.single import localization as localizing
from gis_radar.cli import group
from gis_radar.poses import read_pose


@pytest.fixture
def files(tmp_path):
    """A recording and a scanned road; the map's lanes come from the scene itself."""
    street = Street()
    street.record(tmp_path / "R1.parquet", street.pose())
    street.write_road(tmp_path / "road.laz")
    return street, tmp_path


def words(folder, *more):
    return [
        "localize", str(folder / "R1.parquet"), "--map", "map.osm",
        "--road", str(folder / "road.laz"), "-o", str(folder / "pose.json"), *more,
    ]  # fmt: skip


def test_a_pose_file_comes_out(files, monkeypatch):
    street, folder = files
    monkeypatch.setattr(localizing, "read_map", lambda *_, **__: street.roads())
    true = street.pose()
    guess = f"{true.easting + 4:.1f},{true.northing - 3:.1f}"
    picture = folder / "figure.png"
    call = words(folder, "--guess", guess, "--figure", str(picture), "--json")
    done = CliRunner().invoke(group, call, catch_exceptions=False)
    assert done.exit_code == 0
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["outputs"] == [str(folder / "pose.json"), str(picture)]
    found = read_pose(folder / "pose.json")
    assert (np.abs(errors(found, true)) < [0.4, 0.4, 0.2, 0.5, 0.5, 0.3]).all()
    assert {
        "sigma",
        "covariance",
        "time",
        "method",
        "converged",
        "fitness",
        "observable",
        "frames",
        "range_scale",
    } <= set(found.evidence)
    scale = found.evidence["range_scale"]
    assert abs(scale["factor"] - 1.0) < 3.0 * scale["sigma"]
    assert result["summary"]["range_scale"] == round(scale["factor"], 3)
    assert 0.0 < result["summary"]["sigma_range_scale"] < 0.03


@pytest.mark.parametrize(
    ("option", "name", "value"),
    [
        (("--heading", "12.5"), "heading", 12.5),
        (("--method", "icp"), "method", "icp"),
        (("--guess", "690000,5336000,412"), "guess", (690000.0, 5336000.0, 412.0)),
    ],
)
def test_options_reach_their_arguments(files, monkeypatch, option, name, value):
    street, folder = files
    heard = {}

    def listen(*_, **options):
        heard.update(options)
        raise gr.NoAnswerError("heard")

    monkeypatch.setattr(localizing, "read_map", lambda *_, **__: street.roads())
    monkeypatch.setattr(localizing, "localize_one", listen)
    guess = () if option[0] == "--guess" else ("--guess", "690000,5336000")
    with pytest.raises(gr.NoAnswerError, match="heard"):
        CliRunner().invoke(
            group, words(folder, *guess, *option), catch_exceptions=False, standalone_mode=False
        )
    assert heard[name] == value


def test_the_figure_speaks_the_users_language(files, monkeypatch):
    _, folder = files
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")

    def listen(*_, **_options):
        raise gr.NoAnswerError(tr("scanned road"))

    monkeypatch.setattr(gr, "localize", listen)
    call = words(folder, "--guess", "690000,5336000", "--figure", str(folder / "figure.png"))
    with pytest.raises(gr.NoAnswerError, match="gescannte Straße"):
        CliRunner().invoke(group, call, catch_exceptions=False, standalone_mode=False)


def test_a_compass_becomes_a_heading(files, monkeypatch):
    street, folder = files
    heard = {}

    def listen(*_, heading, **_options):
        heard["heading"] = heading
        raise gr.NoAnswerError("heard")

    monkeypatch.setattr(localizing, "read_map", lambda *_, **__: street.roads())
    monkeypatch.setattr(localizing, "localize_one", listen)
    call = words(folder, "--guess", "690000,5336000", "--compass", "north-east")
    with pytest.raises(gr.NoAnswerError, match="heard"):
        CliRunner().invoke(group, call, catch_exceptions=False, standalone_mode=False)
    assert heard["heading"] == pytest.approx(yaw_from_compass(45.0, UTM, 690_000.0, 5_336_000.0))


def test_a_guess_in_another_system_is_moved(files, monkeypatch):
    street, folder = files
    heard = {}

    def listen(*_, guess, **_options):
        heard["guess"] = guess
        raise gr.NoAnswerError("heard")

    monkeypatch.setattr(localizing, "read_map", lambda *_, **__: street.roads())
    monkeypatch.setattr(localizing, "localize_one", listen)
    there = Transformer.from_crs(UTM, 3857, always_xy=True).transform(690_000.0, 5_336_000.0)
    guess = ",".join(f"{value:.3f}" for value in there)
    call = words(folder, "--guess", guess, "--guess-crs", "EPSG:3857")
    with pytest.raises(gr.NoAnswerError, match="heard"):
        CliRunner().invoke(group, call, catch_exceptions=False, standalone_mode=False)
    assert heard["guess"] == pytest.approx((690_000.0, 5_336_000.0), abs=0.01)


@pytest.mark.parametrize(
    "wrong",
    [
        ("--guess", "11.5,48.1"),
        ("--guess", "690000"),
        ("--guess", "690000,5336000", "--compass", "up"),
        ("--guess", "690000,5336000", "--heading", "3", "--compass", "north"),
    ],
)
def test_wrong_usage_is_told(files, wrong):
    _, folder = files
    done = CliRunner().invoke(group, words(folder, *wrong))
    assert done.exit_code == 2 or isinstance(done.exception, gr.UsageError)
    assert not (folder / "pose.json").exists()


def test_grid_north_is_not_true_north():
    # 9 deg east is the middle of zone 32; east of it grid north points to the west of true north
    assert yaw_from_compass(90.0, UTM, 500_000.0, 5_400_000.0) == pytest.approx(0.0, abs=1e-6)
    convergence = np.degrees(np.arctan(np.tan(np.radians(2.0)) * np.sin(np.radians(48.7))))
    east, north = 647_200.0, 5_396_000.0
    assert yaw_from_compass(90.0, UTM, east, north) == pytest.approx(convergence, abs=0.02)
    assert yaw_from_compass(270.0, UTM, 500_000.0, 5_400_000.0) == pytest.approx(180.0)
