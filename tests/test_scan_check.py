"""The scan check: what stands agrees with the true pose of the sample, and with no other."""

import json
from dataclasses import replace
from datetime import date
from itertools import product

import laspy
import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import shapely
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from maps import Listener
from pyproj import CRS, Transformer
from scipy.spatial import KDTree
from sites import recording

import gis_radar as gr
from gis_radar.base import CELL_M
from gis_radar.calibration import (
    AmbiguousError,
    Localization,
    Solved,
    localize_together,
    require_scans_near,
)
from gis_radar.calibration.scan import scan_check
from gis_radar.calibration.scan.scan_check import CLOSE_M, align
from gis_radar.calibration.scan.surroundings import (
    LevelFrame,
    Standing,
    Structure,
    read_structure,
)
from gis_radar.calibration.several import joint
from gis_radar.calibration.single import localization as localizing
from gis_radar.cli import group
from gis_radar.scans import scan as scan_files
from simulation.movement import Traffic
from simulation.radar import RadarModel, place_radar
from simulation.recording import simulate_recording, write_recording
from simulation.scan import fly, write_scan
from simulation.scene import Scene, Tree
from simulation.terrain import Terrain

SAMPLE = gr.sample_folder()
SCAN = SAMPLE / "scan.laz"
POSE = gr.read_pose(SAMPLE / "R2.json")
R2 = SAMPLE / "R2.parquet"


def moved(pose, ahead=0.0, left=0.0, turn=0.0):
    yaw = np.radians(pose.yaw)
    return replace(
        pose,
        easting=pose.easting + ahead * np.cos(yaw) - left * np.sin(yaw),
        northing=pose.northing + ahead * np.sin(yaw) + left * np.cos(yaw),
        yaw=pose.yaw + turn,
    )


def rewritten(path, change, crs="EPSG:25832"):
    """Write the sample's scan with changed points; without a system where `crs` is None."""
    source = laspy.read(SCAN)
    xyz, category = change(np.array(source.xyz), np.array(source.classification))
    scan = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    scan.header.scales = [0.001] * 3
    scan.header.offsets = np.floor(xyz.min(axis=0))
    if crs:
        scan.header.add_crs(CRS.from_user_input(crs))
    scan.xyz, scan.classification = xyz, category
    scan.write(path)
    return path


def filtered(path, keep, source=R2):
    """Write a recording with the detections that `keep` says; every frame stays."""
    table = pq.read_table(source)
    rate = np.abs(table["range_rate"].to_numpy())
    stamps = np.unique(table["time"].to_numpy())
    kept = table.filter(pc.field("time") > 0).filter(keep(rate))
    bare = np.setdiff1d(stamps, kept["time"].to_numpy())
    time = np.concatenate([kept["time"].to_numpy(), bare])
    order = np.argsort(time, kind="stable")
    columns = {
        name: np.concatenate([kept[name].to_numpy(), np.full(len(bare), np.nan, np.float32)])
        for name in ("x", "y", "z", "range_rate")
    }
    points = np.column_stack([columns[axis] for axis in "xyz"])[order]
    return recording(path, time[order], points, range_rate=columns["range_rate"][order])


def windy_park(folder):
    """Write the scan and the recording of trees in wind: their leaves do 0.3 m/s on average."""
    rng = np.random.default_rng(5)
    middle = np.array(POSE.position[:2])
    places = middle + rng.uniform(-90.0, 90.0, (60, 2))
    places = places[np.hypot(*(places - middle).T) > 12.0]
    terrain = Terrain(origin=tuple(middle), height_m=POSE.height - 6.0)
    trees = tuple(
        Tree(place=tuple(place), crown_m=crown, crown_height_m=crown + 2.5)
        for place, crown in zip(places, rng.uniform(2.0, 3.5, len(places)), strict=True)
    )
    lawn = shapely.box(*(middle - 80.0), *(middle + 80.0))
    scene = Scene(terrain=terrain, road=lawn, trees=trees)
    write_scan(fly(scene, rng=rng), folder / "scan.laz", crs=POSE.crs, flown=date(2024, 3, 14))
    radar = place_radar(POSE, scene, rng=rng, model=replace(RadarModel(), static_per_frame=150.0))
    still = radar.targets.clutter
    stirred = replace(still, wobble=still.wobble * 15.0)
    radar = replace(radar, targets=replace(radar.targets, clutter=stirred))
    nobody = Traffic(
        start=0.0, centre=np.zeros((2, 0, 2)), heading=np.zeros((2, 0)), speed=np.zeros((2, 0)),
        yaw_rate=np.zeros((2, 0)), size=np.zeros((0, 3)), kind=(),
    )  # fmt: skip
    recorded = simulate_recording(radar, nobody, 1.0 + np.arange(200) * 0.05, rng=rng)
    write_recording(recorded, folder / "R.parquet")
    return folder / "R.parquet", folder / "scan.laz"


