"""Measure the clock offsets of sensors from the traffic that they see in common."""

from __future__ import annotations

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
    card,
    metric_crs,
    read_json,
    require_same,
    seconds_from_iso,
    write_json,
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

_CONTRADICTION_SIGMAS = 4.0  # larger residuals of a pair of sensors give a warning
# A drift of fewer standard errors is set to 0: over hours it would only add noise.
_DRIFT_SIGMAS = 3.0

_MOST_DRIFT_PPM = 12_000.0  # larger drifts are mistakes of units: a bad quartz has 100
_NUMBERS = ("offset_s", "sigma_s", "drift_ppm", "drift_sigma_ppm")  # of a clock in a file of clocks


@dataclass(frozen=True, kw_only=True)
class SensorClock:
    """Offset and drift of a sensor's clock against the reference.

    Parameters
    ----------
    offset_s : float
        Seconds by which it is ahead of the reference at the time `at`.
    drift_ppm : float
        Rate by which it gains on the reference, microseconds a second.
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
        if not abs(self.drift_ppm) <= _MOST_DRIFT_PPM:
            raise InputError(
                "clock drift is {} ppm, expected at most {:g}", self.drift_ppm, _MOST_DRIFT_PPM
            )

    def corrected(self, time: Floats) -> Floats:
        """Convert times (UNIX seconds) of this clock to those of the reference."""
        ahead = self.offset_s + self.drift_ppm * 1e-6 * (np.asarray(time) - self.at)
        return np.asarray(time - ahead, dtype=np.float64)

    def shown(self, time: Floats) -> Floats:
        """Convert times (UNIX seconds) of the reference to those of this clock."""
        drift = self.drift_ppm * 1e-6
        return np.asarray((time + self.offset_s - drift * self.at) / (1.0 - drift), np.float64)

    def as_dict(self) -> dict[str, Any]:
        """Return the clock's entry in a file of clocks; unknown values are left out."""
        moment = datetime.fromtimestamp(self.at, UTC).isoformat(timespec="milliseconds")
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        known = {name: value for name, value in numbers.items() if math.isfinite(value)}
        return known | {"at": moment.replace("+00:00", "Z")}


Edges = dict[tuple[str, str], ClockOffset]  # by (one, other): offset of `other` against `one`
Reasons = dict[tuple[str, str], NoAnswerError]  # by pair without an offset: the reason


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """Clock offsets of a site's sensors against a reference.

    Parameters
    ----------
    reference : str
        The sensor whose clock has no offset.
    clocks : dict
        By sensor, also the reference; only sensors with a measured offset.
    refused : dict
        By sensor without a measured offset: the reason.
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
        """Write a file of clocks (JSON), with which `measure` corrects times."""
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
        write_json(Path(path), record)
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
    return {
        str(sensor): _parse_clock(entry, f"{path}: {sensor}") for sensor, entry in clocks.items()
    }


def _parse_clock(entry: Any, what: str) -> SensorClock:
    if not isinstance(entry, dict) or "offset_s" not in entry:
        raise InputError("{}: lacks offset_s", what)
    numbers = {name: entry[name] for name in _NUMBERS if name in entry}
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
    """Measure offset and drift of sensors' clocks against one of them.

    Moving detections are matched to lanes, with the speed along the lane by their Doppler. The lag
    at which two sensors agree best gives the offset to half a second, the positions of vehicles in
    both to milliseconds. The offsets of all pairs are adjusted by least squares; an offset that
    fails validation is refused. (The paper, "Global Occupancy Heat Map", mentions the offsets that
    remain between synchronised sensors.)

    Parameters
    ----------
    recordings : sequence
        Files, or recordings from :func:`gis_radar.open_recording`; of long ones about an hour is
        used, common to all.
    poses : sequence of Pose, PoseTrack or their files
        As many as recordings, in order.
    tiles : GeoDataFrame
        As from :func:`gis_radar.hdmap.tiles.read_tiles`.
    reference : str, optional
        The sensor whose clock has no offset; by default the first by name of those linked with the
        most others.
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
        reason = Text("clocks need two sensors")
        if len(sensors) > 1:
            reason = Text("there is no {}", reference)
        raise UsageError("the poses are of {}: {}", ", ".join(sensors), reason)
    crs = metric_crs(tiles.crs, what="tiles")
    for track in tracks:
        what = Text("the pose of {}", track.sensor)
        require_same(track.poses[0].crs, crs, what=what, other_what="the tiles")
    opened = [as_recording(recording) for recording in recordings]
    detections = _read_all(opened, tracks, lanelets_of(tiles), reporter)
    edges, reasons = _compare_all(detections, reporter)
    reference = reference or best_linked(edges, sensors)
    clocks, misfit = adjust_network(edges, reference)
    refused = {
        sensor: why_not_compared(sensor, reasons) for sensor in sensors if sensor not in clocks
    }
    if len(clocks) < 2:
        pairs = reasons.items()
        reason = Text("; ").join((Text("{} and {}: {}", a, b, e.message) for (a, b), e in pairs))
        raise NoAnswerError(
            "no clock can be compared with that of {}: {}",
            reference,
            reason,
            hint="sensors must see the same moving traffic; longer recordings help",
        )
    if misfit > _CONTRADICTION_SIGMAS:
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
    """Return each sensor's detections on lanes, around the begin of the last recording."""
    begins = [float(next(recording.read()).time[0]) for recording in recordings]
    parts: dict[str, list[LaneDetections]] = {}
    order = sorted(range(len(begins)), key=lambda i: (begins[i], str(recordings[i].path)))
    for i in order:
        of_sensor = parts.setdefault(tracks[i].sensor, [])
        with suppress(NoAnswerError):  # no lane in reach: nothing in common with others
            of_sensor.append(
                read_lane_detections(recordings[i], tracks[i], lanelets, max(begins), reporter)
            )
    sensors = sorted({track.sensor for track in tracks})
    return {sensor: LaneDetections.joined(parts[sensor]) for sensor in sensors}


