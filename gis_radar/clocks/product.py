"""How far the clocks of sensors are off, found from the traffic that they see in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np

from gis_radar.cards import card
from gis_radar.clocks.coarse import rough_offset
from gis_radar.clocks.fine import Offset, fine_offset
from gis_radar.clocks.network import CONTRADICTION, best_linked, settle
from gis_radar.clocks.proof import doubt_of
from gis_radar.clocks.sightings import Lanes, Sightings, read_sightings
from gis_radar.crs import metric_crs, require_same
from gis_radar.detections import Recording, as_recording
from gis_radar.errors import NoAnswerError, UsageError
from gis_radar.pose import Pose
from gis_radar.pose_files import PoseTrack, as_track
from gis_radar.progress import QUIET, Reporter
from gis_radar.sensor_clocks import SensorClock, write_clocks

MOST_S = 4000.0


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """How far each clock is ahead of the reference.

    Parameters
    ----------
    reference : str
        The sensor whose clock counts as right.
    clocks : dict
        By sensor, the reference too; those without an answer are not there.
    refused : dict
        Of the others: why there is no answer.
    pairs : dict
        What was found by pairs of sensors.
    """

    reference: str
    clocks: dict[str, SensorClock]
    refused: dict[str, str]
    pairs: dict[tuple[str, str], Offset]

    def figures(self) -> dict[str, Any]:
        """Return a line a sensor."""
        lines = {"reference": self.reference}
        for sensor, clock in self.clocks.items():
            if sensor != self.reference:
                drift = f"drift {clock.drift_ppm:+.0f} ppm" if clock.drift_ppm else "no drift told"
                lines[sensor] = (
                    f"{clock.offset_s:+.3f} s (sigma {clock.sigma_s:.3f}), {drift} "
                    f"(sigma {clock.drift_sigma_ppm:.0f} ppm)"
                )
        return lines | {sensor: f"no answer: {why}" for sensor, why in self.refused.items()}

    def write(self, path: str | Path) -> Path:
        """Write a file of clocks (JSON), which `occupancy` corrects times by."""
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
        write_clocks(record, path)
        return Path(path)

    def _repr_html_(self) -> str:
        return card("Clocks: ahead of the reference", self.figures())

    def __repr__(self) -> str:
        return f"Clocks({'; '.join(f'{name}: {text}' for name, text in self.figures().items())})"


def measure_clocks(
    recordings: Sequence[str | Path | Recording],
    poses: Sequence[Pose | PoseTrack],
    tiles: gpd.GeoDataFrame,
    *,
    reference: str | None = None,
    reporter: Reporter = QUIET,
) -> Clocks:
    """Find how far the clocks of sensors are ahead of one of them, and how fast they drift.

    Moving detections are placed on the lanes, with the speed that their Doppler implies there. The
    lag at which two sensors agree best gives the offset to half a second, the places of the
    vehicles in both at that lag to milliseconds; pairs are settled by least squares. Where
    the common traffic does not tell an offset beyond doubt there is none. (The paper, "Global
    Occupancy Heat Map", names the offsets that remain between synchronised sensors.)

    Parameters
    ----------
    recordings : sequence
        Files, or what :func:`gis_radar.detections.open_recording` returns; of long ones about
        an hour in which all record is used.
    poses : sequence of Pose or PoseTrack
        As many as recordings, in order.
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.read_tiles`.
    reference : str, optional
        The sensor whose clock counts as right; by default the first of those that can be
        compared with the most others.
    reporter : Reporter
        Hears how far the work is.

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
        raise UsageError(f"{len(recordings)} recordings, but {len(poses)} poses")
    tracks = [as_track(pose) for pose in poses]
    sensors = list(dict.fromkeys(track.sensor for track in tracks))
    if len(sensors) < 2 or (reference or sensors[0]) not in sensors:
        raise UsageError(
            f"the poses are of {', '.join(sensors)}: "
            + ("clocks need two sensors" if len(sensors) < 2 else f"there is no {reference}")
        )
    crs = metric_crs(tiles.crs, what="tiles")
    for track in tracks:
        what = f"the pose of {track.sensor}"
        require_same(track.poses[0].crs, crs, what=what, other_what="the tiles")
    opened = [as_recording(recording) for recording in recordings]
    seen = _sightings(opened, tracks, Lanes(tiles), reporter)
    edges, reasons = _compare(seen, reporter)
    reference = reference or best_linked(edges, sensors)
    network = settle(edges, reference)
    refused = {
        sensor: _reason(sensor, reasons) for sensor in sensors if sensor not in network.clocks
    }
    if len(network.clocks) < 2:
        told = "; ".join(f"{one} and {other}: {why}" for (one, other), why in reasons.items())
        raise NoAnswerError(
            f"no clock can be compared with that of {reference}: {told}",
            hint="sensors must see the same moving traffic; longer recordings help",
        )
    if network.misfit > CONTRADICTION:
        reporter.log(
            "the offsets of the pairs contradict each other by "
            f"{network.misfit:.1f} standard deviations: is a pose wrong?",
            "warning",
        )
    return Clocks(reference=reference, clocks=network.clocks, refused=refused, pairs=edges)


def _sightings(
    recordings: list[Recording], tracks: list[PoseTrack], lanes: Lanes, reporter: Reporter
) -> dict[str, Sightings]:
    begins = [float(next(recording.read()).time[0]) for recording in recordings]
    parts: dict[str, list[Sightings]] = {}
    order = np.argsort(begins, kind="stable")
    for i in order.tolist():
        found = read_sightings(recordings[i], tracks[i], lanes, max(begins), reporter)
        parts.setdefault(tracks[i].sensor, []).append(found)
    sensors = dict.fromkeys(track.sensor for track in tracks)
    return {sensor: Sightings.joined(parts[sensor]) for sensor in sensors}


def _compare(
    seen: dict[str, Sightings], reporter: Reporter
) -> tuple[dict[tuple[str, str], Offset], dict[tuple[str, str], str]]:
    """Compare all pairs of sensors; return what was found, and why where nothing was."""
    edges, reasons = {}, {}
    pairs = list(combinations(seen, 2))
    for done, (one, other) in enumerate(pairs):
        reporter.progress("comparing clocks", done, len(pairs))
        rough_s, why = rough_offset(seen[one], seen[other], MOST_S)
        found = None
        if not why:
            found, why = fine_offset(seen[one], seen[other], rough_s)
        if found is not None:
            why = doubt_of(seen[one], seen[other], found.offset_s)
        if found is not None and not why:
            edges[one, other] = found
        else:
            reasons[one, other] = why
    reporter.progress("comparing clocks", len(pairs), len(pairs))
    return edges, reasons


def _reason(sensor: str, reasons: dict[tuple[str, str], str]) -> str:
    """Return why a sensor could not be compared: with whom it came furthest."""
    mine = {pair: why for pair, why in reasons.items() if sensor in pair}
    pair = max(mine, key=lambda each: mine[each] != "they see no common traffic")
    other = pair[1] if pair[0] == sensor else pair[0]
    return f"with {other}: {mine[pair]}"