@pytest.fixture(scope="module")
def look():
    return gr.check_against_scan(R2, POSE, [SCAN])


def alignment_of(look):
    return align(look.standing, look.structure)


@pytest.mark.parametrize("sensor", ["R1", "R2"])
def test_the_truth_is_confirmed(sensor, look):
    pose = SAMPLE / f"{sensor}.json"
    found = (
        look
        if sensor == "R2"
        else gr.check_against_scan(SAMPLE / f"{sensor}.parquet", pose, [SCAN])
    )
    assert found.verdict == "confirms"
    assert found.score > 0.9
    assert found.chance < 0.3
    assert found.best.shift_m < 0.4
    assert abs(found.best.turn_deg) < 0.3
    assert found.rival.score < 0.7


@pytest.mark.parametrize("off", [(0.0, 3.5, 0.0), (0.0, 0.0, -3.0)])
def test_a_pose_off_is_doubted_and_the_way_back_is_told(off):
    wrong = moved(POSE, *off)
    figures = gr.check_against_scan(R2, wrong, [SCAN]).figures()
    assert figures["verdict"] == "doubts"
    assert figures["score"] < 0.7
    assert figures["best_score"] > 0.9
    assert figures["z_score"] < -3.0
    back = [wrong.easting + figures["best_east_m"], wrong.northing + figures["best_north_m"]]
    assert np.allclose(back, [POSE.easting, POSE.northing], atol=0.4)
    assert figures["best_turn_deg"] == pytest.approx(-off[2], abs=0.3)


def test_a_pose_the_wrong_way_round_is_doubted():
    found = gr.check_against_scan(R2, moved(POSE, turn=180.0), [SCAN])
    assert found.verdict == "doubts"
    assert abs(abs(found.best.turn_deg) - 180.0) < 1.0


def test_a_small_error_is_confirmed_and_measured():
    """A shift and a turn make up for each other, so what counts is where they bring the cells."""
    wrong = moved(POSE, 0.5, -0.6, 0.4)
    found = gr.check_against_scan(R2, wrong, [SCAN])
    assert found.verdict == "confirms"
    assert found.best.turn_deg == pytest.approx(-0.4, abs=0.3)
    before = away_m(found, wrong)
    after = away_m(found, moved(wrong, *found.best.place))
    assert before > 0.55
    assert after < 0.35
    assert after < before / 2.0


def away_m(look, pose):
    """Return how far from their place a pose puts the cells that stand, on average."""
    cells = look.standing.points[:, :2]
    there, true = (LevelFrame(pose=each).to_map(cells) for each in (pose, POSE))
    return np.hypot(*(there - true).T).mean()


def test_only_the_place_of_map_and_sensor_to_each_other_counts(look, tmp_path):
    turn_deg, middle, shift = 77.0, POSE.position[:2], np.array([-1234.567, 890.123])
    turn = np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def change(xyz, category):
        xyz[:, :2] = (xyz[:, :2] - middle) @ rotation.T + middle + shift
        return xyz, category

    scan = rewritten(tmp_path / "moved.laz", change)
    easting, northing = middle + shift
    pose = replace(POSE, easting=easting, northing=northing, yaw=POSE.yaw + turn_deg)
    there = gr.check_against_scan(R2, pose, [scan])
    assert there.score == pytest.approx(look.score, abs=2e-3)  # the file rounds to millimetres
    assert there.chance == pytest.approx(look.chance, abs=2e-3)
    assert there.best.place == pytest.approx(look.best.place, abs=0.11)
    assert there.verdict == look.verdict


