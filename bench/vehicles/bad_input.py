"""Bad input: scenes changed so that something is wrong, and what the package makes of them.

Each has what is expected: the exit code, words of a warning or error, and in all cases no false
vehicle that lasts over ten seconds: one with no true vehicle within eight metres. Second ones on a
true vehicle are counted beside it; so are those of the scenes as they are, to compare with.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import numpy as np
import own
import pandas as pd
from causes import DOUBLE_M, near
from methods import MISSING, NotThereError
from peers import beside_vehicles
from scenes import SceneFiles, scene
from tracks import EVERY, compared, estimated_states, matched
from true_coverage import middle_lines

import gis_radar as gr
from gis_radar.arrays import Integers
from gis_radar.poses.files import write_pose
from gis_radar.steps import STEP_S

LASTS_S = 10.0
MOVING_MPS = 0.15
BESIDE_M = 5.0  # a radar as recorded sees vehicles so far from where they are


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What a command is given.

    Parameters
    ----------
    recordings, poses : list of Path
        In order.
    map, scan : Path
        The lanes, and what stands beside them.
    """

    recordings: list[Path]
    poses: list[Path]
    map: Path
    scan: Path


Change = Callable[[SceneFiles, Inputs, Path], Inputs]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A scene changed, and what is expected.

    Parameters
    ----------
    scene : str
        Which scene.
    change : callable
        Takes the scene, its inputs, and a folder for what it writes; returns the inputs changed.
    codes : tuple of int
        Exit codes that are right.
    said : str
        A pattern that a warning or an error must have; empty where none need be.
    """

    scene: str
    change: Change
    codes: tuple[int, ...] = (0,)
    said: str = ""


def try_all(names: list[str] | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each case and how it went."""
    if not own.has("vehicles"):
        raise NotThereError(MISSING)
    for name, case in CASES.items():
        if names is None or name in names:
            yield name, try_case(case)


def try_case(case: Case) -> dict[str, Any]:
    """Run a case; return exit code, what was said, false vehicles, and whether all is right."""
    site = scene(case.scene)
    site.tiles()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        given = case.change(site, inputs_of(site), folder)
        arguments: list[object] = list(given.recordings)
        for pose in given.poses:
            arguments += ["--pose", pose]
        ended = own.run(
            "vehicles", *arguments, "--tiles", site.kept / "tiles.gpkg", "--map", given.map,
            "--scan", given.scan, "-o", folder / "vehicles",
        )  # fmt: skip
        lasting = doubled = 0
        if ended.code == 0:
            lasting, doubled = lasting_false(site, estimated_states(folder / "vehicles"))
    lines = [*ended.errors, *ended.warnings]
    told = not case.said or any(re.search(case.said, line, re.IGNORECASE) for line in lines)
    return {
        "code": ended.code,
        "said": lines[0] if lines else "",
        "lines": lines,
        "false": lasting,
        "doubled": doubled,
        "good": ended.code in case.codes and told and lasting == 0,
    }


def inputs_of(site: SceneFiles) -> Inputs:
    """Return a scene's own files, with its true poses."""
    return Inputs(
        recordings=site.recordings, poses=own.true_pose_files(site), map=site.map, scan=site.scan
    )


def lasting_false(site: SceneFiles, given: pd.DataFrame) -> tuple[int, int]:
    """Return how many vehicles are in sight for ten seconds on end that are none, or doubled."""
    scored = compared(site.tiles(), site.truth(), site.poses, site.traffic(), given)
    true, rows, _ = matched(scored)
    false = rows[rows["due"] & (rows["match"] < 0)]
    on_one = near(false, true, DOUBLE_M)
    return len(_lasting(false[~on_one])), len(_lasting(false[on_one]))


def _lasting(rows: pd.DataFrame) -> Integers:
    """Return the vehicles whose rows follow each other for ten seconds."""
    rows = rows.sort_values(["vehicle", "step"])
    begins = (rows["vehicle"].diff() != 0) | (rows["step"].diff() != EVERY)
    runs = rows.groupby(begins.cumsum())["vehicle"].agg(["first", "size"])
    long = runs["size"] * EVERY * STEP_S >= LASTS_S
    return np.unique(runs.loc[long, "first"].to_numpy(np.int64))


def _rewrite(
    given: Inputs, folder: Path, sensors: tuple[str, ...],
    change: Callable[[pd.DataFrame], pd.DataFrame],
) -> Inputs:  # fmt: skip
    """Return inputs with the recordings of some sensors, or of all, changed."""
    made = []
    for path in given.recordings:
        if sensors and path.stem not in sensors:
            made.append(path)
            continue
        change(pd.read_parquet(path)).to_parquet(folder / path.name)
        made.append(folder / path.name)
    return replace(given, recordings=made)


