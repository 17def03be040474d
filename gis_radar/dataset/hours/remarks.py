"""Warn once a run about views, cycles, clocks, heights and sights that do not fit recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import CLOCK_SET_S, STEP_US, Reporter, Text, iso_from_step
from gis_radar.dataset.files.registry import RecordingEntry
from gis_radar.dataset.files.source import DatasetFiles
from gis_radar.dataset.hours.job import MOST_EQUAL_FRAMES
from gis_radar.dataset.traffic.shifts import lanes_across
from gis_radar.measures import (
    CYCLES_VALID,
    VALIDITY_S,
    LaneNetwork,
    PlacedRecording,
    RecordingCounts,
    SightBook,
    valid_steps,
)
from gis_radar.poses import View
from gis_radar.recordings import FARTHEST_RADAR_M, Detections, RangeCounts, time_warnings
from gis_radar.scans import (
    JUDGED_FRAMES,
    MovingHits,
    Sight,
    find_contradictions,
    find_gaps,
    gap_warning,
    report_contradictions,
)
from gis_radar.tracking import warn_of_poses

# Time without frames to warn of, seconds and as a share: frames lost now and then leave less empty.
_LONG_PAUSE_S, _LONG_PAUSE_SHARE = 60.0, 0.1
_LONG_CYCLE = 2.0  # least stated cycle to warn of, in measured ones: a frame is lost now and then
_SLOW_CYCLE = 1.1  # least cycle to warn of, in validities: 10 % of the steps have no valid frame
# A warning is given where _RANGE_SHARE of the detections lies within _REACH_SHARE of the view's
# range (the contract).
_RANGE_SHARE, _REACH_SHARE = 0.999, 0.8
# A warning is given where _OUTSIDE_SHARE of the first detections are outside the view; of eleven
# simulated sensors at most 0.4 % are, and with half the azimuth 10 % and more.
_OUTSIDE_SHARE, _LEAST_VIEWED = 0.05, 100
# Seconds to which times may have been rounded, longest first, where there are `_LEAST_TIMES`.
_ROUNDED_S, _LEAST_TIMES, _ROUNDED_SHARE = (1.0, 0.1), 20, 1e-4
_FAR_SHARE = 0.001  # share of detections beyond any radar to warn of: more than ghosts


@dataclass(frozen=True, kw_only=True)
class Examined:
    """A recording with its counts in the hours that were made.

    Parameters
    ----------
    entry : RecordingEntry
        Its row in the dataset.
    source : PlacedRecording
        The recording with its poses.
    evidence : RecordingCounts
        The counts.
    """

    entry: RecordingEntry
    source: PlacedRecording
    evidence: RecordingCounts

    @cached_property
    def first_rows(self) -> Detections:
        """Its first batch."""
        return next(self.source.recording.read())


def remark_on_recordings(
    examined: Sequence[Examined],
    book: SightBook,
    reporter: Reporter,
) -> None:
    """Warn of oddities in recordings.

    Parameters
    ----------
    examined : sequence of Examined
        The recordings of this run.
    book : SightBook
        Sights of their sensors.
    reporter : Reporter
        Receives the warnings.
    """
    hits = _moving_hits(examined, book.sights)
    if book.scan is not None:
        judged = [each for each in hits if each.frames >= JUDGED_FRAMES]
        report_contradictions(find_contradictions(judged, book.road), reporter)
    if gaps := gap_warning(find_gaps(hits, book.road)):
        reporter.warn(gaps)
    for each in examined:
        for line in (
            *_view_warnings(each), *_cycle_warnings(each), *_pause_warnings(each),
            *_rounding_warnings(each), *_repetition_warnings(each), *_placing_warnings(each),
        ):  # fmt: skip
            reporter.warn(line)
    recorded: dict[str, list[tuple[float, float, Path]]] = {}
    for each in examined:
        span = each.entry.first_time, each.entry.last_time, Path(each.entry.path)
        recorded.setdefault(each.entry.sensor, []).append(span)
    for line in time_warnings(recorded):
        reporter.warn(line)


def remark_on_vehicles(count: int, on_lanes: Sequence[pd.DataFrame], reporter: Reporter) -> None:
    """Warn where no vehicle moves, or vehicles drive beside the lanes."""
    if count == 0:
        reporter.warn("no vehicle moves in these recordings: the occupancy is zero")
    for line in warn_of_poses(on_lanes):
        reporter.warn(line)


def remark_on_counting_lines(
    dataset: DatasetFiles, tiles: gpd.GeoDataFrame, lanes: gpd.GeoDataFrame, reporter: Reporter
) -> None:
    """Warn of lanes over whose counting lines all sensors look straight across.

    Tiles (by ascending `tile_id`) and lanes are the dataset's, not read again: memory may be short.
    """
    network = LaneNetwork.of(tiles, dict(zip(lanes["lane"], lanes["stop_line_m"], strict=True)))
    across = lanes_across(dataset.poses(), dataset.sights(), tiles, network) & ~network.connector
    if across.any():
        reporter.warn(
            "{}: every sensor looks straight across at the counting line: range rates do not tell "
            "there who sets off, and a third of the vehicles may be missed; a sensor that looks "
            "along the lane counts them",
            Text(", ").join(Text("lane {}", lane) for lane in network.lane[across].tolist()),
        )


def _moving_hits(examined: Sequence[Examined], sights: Mapping[str, Sight]) -> list[MovingHits]:
    """Return the moving hits on the tiles in each sight, all recordings of a sensor together."""
    by_sight: dict[str, list[tuple[np.ndarray, int]]] = {}
    for each in examined:
        for name, count in each.evidence.movement.items():
            frames = each.evidence.frames.get(name, 0)
            by_sight.setdefault(name, []).append((count, frames))
    return [
        MovingHits(
            sight=sights[name], count=np.sum([count for count, _ in found], axis=0),
            frames=sum(frames for _, frames in found),
        )
        for name, found in by_sight.items()
    ]  # fmt: skip


def _view_warnings(examined: Examined) -> Iterator[str]:
    """Yield warnings where a view does not fit the detections."""
    file, sensor = examined.source.recording.path.name, examined.entry.sensor
    ranges = RangeCounts()
    ranges.counts = examined.evidence.ranges
    reached_m = ranges.reached_m(_RANGE_SHARE)
    view = examined.source.track.poses[0].view or View()
    if examined.evidence.hits == 0 and examined.evidence.rows:  # else another one holds its frames
        yield Text(
            "{}: no detection of {} lies on a tile: all reads as observed and empty; do "
            "pose, tiles and filters fit the recording, and are its positions metres?",
            file,
            sensor,
        )
    beyond = float(ranges.counts[int(FARTHEST_RADAR_M) :].sum() / max(ranges.counts.sum(), 1))
    if beyond > _FAR_SHARE:
        yield Text(
            "{}: {:.1%} of the detections are over {:,.0f} m away, beyond any radar, and count "
            "nowhere: are some positions in another unit than metres?",
            file,
            beyond,
            FARTHEST_RADAR_M,
        )
    rows = examined.first_rows
    outside = ~view.sees(rows.points[rows.present])
    if len(outside) >= _LEAST_VIEWED and (share := float(outside.mean())) > _OUTSIDE_SHARE:
        yield Text(
            "{}: {:.0%} of the detections lie outside the view of {} (azimuth {:g}, elevation "
            "{:g} deg, range {:g} m) and count nowhere: angles are full opening angles, in degrees",
            file,
            share,
            sensor,
            view.azimuth_deg,
            view.elevation_deg,
            view.max_range_m,
        )
    limit = Text("the view's max_range_m or {}", "--max-range")
    whole = not examined.source.recording.selected
    if whole and 0 < reached_m < _REACH_SHARE * view.max_range_m:
        yield Text(
            "{}: {:g} % of the detections lie within {:.0f} m, but the view of {} "
            "reaches {:g} m: what lies beyond reads as observed and empty; set {}",
            file,
            100 * _RANGE_SHARE,
            reached_m,
            sensor,
            view.max_range_m,
            limit,
        )


def _cycle_warnings(examined: Examined) -> Iterator[str]:
    """Yield warnings where a cycle is longer than frames are valid, or far shorter than stated."""
    file, sensor = examined.source.recording.path.name, examined.entry.sensor
    validity_s, cycle_us = examined.entry.validity_s, examined.evidence.times.cycle_us
    valid_us = (1 + valid_steps(validity_s)) * STEP_US
    if _SLOW_CYCLE * valid_us < cycle_us < np.inf:
        cycle_ms, empty = round(cycle_us / 1000), 100.0 * (1.0 - valid_us / cycle_us)
        stated = Text("--cycle {}={}ms", sensor, cycle_ms)
        yield Text(
            "{}: {} delivers every {} ms, and a frame is valid for {:g} ms: {:.0f} % of "
            "the 50 ms steps read as not observed by it; {} makes a frame valid for its "
            "whole cycle",
            file,
            sensor,
            cycle_ms,
            1000 * validity_s,
            empty,
            stated,
        )

    stated_us = validity_s / CYCLES_VALID * 1e6
    if validity_s != VALIDITY_S and stated_us > _LONG_CYCLE * cycle_us:
        yield Text(
            "{}: {} delivers every {} ms, but its cycle is given as {} ms: up to {} ms without a "
            "frame count as observed",
            file,
            sensor,
            round(cycle_us / 1000),
            round(stated_us / 1000),
            round(validity_s * 1000),
        )


def _pause_warnings(examined: Examined) -> Iterator[str]:
    """Yield a warning where frames fill far less than a recording's time."""
    times = examined.evidence.times
    span_s = (times.last_us - times.first_us) / 1e6
    filled_s = times.frames * times.cycle_us / 1e6
    if span_s - filled_s > max(_LONG_PAUSE_S, _LONG_PAUSE_SHARE * span_s):
        yield Text(
            "{}: its frames fill {:,.0f} of {:,.0f} s: the others are missing, or the clock of {} "
            "was set on the way",
            examined.source.recording.path.name,
            filled_s,
            span_s,
            examined.entry.sensor,
        )