@given(
    st.floats(-180.0, 180.0),
    st.tuples(st.floats(0.0, 9e5), st.floats(0.0, 9e6)),
    st.lists(st.tuples(*[st.floats(-300.0, 300.0)] * 3), min_size=1, max_size=5),
)
def test_the_level_frame_stands_under_the_sensor(yaw, place, points):
    level = LevelFrame(pose=replace(POSE, easting=place[0], northing=place[1], yaw=yaw))
    here = LevelFrame(pose=POSE)
    points = np.array(points)
    assert np.allclose(level.from_map(level.to_map(points)), points, atol=1e-6)
    assert np.allclose(level.from_sensor(points), here.from_sensor(points), atol=1e-6)


def test_closeness_is_that_of_the_next_structure(look):
    alignment = alignment_of(look)
    cells = np.argwhere(look.structure.visible) + 0.5 - len(look.structure.top) // 2
    away, _ = KDTree(cells * CELL_M).query(look.standing.points[:, :2])
    expected = np.exp(-0.5 * (away / CLOSE_M) ** 2)
    # the field is sampled at the centres of cells and distances count between centres
    assert np.abs(alignment.closeness_at((0.0, 0.0, 0.0)) - expected).mean() < 0.05
    assert look.closeness.mean() == pytest.approx(look.score)


def test_the_surface_is_the_score_of_each_shift(look):
    alignment = alignment_of(look)
    middle = look.surface.shape[0] // 2
    for i, j in [(0, 0), (4, -7), (-20, 13), (20, 20)]:
        direct = alignment.offset((i * CELL_M, j * CELL_M, 0.0)).score
        assert look.surface[middle + i, middle + j] == pytest.approx(direct, abs=0.04)
    assert (
        np.abs(np.array(np.unravel_index(look.surface.argmax(), look.surface.shape)) - middle).max()
        <= 1
    )


def test_an_unclassified_scan_does(tmp_path):
    scan = rewritten(tmp_path / "bare.laz", lambda xyz, c: (xyz, np.ones_like(c)))
    found = gr.check_against_scan(R2, POSE, [scan])
    assert found.verdict == "confirms"
    assert not found.structure.classified
    off = gr.check_against_scan(R2, moved(POSE, 0.0, -3.5), [scan])
    assert off.verdict == "doubts"


def test_a_scan_in_another_system_is_brought_into_the_map(tmp_path):
    into = Transformer.from_crs(25832, 31468, always_xy=True)

    def change(xyz, category):
        return np.column_stack([*into.transform(*xyz[:, :2].T), xyz[:, 2]]), category

    named = rewritten(tmp_path / "named.laz", change, crs="EPSG:31468")
    assert gr.check_against_scan(R2, POSE, [named]).verdict == "confirms"
    nameless = rewritten(tmp_path / "nameless.laz", change, crs=None)
    with pytest.raises(gr.CrsError, match="no coordinate system"):
        gr.check_against_scan(R2, POSE, [nameless])
    assert gr.check_against_scan(R2, POSE, [nameless], scan_crs="EPSG:31468").verdict == "confirms"


def test_a_scan_of_another_place_is_refused():
    with pytest.raises(gr.InputError, match="no point within"):
        gr.check_against_scan(R2, replace(POSE, northing=POSE.northing + 9000.0), [SCAN])


def test_a_scan_of_a_corner_says_too_little(tmp_path):
    def change(xyz, category):
        kept = np.hypot(*(xyz[:, :2] - POSE.position[:2]).T) < 25.0
        return xyz[kept], category[kept]

    found = gr.check_against_scan(R2, POSE, [rewritten(tmp_path / "corner.laz", change)])
    assert found.verdict == "nothing to compare"
    assert "covers" in found.reason


def test_the_mirrored_place_in_a_symmetric_junction_is_not_confirmed():
    """Traffic fits there as well; what stands fits worse than a few metres aside."""
    place = {"easting": 690419.14, "northing": 5336166.35, "height": 521.72}
    mirrored = replace(POSE, **place, yaw=113.67, pitch=4.09, roll=-0.62)
    found = gr.check_against_scan(R2, mirrored, [SCAN])
    assert found.verdict == "undecided"
    assert "both may be right" in found.reason


