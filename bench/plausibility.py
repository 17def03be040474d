"""Check of poses and recordings: which gross errors it names, and whether it accepts right poses.

Sensors of the simulated sites (`simulated.py`) and of random places (`bench/localization`) get two
dozen errors, one at a time. An error passes *silent*, is named by a *wrong cause*, by the *right
cause*, as *unknown*, or there is *too little* traffic to tell. True poses, also 0.3 m off, must not
be refused.

With `--light` a third of the traffic is there: in the simulated sites the detections of two thirds
of the vehicles are removed, random places have a third of the demand.

Example: ``python bench/plausibility.py --random 2000 textbook:2002 --lines``
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from figures import ROOT, table
from scipy.spatial import cKDTree
from simulated import sites, true_pose

import gis_radar as gr
from gis_radar.base import Floats
from gis_radar.calibration import FITS, UNKNOWN, Finding, LaneMap
from gis_radar.calibration.check.excerpt import Excerpt, read_excerpts
from gis_radar.calibration.check.explanations import BESIDE_LANES
from gis_radar.calibration.check.fitted_pose import OFF_SIGMAS, fit_pose, mistakes_apart, turns_of
from gis_radar.calibration.check.plausibility import judge
from gis_radar.calibration.findings import UNKNOWN_CAUSE
from gis_radar.poses import as_track

sys.path.insert(0, str(ROOT / "bench" / "localization"))

OUTCOMES = ("silent", "wrong cause", "right cause", "unknown", "too little")
# Names of the cases without an error, and of errors that not every traffic shows.
RIGHT, SMALL = ("right", "0.3 m off"), ("1 m off", "1 deg off")
LEAST_PITCH_DEG = 0.75  # the wrong sign of a smaller pitch is no gross error
# Light traffic: share of the vehicles that stay; how far from its outline a vehicle's detections
# may lie; the longest half of a vehicle; vehicles that are tried for each detection.
LIGHT_SHARE, OUTLINE_MARGIN_M, HALF_LENGTH_M, NEAREST_VEHICLES = 1.0 / 3.0, 1.0, 10.0, 6
STEP_S, START_S = 0.05, 1.7e9  # between true states; begin of the towns' times, UNIX seconds
Change = Callable[[pd.DataFrame], pd.DataFrame]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A sensor with one error, or none.

    Parameters
    ----------
    name : str
        Name of the error.
    rows : DataFrame
        The recording.
    pose : Pose
        The pose that is given to the check.
    says : tuple of str
        Texts of which one is in every right cause.
    lanes : LaneMap, optional
        Lanes in place of the site's.
    """

    name: str
    rows: pd.DataFrame
    pose: gr.Pose
    says: tuple[str, ...] = ()
    lanes: LaneMap | None = None


@dataclass(frozen=True, kw_only=True)
class Place:
    """A site: its lanes, and recordings and true poses of its sensors."""

    name: str
    lanes: LaneMap
    rows: dict[str, pd.DataFrame]
    poses: dict[str, gr.Pose]


def read_place(folder: Path, name: str) -> Place:
    """Read a site's folder."""
    roads = gr.read_map(next(iter(sorted(folder.glob("*.osm")))))
    road = np.load(folder / "road.npy") if (folder / "road.npy").exists() else np.empty((0, 3))
    names = sorted(path.stem for path in folder.glob("R?.parquet"))
    return Place(
        name=name, lanes=LaneMap(lanelets=roads.lanelets, road=road),
        rows={each: pd.read_parquet(folder / f"{each}.parquet") for each in names},
        poses={each: true_pose(folder, each) for each in names},
    )  # fmt: skip


