"""Measure how far the clocks of sensors are ahead, from the traffic that they see in common."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np

from gis_radar.base import (
    QUIET,
    Floats,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    UsageError,
    atomic_write,
    card,
    metric_crs,
    read_json,
    require_same,
    seconds_from_iso,
)
from gis_radar.calibration.timing.clock_offsets import (
    ClockOffset,
    NoCommonTrafficError,
    measured_offset,
)
from gis_radar.calibration.timing.lane_detections import (
    LaneDetections,
    lanelets_of,
    read_lane_detections,
)
from gis_radar.poses import Pose, PoseTrack, as_track
from gis_radar.recordings import Recording, as_recording

CONTRADICTION_SIGMAS = 4.0  # a warning names a larger contradiction between pairs of sensors
# A drift below so many of its sigmas counts as none: over hours it would only carry noise.
DRIFT_SIGMAS = 3.0

MOST_DRIFT_PPM = 12_000.0  # a hundred times that of a bad quartz: a unit is mistaken
NUMBERS = ("offset_s", "sigma_s", "drift_ppm", "drift_sigma_ppm")  # of a clock in a file of clocks


@dataclass(frozen=True, kw_only=True)
class SensorClock:
    """How far the clock of a sensor is ahead of the reference.

    Parameters
    ----------
    offset_s : float
        Seconds by which it is ahead at the time `at`; its time stamps are later by that much.
    drift_ppm : float
        By how much it runs fast, microseconds a second.
    at : float
        UNIX seconds on its own clock at which the offset holds.
    sigma_s, drift_sigma_ppm : float
        One standard deviation of offset and drift; NaN where not known.
    """

    offset_s: float
    drift_ppm: float = 0.0
    at: float = 0.0
    sigma_s: float = math.nan
    drift_sigma_ppm: float = math.nan

    def __post_init__(self) -> None:
        if not (math.isfinite(self.offset_s) and math.isfinite(self.at)):
            raise InputError("clock offset is {} s, expected a number", self.offset_s)
        if not abs(self.drift_ppm) <= MOST_DRIFT_PPM:
            raise InputError(
                "clock drift is {} ppm, expected at most {:g}", self.drift_ppm, MOST_DRIFT_PPM
            )

    def corrected(self, time: Floats) -> Floats:
        """Return times (UNIX seconds) of this clock as the reference would have stamped them."""
        ahead = self.offset_s + self.drift_ppm * 1e-6 * (np.asarray(time) - self.at)
        return np.asarray(time - ahead, dtype=np.float64)

    def shown(self, time: Floats) -> Floats:
        """Return times (UNIX seconds) of the reference as this clock would have stamped them."""
        drift = self.drift_ppm * 1e-6
        return np.asarray((time + self.offset_s - drift * self.at) / (1.0 - drift), np.float64)

    def as_dict(self) -> dict[str, Any]:
        """Return the clock's entry in a file of clocks; unknown values are left out."""
        moment = datetime.fromtimestamp(self.at, UTC).isoformat(timespec="milliseconds")
        numbers = {name: getattr(self, name) for name in NUMBERS}
        known = {name: value for name, value in numbers.items() if math.isfinite(value)}
        return known | {"at": moment.replace("+00:00", "Z")}