@pytest.mark.parametrize(("trees_m", "verdict"), [(0.0, "confirms"), (7.0, "undecided")])
def test_a_corner_that_looks_alike_is_not_confirmed(monkeypatch, trees_m, verdict):
    """The fronts of two streets lie where those of another corner do; its trees do not."""
    front, middle = np.arange(0.25, 110.0, 0.5), 300
    walls = np.array([*product(front, [9.75]), *product([-9.75], front)])
    spots = np.array([*product(front[20::34], [4.25]), *product([-4.25], front[36::34])])
    trees = np.vstack([spots + step for step in product((0.0, 0.5, 1.0), repeat=2)])
    visible = np.zeros((2 * middle, 2 * middle), bool)
    visible[tuple(np.floor(np.vstack([walls, trees]) / CELL_M).astype(int).T + middle)] = True
    along = np.where(trees[:, :1] > 0.0, [1.0, 0.0], [0.0, 1.0])
    cells = np.vstack([walls, trees + trees_m * along])
    flat, none = np.zeros(visible.shape), np.zeros(visible.shape, bool)
    structure = Structure(
        top=flat, ground=flat, canopy=none, roof=none, edge=visible, classified=True
    )
    stand = Standing(points=np.column_stack([cells, 0.0 * cells[:, 0]]), rustles=0.0 * cells[:, 0])
    monkeypatch.setattr(scan_check, "read_structure", lambda *_, **__: structure)
    monkeypatch.setattr(scan_check, "standing", lambda *_, **__: stand)
    found = gr.check_against_scan(R2, POSE, [SCAN])
    assert found.score > 0.8
    assert found.z_score > 2.0
    assert found.verdict == verdict
    assert ("looks alike" in found.reason) == (verdict == "undecided")


def test_a_plain_has_nothing_to_compare(tmp_path):
    def change(xyz, category):
        return xyz[category == 2], category[category == 2]

    found = gr.check_against_scan(R2, POSE, [rewritten(tmp_path / "plain.laz", change)])
    assert found.verdict == "nothing to compare"
    assert "neither canopy nor walls" in found.reason


def test_a_radar_that_hides_what_stands_has_nothing_to_compare(tmp_path):
    path = filtered(tmp_path / "R2.parquet", lambda rate: rate > 1.0)
    found = gr.check_against_scan(path, POSE, [SCAN])
    assert found.verdict == "nothing to compare"
    assert "no still detections" in found.reason
    assert json.loads(json.dumps(found.figures(), allow_nan=False))["standing_cells"] == 0
    found.draw(tmp_path / "look.png")
    assert (tmp_path / "look.png").read_bytes().startswith(b"\x89PNG")


def test_leaves_alone_do(tmp_path):
    whole, scan = windy_park(tmp_path)
    path = filtered(tmp_path / "leaves.parquet", lambda rate: rate > 0.15, source=whole)
    found = gr.check_against_scan(path, POSE, [scan])
    assert found.verdict == "confirms"
    assert found.standing.rustles.min() == 1.0
    assert gr.check_against_scan(path, moved(POSE, 0.0, 3.5), [scan]).verdict == "doubts"


def test_vehicles_that_wait_or_drive_by_do_not_stand(look):
    level = look.level
    roads = gr.read_map(SAMPLE / "junction.osm")
    lanes = shapely.union_all(roads.lanelets.geometry.to_numpy()).buffer(-1.0)
    east, north = level.to_map(look.standing.points[:, :2]).T
    shapely.prepare(lanes)
    assert shapely.contains_xy(lanes, east, north).mean() < 0.15


def test_batches_and_their_order_do_not_matter(tmp_path, monkeypatch):
    level = LevelFrame(pose=POSE)
    whole = read_structure([SCAN], level, reach_m=100.0)
    halves = [
        rewritten(tmp_path / f"{i}.laz", lambda xyz, c, i=i: (xyz[i::2], c[i::2])) for i in (1, 0)
    ]
    monkeypatch.setattr(scan_files, "BATCH_POINTS", 40_000)
    parts = read_structure(halves, level, reach_m=100.0)
    for name in ("top", "ground", "canopy", "roof", "edge"):
        assert np.allclose(getattr(parts, name), getattr(whole, name), atol=1e-6, equal_nan=True)


def test_few_cells_are_nothing_to_compare(monkeypatch):
    monkeypatch.setattr("gis_radar.calibration.scan.scan_check.LEAST_CELLS", 10**6)
    few = gr.check_against_scan(R2, POSE, [SCAN])
    assert few.reason.startswith("little stands in view")