def thin_out(place: Place, folder: Path) -> Place:
    """Return a site without the detections of two thirds of its vehicles."""
    true = pd.read_parquet(folder / "vehicles.parquet")
    true = true.rename(columns={"length": "L", "width": "W"})
    ids = np.unique(true["id"])
    kept = ids[np.random.default_rng(0).random(len(ids)) < LIGHT_SHARE]
    offset_s = START_S if true["t"].iloc[0] < START_S else 0.0
    step = np.rint((true["t"].to_numpy() + offset_s) / STEP_S)
    centre = true[["easting", "northing"]].to_numpy()
    origin = centre[0]
    apart_m = 1000.0 * (step - step[0])  # a third coordinate: other steps are far away
    tree = cKDTree(np.column_stack([centre - origin, apart_m]))
    stays = np.append(true["id"].isin(kept).to_numpy(), True)
    sizes = true[["L", "W", "heading"]].to_numpy()

    def seen(rows: pd.DataFrame, pose: gr.Pose) -> pd.DataFrame:
        points = pose.to_map(np.nan_to_num(rows[["x", "y", "z"]].to_numpy(np.float64)))[:, :2]
        at_m = 1000.0 * (np.rint(rows["time"].to_numpy() / STEP_S) - step[0])
        places = np.column_stack([points - origin, at_m])
        near = tree.query(places, NEAREST_VEHICLES, distance_upper_bound=HALF_LENGTH_M)[1]
        nearest, least_m = np.full(len(rows), len(true)), np.full(len(rows), OUTLINE_MARGIN_M)
        for number in np.asarray(near).T:
            there = number < len(true)
            one = np.where(there, number, 0)
            turn = np.radians(sizes[one, 2])
            gap = points - centre[one]
            ahead = np.abs(gap[:, 0] * np.cos(turn) + gap[:, 1] * np.sin(turn))
            aside = np.abs(gap[:, 1] * np.cos(turn) - gap[:, 0] * np.sin(turn))
            beyond = np.maximum(ahead - sizes[one, 0] / 2.0, aside - sizes[one, 1] / 2.0)
            closer = there & (beyond < least_m)
            nearest[closer], least_m[closer] = number[closer], beyond[closer]
        return pd.DataFrame(rows[stays[nearest]])

    return replace(place, rows={n: seen(r, place.poses[n]) for n, r in place.rows.items()})


def other_map_at(place: Place, sensor: str, other: Place, there: str) -> LaneMap:
    """Return the lanes of another place, moved so that its sensor stands where this one does."""
    by = place.poses[sensor].position - other.poses[there].position
    lanelets = other.lanes.lanelets.copy()
    for name in ("centre", "geometry"):
        deep = lanelets[name].has_z.any()
        shift = by if deep else by[:2]
        moved = shapely.transform(
            lanelets[name].to_numpy(), partial(np.add, shift), include_z=bool(deep)
        )
        lanelets[name] = gpd.GeoSeries(moved, index=lanelets.index, crs=lanelets.crs)
    return LaneMap(lanelets=lanelets, road=other.lanes.road + by)


def scaled(factor: float, *columns: str) -> Change:
    """Return a change that multiplies columns."""
    return lambda rows: rows.assign(**{c: rows[c] * np.float32(factor) for c in columns})