def _compare_all(seen: dict[str, LaneDetections], reporter: Reporter) -> tuple[Edges, Reasons]:
    """Measure all pairs of sensors; return the offsets, and the reasons of pairs without one."""
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
    """Return the reason why a sensor has no offset: that of one of its pairs.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    reasons : Reasons
        Reasons of pairs of sensors, at least one of them with the sensor.

    Returns
    -------
    str
        The reason of a pair with common traffic, if there is one, as it is more specific.
    """
    of_sensor = {pair: why for pair, why in reasons.items() if sensor in pair}
    pair = max(of_sensor, key=lambda each: not isinstance(of_sensor[each], NoCommonTrafficError))
    other = pair[1] if pair[0] == sensor else pair[0]
    return Text("with {}: {}", other, of_sensor[pair].message)


def adjust_network(edges: Edges, reference: str) -> tuple[dict[str, SensorClock], float]:
    """Adjust all clocks by weighted least squares over the pairs.

    Parameters
    ----------
    edges : dict
        By (one, other): offset of the clock of `other` against that of `one`.
    reference : str
        The sensor whose clock has no offset.

    Returns
    -------
    clocks : dict
        The clock of each sensor linked with the reference; the reference's offset is 0.
    misfit : float
        Largest absolute residual of a pair, in its standard deviations; 0 without loops.
    """
    rough = _offsets_from(edges, reference)
    names = [name for name in rough if name != reference]
    used = {pair: offset for pair, offset in edges.items() if pair[0] in rough}
    if not used:
        return {reference: SensorClock(offset_s=0.0)}, 0.0
    design = np.array([[(n == b) - (n == a) for n in names] for a, b in used], np.float64)
    offsets = list(used.values())
    # time of each offset by the reference's clock
    at = np.array([offset.at - rough[b] for (_, b), offset in used.items()])
    middle = float(np.median(at))
    drift, drift_sigma, _ = _least_squares(
        design, np.array([f.drift for f in offsets]), np.array([f.drift_sigma for f in offsets])
    )
    drift = np.where(np.abs(drift) > _DRIFT_SIGMAS * drift_sigma, drift, 0.0)
    offset = np.array([f.offset_s for f in offsets]) - design @ drift * (at - middle)
    offset, offset_sigma, misfit = _least_squares(
        design, offset, np.array([f.sigma_s for f in offsets])
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
    """Return the sensor that is linked with the most others; of equal ones the first."""
    return max(sensors, key=lambda sensor: len(_offsets_from(edges, sensor)))


def sum_offsets(pairs: Mapping[tuple[str, str], float], reference: str) -> dict[str, float]:
    """Return the offset of each sensor linked with the reference, summed along a chain of pairs.

    Parameters
    ----------
    pairs : mapping
        By (one, other): offset of the clock of `other` against that of `one`, seconds.
    reference : str
        The sensor whose offset is 0.
    """
    ahead = {reference: 0.0}
    queue = [reference]
    while queue:
        here = queue.pop(0)
        for (one, other), gap in pairs.items():
            for near, far, step in ((one, other, gap), (other, one, -gap)):
                if near == here and far not in ahead:
                    ahead[far] = ahead[here] + step
                    queue.append(far)
    return ahead


def _offsets_from(edges: Edges, reference: str) -> dict[str, float]:
    return sum_offsets({pair: offset.offset_s for pair, offset in edges.items()}, reference)


def _least_squares(design: Floats, values: Floats, sigma: Floats) -> tuple[Floats, Floats, float]:
    """Return the solution, its standard deviations, and the largest residual over its sigma."""
    scaled = design / sigma[:, None]
    covariance = np.linalg.inv(scaled.T @ scaled)
    solution = covariance @ scaled.T @ (values / sigma)
    misfit = float(np.max(np.abs(values - design @ solution) / sigma))
    return solution, np.sqrt(np.diag(covariance)), misfit