def command(folder, *more):
    return [
        "localize", str(R2), "--map", str(SAMPLE / "junction.osm"), "--road", str(SCAN),
        "--guess", "690379,5336233", "-o", str(folder / "pose.json"), *more,
    ]  # fmt: skip


@pytest.mark.parametrize("left", [0.0, 3.5])
def test_the_command_tells_the_verdict(tmp_path, monkeypatch, left):
    answer = Localization(
        pose=moved(POSE, 0.0, left), fitness=1.0, observable=True,
        traces=np.array([[20.0, 0.0, -5.0], [40.0, 9.0, -5.0]]), range_rate=np.array([1.0, -1.0]),
    )  # fmt: skip
    monkeypatch.setattr(localizing, "localize_one", lambda *_, **__: answer)
    picture = tmp_path / "figure.png"
    call = command(tmp_path, "--scan", str(SCAN), "--json")
    call += ["--figure", str(picture)] if left else []
    done = CliRunner().invoke(group, call, catch_exceptions=False)
    assert done.exit_code == 0
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    verdict = "doubts" if left else "confirms"
    assert lines[-1]["summary"]["scan_check"] == verdict
    (said,) = [line for line in lines if line["event"] == "log" and "scan check" in line["message"]]
    assert said["level"] == ("warning" if left else "info")
    evidence = gr.read_pose(tmp_path / "pose.json").evidence["scan_check"]
    assert evidence["verdict"] == verdict
    assert {"score", "chance", "best_score", "best_east_m", "best_turn_deg"} <= set(evidence)
    view = gr.read_pose(tmp_path / "pose.json").view
    assert view == gr.View(max_range_m=reached_m(R2))
    assert not left or picture.read_bytes().startswith(b"\x89PNG")


def reached_m(path):
    """Return the whole metres within which 99.9 % of a recording's detections lie."""
    x, y, z = (pq.read_table(path)[axis].to_numpy() for axis in "xyz")
    return np.ceil(np.nanpercentile(np.sqrt(x**2 + y**2 + z**2), 99.9))


def test_a_view_that_is_known_is_not_measured(tmp_path, monkeypatch):
    known = gr.View(azimuth_deg=90.0, max_range_m=150.0)
    answer = Localization(pose=POSE, fitness=1.0, observable=True)
    monkeypatch.setattr(localizing, "localize_one", lambda *_, **__: answer)
    found = gr.localize(
        R2, SAMPLE / "junction.osm", SCAN, guess=(690379, 5336233), scans=[SCAN], view=known
    )
    assert found.pose.view == known
    assert found.recording == "R2.parquet"


def test_what_stands_decides_between_poses_that_the_traffic_fits_alike(monkeypatch, first_seconds):
    aside = replace(POSE, easting=POSE.easting + 6.0, northing=POSE.northing + 3.0)
    both = tuple(Localization(pose=p, fitness=0.95, observable=True) for p in (aside, POSE))

    def ambiguous(*_, **__):
        raise AmbiguousError("R2: ambiguous", hint="give a scan", answers=both)

    monkeypatch.setattr(localizing, "localize_one", ambiguous)
    files = (first_seconds(R2, 31.0), SAMPLE / "junction.osm", SCAN)
    with pytest.raises(AmbiguousError):
        gr.localize(*files, guess=POSE.position[:2])
    found = gr.localize(*files, guess=POSE.position[:2], scans=[SCAN])
    assert found.pose.easting == POSE.easting
    assert found.pose.evidence["scan_check"]["verdict"] == "confirms"