def freeze(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows in which one frame repeats for a quarter of the time."""
    frames = np.unique(rows["time"])
    first, last = frames[len(frames) // 3], frames[len(frames) // 3 + len(frames) // 4]
    one = rows[rows["time"] == first]
    again = [one.assign(time=at) for at in frames[(frames >= first) & (frames < last)]]
    parts = [rows[rows["time"] < first], *again, rows[rows["time"] >= last]]
    return pd.DataFrame(pd.concat(parts))


def join_halves(rows: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Return rows whose second half is from another sensor."""
    middle = (rows["time"].iloc[0] + rows["time"].iloc[-1]) / 2.0
    other = other.assign(time=other["time"] - other["time"].iloc[0] + rows["time"].iloc[0])
    return pd.DataFrame(pd.concat([rows[rows["time"] < middle], other[other["time"] >= middle]]))


def moved(pose: gr.Pose, **by: float) -> gr.Pose:
    """Return a pose with these amounts added to its fields."""
    return replace(pose, **{name: getattr(pose, name) + step for name, step in by.items()})


def cases(
    place: Place, sensor: str, foreign: pd.DataFrame, other_map: LaneMap | None
) -> Iterator[Case]:
    """Yield a sensor without and with each error; `foreign` is another sensor's recording."""
    rows, pose = place.rows[sensor], place.poses[sensor]
    alone = len(place.poses) == 1
    off, lengths = ("its pose is off", "its pose may be off"), ("ranges are",)
    xyz = ("x", "y", "z")

    def case(name: str, *says: str, to: gr.Pose = pose, by: Change | None = None) -> Case:
        return Case(name=name, rows=rows if by is None else by(rows), pose=to, says=says)

    yield case(RIGHT[0])
    yield case(RIGHT[1], to=moved(pose, easting=0.2, northing=-0.22))
    yield case("yaw + 180", "yaw is off by 180", to=moved(pose, yaw=180.0))
    yield case("bearing as yaw", "its yaw is a bearing", to=replace(pose, yaw=90.0 - pose.yaw))
    yield case("yaw + 40", *off, to=moved(pose, yaw=40.0))
    yield case("12 m off", *off, to=moved(pose, easting=9.0, northing=-8.0))
    yield case(SMALL[0], *off, to=moved(pose, easting=0.7, northing=-0.7))
    yield case(SMALL[1], *off, to=moved(pose, yaw=1.0))
    if abs(pose.pitch) > LEAST_PITCH_DEG:
        turned = replace(pose, pitch=-pose.pitch)
        yield case("pitch's sign", "pitch has the wrong sign", *off, "pitch is", to=turned)
    yield case("roll + 180", "roll is off by 180", to=moved(pose, roll=180.0))
    yield case("3 m too high", "height is", to=moved(pose, height=3.0))
    yield case("3 m too low", "height is", to=moved(pose, height=-3.0))
    swapped = {"x": rows["y"], "y": rows["x"]}
    yield case("x, y swapped", "x and y are swapped", by=lambda r: r.assign(**swapped))
    yield case("y mirrored", "left and right", by=scaled(-1.0, "y"))
    yield case("km/h", "range rates look like km/h", by=scaled(3.6, "range_rate"))
    yield case("mph", "range rates look like mph", by=scaled(2.23694, "range_rate"))
    yield case("halved", "range rates look halved", by=scaled(0.5, "range_rate"))
    yield case("sign", "range rates look positive", by=scaled(-1.0, "range_rate"))
    absolute = {"range_rate": rows["range_rate"].abs()}
    yield case("absolute", "range rates look like absolute", by=lambda r: r.assign(**absolute))
    yield case("cm/s", "range rates look like cm/s", by=scaled(100.0, "range_rate"))
    yield case("ranges + 5 %", *lengths, by=scaled(1.05, *xyz))
    yield case("yards", *lengths, "positions look like yards", by=scaled(1.0 / 0.9144, *xyz))
    yield case("feet", "positions look like feet", by=scaled(3.28084, *xyz))
    since = rows["time"] - rows["time"].iloc[0]
    fast = {"time": rows["time"].iloc[0] + since / 2.0}
    yield case("time x 2", "range rates look halved", by=lambda r: r.assign(**fast))
    another = () if alone else ("recording and pose are mixed up",)
    yield case("another's recording", *another, by=lambda _: foreign)
    since_half = ("from", "until")
    yield case("another's from half", *since_half, by=lambda r: join_halves(r, foreign))
    yield case("frozen", "the recording is frozen", by=freeze)
    if other_map is not None:
        yield replace(case("another's map"), lanes=other_map)


def outcome(case: Case, found: Finding) -> str:
    """Return one of `OUTCOMES`; empty for a right pose that passes."""
    if found.verdict == UNKNOWN:
        return "too little"
    if not found.cause:
        return "silent" if case.name not in RIGHT else ""
    if any(part in found.cause for part in case.says):
        return "right cause"
    return "unknown" if found.cause.endswith((UNKNOWN_CAUSE, BESIDE_LANES.text)) else "wrong cause"


def judged(place: Place, sensor: str, case: Case) -> tuple[Finding, Excerpt, float]:
    """Return the finding of the check, the excerpt that it used, and its CPU seconds."""
    others = {name: pose for name, pose in place.poses.items() if name != sensor}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.parquet"
        case.rows.to_parquet(path, index=False)
        begin = time.process_time()
        excerpts = read_excerpts([gr.open_recording(path)], [as_track(case.pose)])
        found, excerpt = judge(sensor, excerpts, case.lanes or place.lanes, others)
    return found, excerpt, time.process_time() - begin


def shown_by_traffic(excerpt: Excerpt, lanes: LaneMap) -> dict[str, bool]:
    """Return whether the traffic shows an error of a metre in any direction, and of a degree.

    It does where three standard errors are less: of the place if the yaw is right, and of the yaw
    if the place is right. Along a single street they mostly are not.
    """
    fitted = fit_pose(excerpt, lanes)
    if fitted is None:
        return dict.fromkeys(SMALL, False)
    of_place, of_yaw = (each for each, _ in mistakes_apart(fitted.seen, fitted.centre))
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(of_place.covariance[:2, :2])[-1]))
    sigma_deg = turns_of(fitted.pose, of_yaw)[0][1]
    return dict(zip(SMALL, (OFF_SIGMAS * sigma_m < 1.0, OFF_SIGMAS * sigma_deg < 1.0), strict=True))


