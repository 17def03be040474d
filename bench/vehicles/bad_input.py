"""Bad input: scenes changed so that something is wrong, and what the package makes of them.

Each has what is expected: the exit code, words of a warning or error, and in all cases no false
vehicle that lasts over ten seconds: one with no true vehicle within eight metres, or as far from
the middle of a long one as its ends are farther than a car's. Second ones on a true vehicle are
counted beside it; so are those of the scenes as they are, to compare with.
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
from found import estimated_states
from peers import beside_vehicles
from scenes import SceneFiles, scene
from tracks import EVERY, compared, matched
from true_occupancy import middle_lines

import gis_radar as gr
from gis_radar.arrays import Integers
from gis_radar.poses.files import write_pose
from gis_radar.steps import STEP_S
from gis_radar.tiles.lookup import with_road_heights
from gis_radar.tracking.batches import POSE_HINT

LASTS_S = 10.0
MOVING_MPS = 0.15
CAR_M = 4.6
MOST_SPARE = 2  # a bound needs two nodes
HALF_S = 90.0  # of the scene that is cut in two
BESIDE_M = 5.0  # a radar as recorded sees vehicles so far from where they are


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What a command is given.

    Parameters
    ----------
    recordings, poses : list of Path
        In order.
    map, tiles : Path
        The lanes.
    scan : Path, optional
        What stands beside them.
    """

    recordings: list[Path]
    poses: list[Path]
    map: Path
    tiles: Path
    scan: Path | None


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
    back : callable, optional
        Takes the steps of what was found to those of the truth, where the change moved time.
    poses_true : bool
        None may be blamed then.
    """

    scene: str
    change: Change
    codes: tuple[int, ...] = (0,)
    said: str = ""
    poses_true: bool = True
    back: Callable[[SceneFiles, Integers], Integers] | None = None


def try_all(names: list[str] | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each case and how it went."""
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
        ended = own.run(*_command(given, folder / "site"))
        lasting = doubled = 0
        if ended.code == 0:
            found = estimated_states(gr.open_dataset(folder / "site"))
            if case.back is not None:
                found = found.assign(step=case.back(site, found["step"].to_numpy()))
            lasting, doubled = lasting_false(site, found)
    lines = [*ended.errors, *ended.warnings]
    blamed = case.poses_true and any(POSE_HINT in line for line in lines)
    told = not case.said or any(re.search(case.said, line, re.IGNORECASE) for line in lines)
    return {
        "code": ended.code,
        "said": lines[0] if lines else "",
        "lines": lines,
        "false": lasting,
        "doubled": doubled,
        "good": ended.code in case.codes and told and lasting == 0 and not blamed,
    }


def _command(given: Inputs, output: Path) -> list[object]:
    """Return the words of a command."""
    words: list[object] = ["measure", *given.recordings]
    for pose in given.poses:
        words += ["--pose", pose]
    words += ["--tiles", given.tiles, "--map", given.map]
    words += [] if given.scan is None else ["--scan", given.scan]
    return [*words, "-o", output]


def inputs_of(site: SceneFiles) -> Inputs:
    """Return a scene's own files, with its true poses."""
    return Inputs(
        recordings=site.recordings, poses=own.true_pose_files(site), map=site.map,
        tiles=site.kept / "tiles.gpkg", scan=site.scan,
    )  # fmt: skip


def lasting_false(site: SceneFiles, given: pd.DataFrame) -> tuple[int, int]:
    """Return how many vehicles are in sight for ten seconds on end that are none, or doubled."""
    scored = compared(site.tiles(), site.truth(), site.poses, site.traffic(), given)
    true, rows, _ = matched(scored)
    false = rows[rows["due"] & (rows["match"] < 0)]
    on_one = near(false, _whole(true), DOUBLE_M)
    return len(_lasting(false[~on_one])), len(_lasting(false[on_one]))