def test_what_stands_decides_though_it_fits_elsewhere_too(monkeypatch, first_seconds):
    """As it would along a facade: no pose is confirmed, but one is far better than the other."""

    def unclear(*files, **options):
        look = gr.check_against_scan(*files, **options)
        return replace(look, verdict="nothing to compare") if look.verdict == "confirms" else look

    aside = replace(POSE, easting=POSE.easting + 6.0, northing=POSE.northing + 3.0)
    several = []

    def ambiguous(*_, **__):
        answers = tuple(Localization(pose=p, fitness=0.95, observable=True) for p in several)
        raise AmbiguousError("R2: ambiguous", hint="give a scan", answers=answers)

    monkeypatch.setattr(localizing, "localize_one", ambiguous)
    monkeypatch.setattr(localizing, "check_against_scan", unclear)
    heard = Listener()
    files = (first_seconds(R2, 31.0), SAMPLE / "junction.osm", SCAN)
    several[:] = [aside, POSE]
    found = gr.localize(*files, guess=POSE.position[:2], scans=[SCAN], reporter=heard)
    assert found.pose.easting == POSE.easting
    assert found.pose.evidence["scan_check"]["verdict"] == "nothing to compare"
    assert "R2: ambiguous; what stands in the scan prefers one of them" in str(heard.messages)
    assert str(heard.messages).count("scan check: ") == 1  # of the pose that is the answer
    several[:] = [POSE, POSE]  # nothing to choose between
    with pytest.raises(AmbiguousError) as refused:
        gr.localize(*files, guess=POSE.position[:2], scans=[SCAN])
    assert refused.value.hint == "record longer, or give a heading: the scan does not decide"


def guess_of(sensor):
    pose = gr.read_pose(SAMPLE / f"{sensor}.json")
    guess = f"{pose.easting + 3:.1f},{pose.northing - 4:.1f}"
    return ["--guess", guess, "--heading", f"{pose.yaw + 8.0:.1f}"]