def _pose_off(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Put the second sensor a metre to the left of the lane that is nearest to it."""
    pose = gr.read_pose(given.poses[1])
    turn = _lane_heading(site.tiles(), pose)
    east, north = pose.easting - np.sin(turn), pose.northing + np.cos(turn)
    off = replace(pose, easting=float(east), northing=float(north))
    write_pose(off, folder / given.poses[1].name)
    return replace(given, poses=[given.poses[0], folder / given.poses[1].name, *given.poses[2:]])


def _lane_heading(tiles: gpd.GeoDataFrame, pose: gr.Pose) -> float:
    """Return the heading of the lane that lies nearest before a sensor, rad."""
    lines = middle_lines(tiles)
    ahead = pose.position[:2] + 30.0 * pose.R_map_sensor[:2, 0]
    near = int(np.hypot(*(lines.mean(axis=1) - ahead).T).argmin())
    across = lines[near, 1] - lines[near, 0]
    return float(np.arctan2(-across[0], across[1]))


def _clock_off(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    return _rewrite(given, folder, ("R2",), lambda table: table.assign(time=table["time"] + 0.2))


def _later(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Begin a minute later, in the middle of the queues."""
    return _rewrite(given, folder, (), lambda t: t[t["time"] >= t["time"].iloc[0] + 60.0])


def _as_it_is(_: SceneFiles, given: Inputs, __: Path) -> Inputs:
    return given


def _level(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Take the elevation away: x and y become slant ranges."""

    def flat(table: pd.DataFrame) -> pd.DataFrame:
        plane = np.hypot(table["x"], table["y"])
        more = np.sqrt(plane**2 + table["z"] ** 2) / np.maximum(plane, 1e-6)
        x, y = (table["x"] * more).astype("float32"), (table["y"] * more).astype("float32")
        return table.assign(x=x, y=y, z=np.float32("nan"))

    return _rewrite(given, folder, (), flat)


def _without_vehicles(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Take away what lies on vehicles: walkers, false returns and what stands are left."""
    poses = {pose.sensor: pose for pose in site.poses}
    states, made = site.traffic().states, []
    for path in given.recordings:
        table = pd.read_parquet(path)
        blank = beside_vehicles(table, poses[path.stem], states, BESIDE_M)
        table.loc[blank, ["x", "y", "z", "range_rate", "rcs"]] = np.float32("nan")
        first = ~table["time"].duplicated() | table["x"].notna()
        table[first].to_parquet(folder / path.name)
        made.append(folder / path.name)
    return replace(given, recordings=made)


def _nothing_moves(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    given = _without_vehicles(site, given, folder)
    return _rewrite(given, folder, (), lambda t: t[~(t["range_rate"].abs() > MOVING_MPS)])


def _no_doppler(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    return _rewrite(given, folder, (), lambda t: t.assign(range_rate=np.float32("nan")))


def _repeated(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Send each frame twice."""
    return _rewrite(
        given, folder, (), lambda t: pd.concat([t, t]).sort_values("time", kind="stable")
    )


def _overlapping(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Cut the first recording in two that have twenty seconds in common."""
    table = pd.read_parquet(given.recordings[0])
    middle = (table["time"].iloc[0] + table["time"].iloc[-1]) / 2.0
    paths = [folder / "R1a.parquet", folder / "R1b.parquet"]
    table[table["time"] < middle + 10.0].to_parquet(paths[0])
    table[table["time"] > middle - 10.0].to_parquet(paths[1])
    poses = [given.poses[0], given.poses[0], *given.poses[1:]]
    return replace(given, recordings=[*paths, *given.recordings[1:]], poses=poses)


def _gap(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Leave out half a minute."""

    def cut(table: pd.DataFrame) -> pd.DataFrame:
        after = table["time"] - table["time"].iloc[0]
        kept: pd.DataFrame = table[~after.between(40.0, 70.0)]
        return kept

    return _rewrite(given, folder, (), cut)


def _hours_apart(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    return _rewrite(given, folder, ("R2",), lambda t: t.assign(time=t["time"] + 7200.0))


def _other_map(_: SceneFiles, given: Inputs, __: Path) -> Inputs:
    return replace(given, map=scene("motorway").map)


def _other_scan(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Move the scan five kilometres away."""
    las = laspy.read(given.scan)
    las.x = np.asarray(las.x) + 5000.0
    las.write(folder / "scan.laz")
    return replace(given, scan=folder / "scan.laz")


def _cut_file(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Give the first half of a recording's bytes."""
    content = given.recordings[0].read_bytes()
    (folder / "R1.parquet").write_bytes(content[: len(content) // 2])
    return replace(given, recordings=[folder / "R1.parquet", *given.recordings[1:]])


CASES: Mapping[str, Case] = {
    "nothing wrong (light)": Case(scene="light", change=_as_it_is),
    "nothing wrong (harsh)": Case(scene="harsh", change=_as_it_is),
    "a pose 1 m off": Case(scene="harsh", change=_pose_off, said="R2"),
    "a clock 0.2 s off": Case(scene="harsh", change=_clock_off),
    "a start in standing traffic": Case(scene="gridlock", change=_later),
    "parked rows beside the lane": Case(scene="parked", change=_as_it_is),
    "no elevation": Case(scene="light", change=_level),
    "no vehicles, all false returns": Case(scene="light", change=_without_vehicles),
    "nothing moves": Case(scene="light", change=_nothing_moves, said="mov"),
    "no Doppler": Case(scene="light", change=_no_doppler, codes=(3, 4), said="doppler|range"),
    "each frame twice": Case(scene="light", change=_repeated, codes=(0, 3)),
    "two recordings that overlap": Case(scene="light", change=_overlapping, codes=(0, 3)),
    "half a minute missing": Case(scene="light", change=_gap),
    "sensors two hours apart": Case(scene="harsh", change=_hours_apart),
    "the map of another place": Case(scene="light", change=_other_map, codes=(3,), said="map"),
    "the scan of another place": Case(scene="light", change=_other_scan, codes=(3,)),
    "half of a file": Case(scene="light", change=_cut_file, codes=(3,), said="R1"),
}