def _rounding_warnings(examined: Examined) -> Iterator[str]:
    """Yield a warning where times were rounded, so that frames of one time may be several.

    Frames whose stated cycle is as long are valid for longer than it.
    """
    time = np.unique(examined.first_rows.time)
    for grid_s in _ROUNDED_S:
        off = np.abs(time / grid_s - np.rint(time / grid_s))
        if len(time) >= _LEAST_TIMES and off.max() < _ROUNDED_SHARE:
            if examined.entry.validity_s <= grid_s:
                yield Text(
                    "{}: its first times are all multiples of {:g} s: were they rounded? Then "
                    "frames are joined into one, and hits and places are wrong; write six "
                    "decimals, or, if that is the radar's cycle, give {}",
                    examined.source.recording.path.name,
                    grid_s,
                    Text("--cycle {}={}ms", examined.entry.sensor, round(1000 * grid_s)),
                )
            return


def _repetition_warnings(examined: Examined) -> Iterator[str]:
    """Yield a warning where a recording holds frames at two times."""
    if examined.evidence.repeated > MOST_EQUAL_FRAMES:
        yield Text(
            "{}: {:,} frames are equal to earlier ones, which no radar delivers: was the recording "
            "joined with a copy of itself, or did the radar freeze?",
            examined.source.recording.path.name,
            examined.evidence.repeated,
        )


def _placing_warnings(examined: Examined) -> Iterator[str]:
    """Yield warnings where a sensor measures no elevation, or its clock was not set."""
    file, sensor = examined.source.recording.path.name, examined.entry.sensor
    evidence = examined.evidence
    if evidence.lacks_elevation:
        heights = sorted({f"{sight.road_m:.1f}" for sight in examined.source.sights})
        yield Text(
            "{}: {} measures no elevation: its detections are placed at the height of "
            "the road near it ({} m)",
            file,
            sensor,
            ", ".join(heights),
        )
    if examined.entry.first_time < CLOCK_SET_S:
        begin = iso_from_step(evidence.times.first_us // STEP_US)
        yield Text(
            "{}: times begin at {}: the clock of {} may count since it was switched on; "
            "gis-radar clocks finds its offset",
            file,
            begin,
            sensor,
        )