def test_poses_found_together_are_checked_each(tmp_path, first_seconds):
    """Of the sample, from guesses metres off, with the scan."""
    recordings = [first_seconds(SAMPLE / f"{name}.parquet", 31.0) for name in ("R1", "R2")]
    call = [
        "localize", *map(str, recordings), "--together", "--json",
        "--map", str(SAMPLE / "junction.osm"), "--road", str(SCAN), "--scan", str(SCAN),
        *guess_of("R1"), *guess_of("R2"), "-o", str(tmp_path / "poses"),
    ]  # fmt: skip
    done = CliRunner().invoke(group, call, catch_exceptions=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.exit_code == 0
    assert lines[-1]["summary"]["R1"].endswith("; scan check: confirms")
    pose = gr.read_pose(tmp_path / "poses" / "R2.json")
    assert "together" in pose.evidence
    assert pose.view == gr.View(max_range_m=reached_m(recordings[1]))
    again = gr.check_against_scan(recordings[1], pose, [SCAN])
    assert pose.evidence["scan_check"] == json.loads(json.dumps(again.figures()))
    assert again.verdict == "confirms"
    assert lines[-1]["summary"]["R2"].endswith("; scan check: confirms")
    (said,) = [each for each in lines if each.get("message", "").startswith("R2: scan ")]
    assert said["message"] == f"R2: scan check: confirms: {again.reason}"


def test_of_poses_that_contradict_each_other_the_confirmed_one_stays(monkeypatch):
    """Two alone were both refused; with the scan it is clear which one lies a lane off."""
    right = {name: gr.read_pose(SAMPLE / f"{name}.json") for name in ("R1", "R2")}
    poses = {"R1": right["R1"], "R2": moved(right["R2"], 0.0, 3.5)}
    alone = {n: Localization(pose=p, fitness=1.0, observable=True) for n, p in poses.items()}
    why = "R1 and R2: their poses contradict each other"
    solved = Solved(poses={}, chosen={}, refused=dict.fromkeys(alone, why), pairs={})
    monkeypatch.setattr(joint, "localize_one", lambda recording, **_: alone[recording.stem])
    monkeypatch.setattr(joint, "adjust_poses", lambda *_, **__: solved)
    with pytest.raises(gr.NoAnswerError, match="contradict each other"):
        together()
    heard = Listener()
    both = together(scans=[SCAN], reporter=heard)
    assert list(both.found) == ["R1"]
    assert both.found["R1"].pose.easting == right["R1"].easting
    assert both.found["R1"].pose.evidence["scan_check"]["verdict"] == "confirms"
    assert both.refused == {"R2": why}
    assert f"{why}; what stands in the scan confirms that of R1" in str(heard.messages)


def together(**options):
    guesses = [gr.read_pose(SAMPLE / f"{name}.json").position[:2] for name in ("R1", "R2")]
    return localize_together(
        [SAMPLE / "R1.parquet", R2], SAMPLE / "junction.osm", SCAN, guesses=guesses, **options
    )


def test_the_scan_decides_for_a_sensor_before_its_neighbours_do(monkeypatch):
    aside = replace(POSE, easting=POSE.easting + 6.0, northing=POSE.northing + 3.0)
    both = tuple(Localization(pose=p, fitness=0.95, observable=True) for p in (aside, POSE))
    first = Localization(pose=gr.read_pose(SAMPLE / "R1.json"), fitness=0.95, observable=True)

    def single(recording, **_):
        if recording == R2:
            raise AmbiguousError("R2: ambiguous", hint="give a scan", answers=both)
        return first

    given = []

    def unmoved(_, poses, *__, **___):
        given.append(poses["R2"])
        right = {name: several[-1] for name, several in poses.items()}
        chosen = {name: len(several) - 1 for name, several in poses.items()}
        return Solved(poses=right, chosen=chosen, refused={}, pairs={})

    monkeypatch.setattr(joint, "localize_one", single)
    monkeypatch.setattr(joint, "adjust_poses", unmoved)
    together()
    together(scans=[SCAN])
    assert given == [(aside, POSE), (POSE,)]


def test_a_scan_that_reaches_one_of_two_sensors_is_refused_before_the_search(tmp_path, monkeypatch):
    def never(*_, **__):
        raise AssertionError

    monkeypatch.setattr(joint, "localize_one", never)
    north = gr.read_pose(SAMPLE / "R1.json").northing + 310.0  # R2 is 55 m nearer to it

    def change(xyz, category):
        return (xyz + [0.0, north - xyz[:, 1].min(), 0.0])[::50], category[::50]

    scan = rewritten(tmp_path / "far.laz", change)
    with pytest.raises(gr.InputError, match="no point within 300 m of R1"):
        together(scans=[scan])
    require_scans_near([scan, SCAN], POSE.crs, POSE.position[:2])  # one that does is enough


def test_a_scan_of_another_place_is_told_before_the_search(tmp_path, monkeypatch):
    def never(*_, **__):
        raise AssertionError

    monkeypatch.setattr(localizing, "localize_one", never)
    monkeypatch.setattr(scan_files.Scan, "batches", never)  # nor is a scan read
    far = rewritten(tmp_path / "far.laz", lambda xyz, c: (xyz[::50] + [900.0, 0.0, 0.0], c[::50]))
    words = command(tmp_path, "--scan", str(far), "--json")
    words[words.index("--road") + 1] = str(SAMPLE / "scan.laz")
    monkeypatch.setattr(localizing, "read_road", lambda *_: np.empty((0, 3)))
    done = CliRunner().invoke(group, words)
    assert isinstance(done.exception, gr.InputError)
    assert "far.laz: no point within 300 m of the sensor" in str(done.exception)
    require_scans_near([far, SCAN], POSE.crs, [690379.0, 5336233.0])  # one that does is enough


def test_the_figure_never_replaces_the_scan(tmp_path):
    scan = rewritten(tmp_path / "scan.laz", lambda xyz, c: (xyz[::50], c[::50]))
    done = CliRunner().invoke(group, command(tmp_path, "--scan", str(scan), "--figure", str(scan)))
    assert isinstance(done.exception, gr.UsageError)
    assert scan.read_bytes().startswith(b"LASF")


def test_a_single_scan_may_be_given_as_it_is(look, tmp_path):
    """To what takes several scans, as text or as a path."""
    assert gr.check_against_scan(R2, POSE, str(SCAN)).score == look.score
    tiles = gr.make_tiles(gr.read_map(SAMPLE / "junction.osm"))
    assert gr.find_sight(POSE, tiles, str(SCAN)).seen.any()
    with pytest.raises(gr.InputError, match=r"nowhere\.laz: no such file"):
        gr.mask_road("nowhere.laz", SAMPLE / "junction.osm")
    with pytest.raises(gr.InputError, match=r"nowhere\.laz: no such file"):
        gr.localize(R2, SAMPLE / "junction.osm", SCAN, guess=POSE.position[:2], scans="nowhere.laz")
    with pytest.raises(gr.InputError, match=r"nowhere\.laz: no such file"):
        gr.measure(
            [R2], [POSE], tiles, SAMPLE / "junction.osm", tmp_path / "data", scans="nowhere.laz"
        )