def _folders(numbers: list[str], *, known: bool, light: bool) -> list[tuple[str, Path]]:
    """Return names and folders of the sites, and of random places by CONDITIONS:NUMBER."""
    from random_places import random_place  # noqa: PLC0415 - needs the simulator

    folders = [(each.name, each) for each in sites("town01", "town02", "town04")] if known else []
    for number in numbers:
        conditions, _, seed = number.rpartition(":")
        conditions = conditions or ("light" if light else "drivers as recorded")
        folders.append((f"{conditions} {seed}", random_place((int(seed), conditions))))
    return folders


def trials(everyone: list[tuple[Place, str]]) -> Iterator[tuple[Place, str, Case]]:
    """Yield each case of each sensor; foreign recordings and maps are of its neighbours."""
    for number, (place, sensor) in enumerate(everyone):
        there, other = everyone[number - 1] if len(place.poses) == 1 else (place, sensor)
        if there is place:
            names = sorted(place.poses)
            other = names[(names.index(sensor) + 1) % len(names)]
        far, far_sensor = next(
            (each for each in everyone[number:] + everyone if each[0] is not place), everyone[0]
        )
        other_map = None if far is place else other_map_at(place, sensor, far, far_sensor)
        for case in cases(place, sensor, there.rows[other], other_map):
            if len(everyone) > 1 or not case.name.startswith("another's"):
                yield place, sensor, case


@dataclass(kw_only=True)
class Tally:
    """Counts of outcomes: by error, of small errors, of right poses; and CPU seconds."""

    errors: dict[str, Counter[str]] = field(default_factory=dict)
    small: Counter[str] = field(default_factory=Counter)
    right: Counter[str] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)

    def add(self, case: Case, found: Finding, shown: dict[str, bool]) -> str:
        """Count a case and return its outcome; `shown` is of :func:`shown_by_traffic`."""
        result = outcome(case, found)
        if case.name in RIGHT:
            self.right["all"] += 1
            self.right["refused"] += found.verdict not in {FITS, UNKNOWN}
            self.right["doubted"] += found.verdict == FITS and bool(found.cause)
            return result
        self.errors.setdefault(case.name, Counter())[result] += 1
        if case.name in shown:
            told = result == "right cause"
            self.small["named" if told else "missed" if shown[case.name] else "open"] += 1
        return result

    def print(self) -> None:
        """Print the table and the totals."""
        rows = [
            [name, *(str(each[o] or "") for o in OUTCOMES)] for name, each in self.errors.items()
        ]
        total = sum(self.errors.values(), Counter[str]())
        rows.append(["all", *(str(total[o]) for o in OUTCOMES)])
        print(table(["error", *OUTCOMES], rows))
        print(
            f"a metre or a degree off: {self.small['named']} named, {self.small['open']} open by "
            f"what the traffic shows, {self.small['missed']} not named though it would show"
        )
        print("right poses: {all}, refused {refused}, doubted {doubted}".format_map(self.right))
        took: Floats = np.array(self.seconds)
        print(f"processor: median {np.median(took):.2f} s a sensor, at most {took.max():.2f} s")


def main() -> None:
    """Try all errors on all sensors; print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--random", nargs="*", default=[], help="NUMBER or CONDITIONS:NUMBER")
    parser.add_argument("--no-known", action="store_true", help="leave out the simulated sites")
    parser.add_argument("--light", action="store_true", help="with a third of the traffic")
    parser.add_argument("--only", nargs="*", help="names of errors")
    parser.add_argument("--lines", action="store_true", help="print the finding of each case")
    given = parser.parse_args()
    folders = _folders(given.random, known=not given.no_known, light=given.light)
    places = [read_place(path, name) for name, path in folders]
    if given.light:
        places = [
            thin_out(place, path) if (path / "vehicles.parquet").exists() else place
            for place, (_, path) in zip(places, folders, strict=True)
        ]
    tally, shown = Tally(), dict[str, bool]()
    everyone = [(each, name) for each in places for name in each.poses]
    for place, sensor, case in trials(everyone):
        if given.only and case.name not in given.only:
            continue
        found, excerpt, took_s = judged(place, sensor, case)
        tally.seconds.append(took_s)
        if case.name == RIGHT[0]:
            shown = shown_by_traffic(excerpt, place.lanes)
        result = tally.add(case, found, shown)
        if given.lines:
            line = found.text_with_advice
            print(f"{place.name} {sensor} {case.name} [{result}] {took_s:.1f}s {line}", flush=True)
    tally.print()


if __name__ == "__main__":
    main()