Edges = dict[tuple[str, str], ClockOffset]  # by (one, other): how far the other one is ahead
Reasons = dict[tuple[str, str], NoAnswerError]  # of the pairs that have no offset


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """How far each clock is ahead of the reference.

    Parameters
    ----------
    reference : str
        The sensor whose clock counts as right.
    clocks : dict
        By sensor, the reference too; sensors without an answer are left out.
    refused : dict
        By sensor without an answer: the reason.
    pairs : dict
        By pair of sensors: the offset measured between them.
    """

    reference: str
    clocks: dict[str, SensorClock]
    refused: dict[str, str]
    pairs: Edges

    def figures(self) -> dict[str, str]:
        """Return one line of text for each sensor."""
        lines = {"reference": self.reference}
        for sensor, clock in self.clocks.items():
            if sensor != self.reference:
                drift = (
                    Text("drift {:+.0f} ppm", clock.drift_ppm)
                    if clock.drift_ppm
                    else Text("no drift")
                )
                lines[sensor] = Text(
                    "{:+.3f} s (sigma {:.3f}), {} (sigma {:.0f} ppm)",
                    clock.offset_s,
                    clock.sigma_s,
                    drift,
                    clock.drift_sigma_ppm,
                )
        return lines | {sensor: Text("no answer: {}", why) for sensor, why in self.refused.items()}

    def write(self, path: str | Path) -> Path:
        """Write a file of clocks (JSON), by which `measure` corrects times."""
        pairs = [
            {"one": one, "other": other, "offset_s": offset.offset_s, "sigma_s": offset.sigma_s,
             "vehicles": offset.vehicles}
            for (one, other), offset in self.pairs.items()
        ]  # fmt: skip
        record = {
            "reference": self.reference,
            "clocks": {sensor: clock.as_dict() for sensor, clock in self.clocks.items()},
            "refused": self.refused,
            "pairs": pairs,
        }
        with atomic_write(Path(path)) as part:
            text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
            part.write_text(text + "\n", encoding="utf-8")
        return Path(path)

    def _repr_html_(self) -> str:
        return card("Clocks: ahead of the reference", self.figures())

    def __repr__(self) -> str:
        return f"Clocks({'; '.join(f'{name}: {text}' for name, text in self.figures().items())})"