def _whole(true: pd.DataFrame) -> pd.DataFrame:
    """Return true vehicles as places each a car's length along them."""
    heading, length = true["heading"].to_numpy(), true["length"].to_numpy()
    parts = []
    for share in (-1.0, 0.0, 1.0):
        along = share * np.maximum(0.5 * (length - CAR_M), 0.0)
        east = true["easting"] + along * np.cos(heading)
        parts.append(true.assign(easting=east, northing=true["northing"] + along * np.sin(heading)))
    return pd.concat(parts, ignore_index=True)


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


def _scan(change: Callable[[SceneFiles, Any], Any]) -> Change:
    """Return a change of the scan."""

    def changed(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
        change(site, laspy.read(site.scan)).write(folder / "scan.laz")
        return replace(given, scan=folder / "scan.laz")

    return changed


def _far_away(_: SceneFiles, las: Any) -> Any:
    """Move it five kilometres away."""
    las.x = np.asarray(las.x) + 5000.0
    return las


def _other_datum(_: SceneFiles, las: Any) -> Any:
    """Give ellipsoidal heights for those over the sea."""
    las.z = np.asarray(las.z) + 47.0
    return las


def _half(site: SceneFiles, las: Any) -> Any:
    """Keep what lies left of where the first sensor looks."""
    pose = site.poses[0]
    ahead = pose.R_map_sensor[:2, 0]
    east, north = np.asarray(las.x) - pose.easting, np.asarray(las.y) - pose.northing
    las.points = las.points[ahead[0] * north - ahead[1] * east > 0.0]
    return las


def _older(site: SceneFiles, las: Any) -> Any:
    """Leave out what stands high within a hundred metres: it was built since."""
    x, y, z = (np.asarray(each) for each in (las.x, las.y, las.z))
    away = np.hypot(x - site.poses[0].easting, y - site.poses[0].northing)
    las.points = las.points[(away > 100.0) | (z < np.quantile(z, 0.5) + 2.0)]
    return las


def _no_scan(_: SceneFiles, given: Inputs, __: Path) -> Inputs:
    return replace(given, scan=None)


def _one_sensor(_: SceneFiles, given: Inputs, __: Path) -> Inputs:
    return replace(given, recordings=given.recordings[:1], poses=given.poses[:1])


def _no_heights(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    problems = gpd.read_file(given.tiles, layer="problems")
    flat = site.tiles().assign(height_m=np.nan)
    gr.write_tiles(flat, folder / "tiles.gpkg", problems=problems)
    return replace(given, tiles=folder / "tiles.gpkg")


def _with_map(site: SceneFiles, given: Inputs, folder: Path, text: str) -> Inputs:
    """Take another map of the same place, and the tiles of that."""
    (folder / "map.osm").write_text(text, encoding="utf-8")
    roads = gr.read_map(folder / "map.osm", crs=site.tiles().crs)
    tiles = with_road_heights(gr.make_tiles(roads), gr.read_road(site.scan, roads.crs))
    gr.write_tiles(tiles, folder / "tiles.gpkg", problems=roads.problems)
    return replace(given, map=folder / "map.osm", tiles=folder / "tiles.gpkg")


def _no_successors(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Take the last node of each bound away: no lanelet begins where another one ends."""

    def shorter(way: re.Match[str]) -> str:
        nodes = re.findall(r"<nd [^>]*>", way[0])
        return way[0].replace(nodes[-1], "", 1) if len(nodes) > MOST_SPARE else way[0]

    text = re.sub(r"<way .*?</way>", shorter, site.map.read_text(encoding="utf-8"), flags=re.DOTALL)
    return _with_map(site, given, folder, text)


def _left_hand(site: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Drive on the left: lanes the other way round, and time runs backward."""
    text = site.map.read_text(encoding="utf-8")
    swapped = {"left": "right", "right": "left"}
    text = re.sub(r"role=(.)(left|right)\1", lambda m: f'role="{swapped[m[2]]}"', text)

    def backward(table: pd.DataFrame) -> pd.DataFrame:
        first = np.round(2.0 * table["time"].iloc[0])  # an even sum of begin and end
        back = table.assign(time=first + 500.0 - table["time"], range_rate=-table["range_rate"])
        return back.iloc[::-1].sort_values("time", kind="stable")

    given = _rewrite(given, folder, (), backward)
    return _with_map(site, given, folder, text)


def _steps_back(site: SceneFiles, step: Integers) -> Integers:
    """Return steps as time runs, of those that run backward."""
    begin = pd.read_parquet(site.recordings[0], columns=["time"])["time"].iloc[0]
    whole = round((np.round(2.0 * begin) + 500.0) / STEP_S)
    return np.asarray(whole - step)


def _hour_missing(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Record the second half an hour later."""

    def cut(table: pd.DataFrame) -> pd.DataFrame:
        late = table["time"] - table["time"].iloc[0] > HALF_S
        return table.assign(time=table["time"] + 3600.0 * late)

    return _rewrite(given, folder, (), cut)


def _without_hour(site: SceneFiles, step: Integers) -> Integers:
    """Return steps without the hour that is missing."""
    begin = pd.read_parquet(site.recordings[0], columns=["time"])["time"].iloc[0]
    late = step * STEP_S > begin + HALF_S + 60.0
    return np.asarray(step - round(3600.0 / STEP_S) * late)


def _cut_file(_: SceneFiles, given: Inputs, folder: Path) -> Inputs:
    """Give the first half of a recording's bytes."""
    content = given.recordings[0].read_bytes()
    (folder / "R1.parquet").write_bytes(content[: len(content) // 2])
    return replace(given, recordings=[folder / "R1.parquet", *given.recordings[1:]])


CASES: Mapping[str, Case] = {
    "nothing wrong (light)": Case(scene="light", change=_as_it_is),
    "nothing wrong (harsh)": Case(scene="harsh", change=_as_it_is),
    "a pose 1 m off": Case(
        scene="harsh", change=_pose_off, said=f"R2: .*{re.escape(POSE_HINT)}", poses_true=False
    ),
    "a clock 0.2 s off": Case(scene="harsh", change=_clock_off),
    "a start in standing traffic": Case(scene="gridlock", change=_later),
    "parked rows beside the lane": Case(scene="parked", change=_as_it_is),
    "no elevation": Case(scene="light", change=_level),
    "no vehicles, all false returns": Case(scene="light", change=_without_vehicles),
    "nothing moves": Case(
        scene="light", change=_nothing_moves, said="no vehicle moves in these recordings"
    ),
    "no Doppler": Case(
        scene="light", change=_no_doppler, codes=(3,), said=r"R1\.parquet: has no range rates"
    ),
    "each frame twice": Case(scene="light", change=_repeated),
    "two recordings that overlap": Case(
        scene="light", change=_overlapping,
        said=r"R1b\.parquet: \d+ rows are of a time that another recording of R1 holds",
    ),
    "half a minute missing": Case(scene="light", change=_gap),
    "sensors two hours apart": Case(scene="harsh", change=_hours_apart),
    "the map of another place": Case(
        scene="light", change=_other_map, codes=(3,), said=r"lacks lanelet \d+ of the tiles"
    ),
    "the scan of another place": Case(
        scene="light", change=_scan(_far_away), codes=(3,), said="no point within 200 m of R1"
    ),
    "a scan with other heights": Case(
        scene="light", change=_scan(_other_datum), codes=(3,),
        said=r"\.laz: its road is \+47\.\d m from the height of the tiles: two vertical systems",
    ),
    "a scan of half of the view": Case(
        scene="light", change=_scan(_half), said=r"the scan covers \d+% of the view of R1"
    ),
    "a scan older than buildings": Case(scene="light", change=_scan(_older)),
    "no scan": Case(scene="light", change=_no_scan),
    "tiles without heights": Case(scene="light", change=_no_heights, said="tiles have no heights"),
    "lanes without successors": Case(scene="light", change=_no_successors),
    "left-hand traffic": Case(scene="light", change=_left_hand, back=_steps_back),
    "one sensor of two": Case(scene="harsh", change=_one_sensor),
    "an hour missing": Case(scene="light", change=_hour_missing, back=_without_hour),
    "half of a file": Case(
        scene="light", change=_cut_file, codes=(3,), said=r"R1\.parquet: cannot be read"
    ),
}  # fmt: skip