def read_clocks(path: str | Path) -> dict[str, SensorClock]:
    """Read a file of clocks: JSON with `clocks`, by sensor `offset_s`, `drift_ppm`, `at`.

    Raises
    ------
    InputError
        If it cannot be read, or a clock in it has impossible values.

    Examples
    --------
    >>> import gis_radar as gr
    >>> from pathlib import Path
    >>> _ = Path("clocks.json").write_text('{"clocks": {"R2": {"offset_s": 0.12}}}')
    >>> gr.read_clocks("clocks.json")["R2"].offset_s
    0.12
    """
    hint = Text("make one with: gis-radar clocks")
    record = read_json(path, what="a file of clocks", hint=hint)
    try:
        clocks = dict(record["clocks"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError("{}: not a file of clocks", path, hint=hint) from error
    return {str(sensor): _clock_of(entry, f"{path}: {sensor}") for sensor, entry in clocks.items()}


def _clock_of(entry: Any, what: str) -> SensorClock:
    if not isinstance(entry, dict) or "offset_s" not in entry:
        raise InputError("{}: lacks offset_s", what)
    numbers = {name: entry[name] for name in NUMBERS if name in entry}
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError("{}: {} is {}, expected a number", what, name, repr(value))
    drifts = numbers.get("drift_ppm", 0.0) != 0.0
    if drifts and "at" not in entry:
        raise InputError("{}: has a drift but not the time `at` which its offset holds", what)
    at = seconds_from_iso(str(entry["at"]), what=f"{what}: at") if "at" in entry else 0.0
    try:
        return SensorClock(at=at, **numbers)
    except InputError as error:
        raise InputError("{}: {}", what, error.message) from error


def measure_clocks(
    recordings: Sequence[str | Path | Recording],
    poses: Sequence[Pose | PoseTrack | str | Path],
    tiles: gpd.GeoDataFrame,
    *,
    reference: str | None = None,
    reporter: Reporter = QUIET,
) -> Clocks:
    """Find how far the clocks of sensors are ahead of one of them, and how fast they drift.

    Moving detections are matched to the lanes, with the speed that their Doppler implies there. The
    lag at which two sensors agree best gives the offset to half a second, the places of the
    vehicles in both at that lag to milliseconds; the pairs are adjusted by least squares. An offset
    that fails validation is refused. (The paper, "Global Occupancy Heat Map", mentions the offsets
    that remain between synchronised sensors.)

    Parameters
    ----------
    recordings : sequence
        Files, or what :func:`gis_radar.open_recording` returns; of long recordings about an hour
        is used in which all recorded.
    poses : sequence of Pose, PoseTrack or their files
        As many as recordings, in order.
    tiles : GeoDataFrame
        As from :func:`gis_radar.hdmap.tiles.read_tiles`.
    reference : str, optional
        The sensor whose clock counts as right; by default the first by name of those that can be
        compared with the most others.
    reporter : Reporter
        Receives progress and warnings.

    Returns
    -------
    Clocks

    Raises
    ------
    UsageError
        If there are not as many poses as recordings, fewer than two sensors, or no such reference.
    InputError
        If a recording is damaged or a CRS differs.
    NoAnswerError
        If no clock can be compared with the reference.
    """
    if len(recordings) != len(poses) or not recordings:
        raise UsageError("{} recordings, but {} poses", len(recordings), len(poses))
    tracks = [as_track(pose) for pose in poses]
    sensors = sorted({track.sensor for track in tracks})  # in whatever order they were given
    if len(sensors) < 2 or (reference or sensors[0]) not in sensors:
        why = Text("clocks need two sensors")
        if len(sensors) > 1:
            why = Text("there is no {}", reference)
        raise UsageError("the poses are of {}: {}", ", ".join(sensors), why)
    crs = metric_crs(tiles.crs, what="tiles")
    for track in tracks:
        what = Text("the pose of {}", track.sensor)
        require_same(track.poses[0].crs, crs, what=what, other_what="the tiles")
    opened = [as_recording(recording) for recording in recordings]
    seen = _read_all(opened, tracks, lanelets_of(tiles), reporter)
    edges, reasons = _compare(seen, reporter)
    reference = reference or best_linked(edges, sensors)
    clocks, misfit = adjust_network(edges, reference)
    refused = {
        sensor: why_not_compared(sensor, reasons) for sensor in sensors if sensor not in clocks
    }
    if len(clocks) < 2:
        pairs = reasons.items()
        why = Text("; ").join((Text("{} and {}: {}", a, b, e.message) for (a, b), e in pairs))
        raise NoAnswerError(
            "no clock can be compared with that of {}: {}",
            reference,
            why,
            hint="sensors must see the same moving traffic; longer recordings help",
        )
    if misfit > CONTRADICTION_SIGMAS:
        reporter.warn(
            "the offsets of the pairs contradict each other by {:.1f} standard "
            "deviations: is a pose wrong?",
            misfit,
        )
    return Clocks(reference=reference, clocks=clocks, refused=refused, pairs=edges)


def _read_all(
    recordings: list[Recording],
    tracks: list[PoseTrack],
    lanelets: gpd.GeoDataFrame,
    reporter: Reporter,
) -> dict[str, LaneDetections]:
    """Read each sensor's detections on lanes around the begin of the last recording."""
    begins = [float(next(recording.read()).time[0]) for recording in recordings]
    parts: dict[str, list[LaneDetections]] = {}
    order = sorted(range(len(begins)), key=lambda i: (begins[i], str(recordings[i].path)))
    for i in order:
        mine = parts.setdefault(tracks[i].sensor, [])
        with suppress(NoAnswerError):  # no lane in reach: nothing in common with others
            mine.append(
                read_lane_detections(recordings[i], tracks[i], lanelets, max(begins), reporter)
            )
    sensors = sorted({track.sensor for track in tracks})
    return {sensor: LaneDetections.joined(parts[sensor]) for sensor in sensors}


def _compare(seen: dict[str, LaneDetections], reporter: Reporter) -> tuple[Edges, Reasons]:
    """Compare all pairs of sensors; return the offsets, and the reasons where there is none."""
    edges: Edges = {}
    reasons: Reasons = {}
    pairs = list(combinations(seen, 2))
    for done, (one, other) in enumerate(pairs):
        reporter.progress("comparing clocks", done, len(pairs))
        try:
            edges[one, other] = measured_offset(seen[one], seen[other])
        except NoAnswerError as error:
            reasons[one, other] = error
    reporter.progress("comparing clocks", len(pairs), len(pairs))
    return edges, reasons


def why_not_compared(sensor: str, reasons: Reasons) -> str:
    """Return why a sensor could not be compared with the sensor that shares most with it.

    Parameters
    ----------
    sensor : str
        Its name.
    reasons : Reasons
        By pair of sensors why they could not be compared; at least one pair has the sensor.

    Returns
    -------
    str
        The reason of a pair with common traffic where there is one, as it is more specific.
    """
    mine = {pair: why for pair, why in reasons.items() if sensor in pair}
    pair = max(mine, key=lambda each: not isinstance(mine[each], NoCommonTrafficError))
    other = pair[1] if pair[0] == sensor else pair[0]
    return Text("with {}: {}", other, mine[pair].message)


def adjust_network(edges: Edges, reference: str) -> tuple[dict[str, SensorClock], float]:
    """Adjust all clocks by weighted least squares over the pairs.

    Parameters
    ----------
    edges : dict
        By (one, other): how far the clock of `other` is ahead of that of `one`.
    reference : str
        The sensor whose clock counts as right.

    Returns
    -------
    clocks : dict
        The clock of each sensor linked with the reference; the reference's offset is 0.
    misfit : float
        The largest misfit of a pair, in its standard deviations; 0 without loops.
    """
    rough = _linked(edges, reference)
    names = [name for name in rough if name != reference]
    used = {pair: offset for pair, offset in edges.items() if pair[0] in rough}
    if not used:
        return {reference: SensorClock(offset_s=0.0)}, 0.0
    design = np.array([[(n == b) - (n == a) for n in names] for a, b in used], np.float64)
    found = list(used.values())
    # When each pair was compared, by the reference's clock.
    at = np.array([offset.at - rough[b] for (_, b), offset in used.items()])
    middle = float(np.median(at))
    drift, drift_sigma, _ = _least_squares(
        design, np.array([f.drift for f in found]), np.array([f.drift_sigma for f in found])
    )
    drift = np.where(np.abs(drift) > DRIFT_SIGMAS * drift_sigma, drift, 0.0)
    offset = np.array([f.offset_s for f in found]) - design @ drift * (at - middle)
    offset, offset_sigma, misfit = _least_squares(
        design, offset, np.array([f.sigma_s for f in found])
    )
    clocks = {
        name: SensorClock(
            offset_s=float(offset[i]),
            sigma_s=float(offset_sigma[i]),
            drift_ppm=float(drift[i] * 1e6),
            drift_sigma_ppm=float(drift_sigma[i] * 1e6),
            at=middle + float(offset[i]),
        )
        for i, name in enumerate(names)
    }
    first = SensorClock(offset_s=0.0, sigma_s=0.0, drift_sigma_ppm=0.0, at=middle)
    return {reference: first} | clocks, misfit


def best_linked(edges: Edges, sensors: list[str]) -> str:
    """Return the sensor that pairs link with the most others; of equals the first."""
    return max(sensors, key=lambda sensor: len(_linked(edges, sensor)))


def reached(pairs: Mapping[tuple[str, str], float], reference: str) -> dict[str, float]:
    """Return how many seconds each sensor that pairs link with the reference is ahead of it.

    Parameters
    ----------
    pairs : mapping
        By (one, other): seconds by which the clock of `other` is ahead of that of `one`.
    reference : str
        The sensor with 0.
    """
    ahead = {reference: 0.0}
    waiting = [reference]
    while waiting:
        here = waiting.pop(0)
        for (one, other), gap in pairs.items():
            for near, far, away in ((one, other, gap), (other, one, -gap)):
                if near == here and far not in ahead:
                    ahead[far] = ahead[here] + away
                    waiting.append(far)
    return ahead


def _linked(edges: Edges, reference: str) -> dict[str, float]:
    return reached({pair: offset.offset_s for pair, offset in edges.items()}, reference)


def _least_squares(design: Floats, values: Floats, sigma: Floats) -> tuple[Floats, Floats, float]:
    """Return the solution, its standard deviations, and the largest misfit over its sigma."""
    scaled = design / sigma[:, None]
    covariance = np.linalg.inv(scaled.T @ scaled)
    solution = covariance @ scaled.T @ (values / sigma)
    misfit = float(np.max(np.abs(values - design @ solution) / sigma))
    return solution, np.sqrt(np.diag(covariance)), misfit
