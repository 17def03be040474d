"""Check a pose by static structures around the sensor, independently of lanes and traffic.

The score of a pose is the share of static cells of the recording that lie on structures of the
scan; it is compared with the scores of shifted and rotated poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pyproj import CRS

from gis_radar.base import CELL_M, QUIET, Floats, InputError, Reporter, Text, paths_of
from gis_radar.calibration.scan.scan_check_result import (
    CONFIRMS,
    DOUBTS,
    SHIFT_M,
    UNCLEAR,
    UNDECIDED,
    PoseOffset,
    ScanCheck,
)
from gis_radar.calibration.scan.surroundings import (
    LevelFrame,
    Slow,
    Standing,
    Structure,
    read_slow,
    read_structure,
    standing,
)
from gis_radar.poses import Pose, as_pose
from gis_radar.recordings import Recording
from gis_radar.scans import box_with_margin, open_scan

# 1 sigma of the distance of a static cell from its structure: the radar detects a wall, the scan
# the edge of the roof over it.
CLOSE_M = 0.75
_LANE_M, _ASKEW_DEG = 3.0, 3.0  # offsets from here on (a lane's width) are another pose
# Least z score of another pose, or of shifts, for `doubts` (by chance one in 700), and of the pose
# over all others and over shifts for `confirms` (one in 40).
BETTER_SIGMAS, CLEAR_SIGMAS = 3.0, 2.0
LEAST_CELLS = 60  # fewer static cells are not compared
LEAST_COVERED = 0.5  # least share of the cells over which the scan has points
_COARSE_CELLS = 2  # side of the coarse cells in the search over all headings, in cells
_TURN_DEG = 1.0  # step of heading in that search
_ALONG_DEG = 15.0  # between the directions in which patches are moved along what stands
_CANDIDATES = 8  # peaks of that search that are refined
# Steps of the hill climbing, metres and degrees.
_CLIMBING_STEPS: tuple[tuple[float, float], ...] = (
    (1.0, 1.0),
    (0.5, 0.5),
    (0.25, 0.25),
    (0.1, 0.1),
)
# Smaller offsets are the same pose: nearer to its lane than to the next one.
SAME_M = 1.75
SAME_DEG = 1.5
_LEAST_PATCHES = 12  # static cells in fewer patches are not compared
# Limits of the radius that is compared: 300 m is the longest range of the sensors.
_LEAST_REACH_M = 60.0
_MOST_REACH_M = 300.0
_MARGIN_M = 20.0  # width of the scan read beyond that radius, for shifted poses

HERE = (0.0, 0.0, 0.0)  # the offset of the checked pose


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Alignment of static cells with a scan, at the checked pose and at offsets from it.

    The score of an offset is the mean over the static cells of `exp(-d^2 / 2 CLOSE_M^2)`, with `d`
    their distance to the nearest structure of the scan.

    Parameters
    ----------
    standing : Standing
        The static cells, in the level frame of the checked pose.
    closeness : (n, n) array
        That exponential for each cell of the frame, 0 to 1.
    """

    standing: Standing = field(repr=False)
    closeness: Floats = field(repr=False)

    def closeness_at(self, offset: ArrayLike) -> Floats:
        """Return the closeness of each static cell at (ahead in m, left in m, turn in degrees).

        Of (..., 3) offsets it is an array (..., cells), in one call: a call takes longer than that.
        """
        ahead, left, turn = np.moveaxis(np.asarray(offset, np.float64), -1, 0)[..., None]
        angle = np.radians(turn)
        cos, sin = np.cos(angle), np.sin(angle)
        x, y = self.standing.points[:, :2].T
        place = np.array([cos * x - sin * y + ahead, sin * x + cos * y + left]) / CELL_M
        place += len(self.closeness) // 2 - 0.5
        return np.asarray(
            scipy.ndimage.map_coordinates(self.closeness, place, order=1, mode="constant")
        )

    def offsets(self, places: ArrayLike) -> list[PoseOffset]:
        """Return (k, 3) rows (ahead in m, left in m, turn in degrees) as offsets with scores."""
        rows = np.asarray(places, np.float64)
        scores = self.closeness_at(rows).mean(axis=1).tolist()
        return [
            PoseOffset(
                ahead_m=ahead, left_m=left, turn_deg=(turn + 180.0) % 360.0 - 180.0, score=score
            )
            for (ahead, left, turn), score in zip(rows.tolist(), scores, strict=True)
        ]

    def offset(self, place: Sequence[float]) -> PoseOffset:
        """Return (ahead in m, left in m, turn in degrees) as an offset with its score."""
        return self.offsets([place])[0]

    @property
    def here(self) -> PoseOffset:
        """The checked pose as an offset of 0, with its score."""
        return self.offset(HERE)

    def z_score(self, one: PoseOffset, other: PoseOffset) -> float:
        """Return the z score of one offset over another.

        Patches of neighbouring cells are the units, as these show one wall or one tree.
        """
        return self._z_score(self.closeness_at(one.place) - self.closeness_at(other.place))

    def z_score_along(self, one: PoseOffset) -> float:
        """Return the z score of an offset over shifts of it along what stands.

        A wall lies on walls wherever it is moved along itself, and on those of other streets. So
        each patch is compared with itself moved to and fro, in the direction in which it lies on
        most: crowns, corners and gaps between houses decide.
        """
        patch, shifted = self.standing.patch, one.place + _ALONG
        most = np.max(
            [np.bincount(patch, self.closeness_at(each).mean(axis=0)) for each in shifted], axis=0
        )
        return self._z_score(self.closeness_at(one.place) - (most / np.bincount(patch))[patch])

    def _z_score(self, gain: Floats) -> float:
        votes = np.bincount(self.standing.patch, gain)
        spread = float(np.sqrt((votes**2).sum()))
        return float(votes.sum()) / spread if spread > 0.0 else 0.0

    def climb(self, place: Sequence[float], *, apart: bool = False) -> PoseOffset:
        """Climb from an offset to the nearest local maximum of the score.

        With `apart`, only offsets that are another pose are tried (`_LANE_M`, `_ASKEW_DEG`).
        """
        best = self.offset(place)
        farthest_m = SHIFT_M * np.sqrt(2.0)
        for shift_m, turn_deg in _CLIMBING_STEPS:
            step = np.array([shift_m, shift_m, turn_deg])
            for _ in range(30):
                neighbours = self.offsets(best.place + _MOVES * step)
                neighbours = [o for o in neighbours if o.shift_m <= farthest_m]
                if apart:
                    neighbours = [o for o in neighbours if o.beyond(_LANE_M, _ASKEW_DEG)]
                better = max(neighbours, key=lambda o: o.score, default=best)
                if better.score <= best.score + 1e-9:
                    break
                best = better
        return best

    def surface(self) -> Floats:
        """Return the scores at the pose's heading, (ahead, left), every cell up to `SHIFT_M`."""
        return np.asarray(_scores_of_shifts(self, [0.0])[0])

    def search_headings(self) -> tuple[list[PoseOffset], float]:
        """Return the highest local maxima over all headings and shifts, and the mean score."""
        turns = np.arange(-180.0, 180.0, _TURN_DEG)
        scores = _scores_of_shifts(self, turns.tolist(), _COARSE_CELLS)
        size = (7, 5, 5)
        top = scipy.ndimage.maximum_filter(scores, size, mode=("wrap", "nearest", "nearest"))
        order = np.argsort(-np.where(scores == top, scores, -1.0), axis=None)[:_CANDIDATES]
        turn, ahead, left = np.unravel_index(order, scores.shape)
        middle, cell_m = scores.shape[1] // 2, CELL_M * _COARSE_CELLS
        places = np.column_stack([(ahead - middle) * cell_m, (left - middle) * cell_m, turns[turn]])
        return self.offsets(places), float(scores.mean())


_MOVES = np.array([move for move in product((-1, 0, 1), repeat=3) if any(move)], float)
# Shifts to and fro in directions all around, (directions, shifts, 3).
_ALONG = np.array([
    [
        (shift_m * np.cos(turn), shift_m * np.sin(turn), 0.0)
        for shift_m in np.arange(-SHIFT_M, SHIFT_M + CELL_M / 2.0, CELL_M)
        if abs(shift_m) >= _LANE_M
    ]
    for turn in np.radians(np.arange(0.0, 180.0, _ALONG_DEG))
])  # fmt: skip


def align(standing: Standing, structure: Structure) -> Alignment:
    """Return the alignment of static cells with a scan that has visible structures."""
    away = scipy.ndimage.distance_transform_edt(~structure.visible) * CELL_M
    closeness = np.asarray(np.exp(-0.5 * (away / CLOSE_M) ** 2))
    return Alignment(standing=standing, closeness=closeness)


def _scores_of_shifts(alignment: Alignment, turns_deg: Sequence[float], coarse: int = 1) -> Floats:
    """Return the scores of all shifts, (headings, ahead, left), by convolution with an FFT."""
    field, points = alignment.closeness, alignment.standing.points[:, :2]
    if coarse > 1:
        field = scipy.ndimage.gaussian_filter(field, coarse * CLOSE_M / CELL_M / 2.0)
    size, cell_m = len(field) // coarse, CELL_M * coarse
    field = field[: size * coarse, : size * coarse]
    field = field.reshape(size, coarse, size, coarse).mean(axis=(1, 3))
    side = int(scipy.fft.next_fast_len(size, real=True))
    spectrum = scipy.fft.rfft2(field.astype(np.float32), (side, side))
    most_cells = round(SHIFT_M / cell_m)
    shifts = np.arange(-most_cells, most_cells + 1)
    scores = []
    for angle in np.radians(turns_deg):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        cell = np.floor(points @ turn / cell_m + size / 2.0).astype(np.int64)
        count = np.bincount(cell[:, 0] * side + cell[:, 1], minlength=side**2)
        image = scipy.fft.rfft2(count.astype(np.float32).reshape(side, side))
        rows = scipy.fft.ifft(spectrum * np.conj(image), axis=0)[shifts]  # only shifts within reach
        correlation = scipy.fft.irfft(rows, side, axis=1)[:, shifts]
        scores.append(np.asarray(correlation, np.float64) / len(points))
    return np.stack(scores)


def require_scans_near(
    scans: Sequence[str | Path],
    crs: CRS,
    place: Sequence[float],
    *,
    name: str = "the sensor",
    scan_crs: Any = None,
) -> None:
    """Refuse scans of which none reaches a sensor; reads their headers only.

    Parameters
    ----------
    scans, scan_crs
        As for :func:`check_against_scan`.
    crs : CRS
        The map frame.
    place : (easting, northing, ...)
        Approximate place of the sensor, metres.
    name : str
        The sensor's name in the message.

    Raises
    ------
    InputError
        If none of them reaches within 300 m, or one is damaged; CrsError if one has no projected,
        metric coordinate system.
    """
    reach_m = _MOST_REACH_M
    box = box_with_margin((place[0], place[1], place[0], place[1]), reach_m)
    # no early exit: all are opened, so that a damaged one is refused
    near = [open_scan(scan, crs=scan_crs).touches(box, crs) for scan in scans]
    if not any(near):
        raise _no_points_error(scans, reach_m, name, place, crs)


def _no_points_error(
    scans: Sequence[str | Path], reach_m: float, what: str, place: Sequence[float], crs: CRS
) -> InputError:
    """Return the error that no scan has points near a place."""
    names = ", ".join(str(scan) for scan in scans[:3]) + (" ..." if len(scans) > 3 else "")
    return InputError(
        "{}: no point within {:.0f} m of {}",
        names,
        reach_m,
        what,
        hint=Text(
            "it stands at {:.0f} {:.0f} in {}; take the scan of that place",
            place[0],
            place[1],
            crs.name,
        ),
    )


def check_against_scan(
    recording: str | Path | Recording,
    pose: Pose | str | Path,
    scans: str | Path | Sequence[str | Path],
    *,
    scan_crs: Any = None,
    reporter: Reporter = QUIET,
) -> ScanCheck:
    """Check a pose by the static structures around the sensor (the paper's Fig. 2).

    Facades, crowns of trees and poles are detected repeatedly at one place. With the right pose
    they lie on canopy and walls of an airborne scan, with other poses nearby they do not. Lanes and
    traffic are not used.

    Parameters
    ----------
    recording : str, Path or Recording
        The sensor's recording; its last 2000 frames count.
    pose : Pose, str or Path
        The pose to check, or its file.
    scans : path or sequence of paths
        Airborne scans (LAS, LAZ, COPC), whole and not masked; classified or not.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    reporter : Reporter
        Receives progress and the verdict.

    Returns
    -------
    ScanCheck

    Raises
    ------
    InputError
        If a file cannot be read, or no scan has a point near the pose; CrsError if a scan has no
        projected, metric coordinate system.
    """
    pose, scans = as_pose(pose), paths_of(scans)
    slow = read_slow(recording, reporter=reporter)
    level = LevelFrame(pose=pose)
    reach_m = float(np.clip(slow.reach_m, _LEAST_REACH_M, _MOST_REACH_M))
    structure = read_structure(
        scans, level, reach_m=reach_m + _MARGIN_M, scan_crs=scan_crs, reporter=reporter
    )
    if structure is None:
        raise _no_points_error(scans, reach_m, pose.sensor, pose.position.tolist(), pose.crs)
    cells = standing(slow, level, structure.ground, reach_m=reach_m)
    reason = _why_not_comparable(slow, cells, structure)
    fields: dict[str, Any] = {"verdict": UNCLEAR, "reason": reason}
    if not reason:
        fields = _comparison_fields(cells, structure)
    check = ScanCheck(
        pose=pose, standing=cells, structure=structure, range_m=slow.range_m, **fields
    )
    text = Text("scan check: {}: {}", check.verdict, check.reason)
    reporter.log(text, "warning" if check.verdict in {DOUBTS, UNDECIDED} else "info")
    return check


def _why_not_comparable(slow: Slow, cells: Standing, structure: Structure) -> str:
    """Return why recording and scan cannot be compared; empty where they can."""
    if len(slow.points) == 0:
        return "the recording has no still detections with an elevation"
    if len(cells) < LEAST_CELLS or cells.patches < _LEAST_PATCHES:
        return Text("little stands in view: {} cells in {} places", len(cells), cells.patches)
    if not structure.visible.any():
        return "the scan shows neither canopy nor walls here"
    return ""


def _comparison_fields(cells: Standing, structure: Structure) -> dict[str, Any]:
    """Compare static cells with the scan; return verdict, reason and figures of a scan check."""
    alignment = align(cells, structure)
    here = alignment.here
    peaks, chance = alignment.search_headings()
    tops = [alignment.climb(peak.place) for peak in (here, *peaks)]
    best = max(tops, key=lambda top: top.score)
    others = [o for o in (*peaks, *tops) if o.beyond(_LANE_M, _ASKEW_DEG)]
    rivals = [alignment.climb(other.place, apart=True) for other in others]
    rival = max(rivals, key=lambda top: top.score, default=None)
    rows, columns = LevelFrame.cells(cells.points, len(structure.top))
    covered = float(np.isfinite(structure.top[rows, columns]).mean())
    verdict, reason = _verdict(alignment, best, rival, chance, covered)
    return {
        "verdict": verdict, "reason": reason, "score": here.score, "chance": chance, "best": best,
        "rival": rival, "z_score": alignment.z_score(here, rival) if rival else float("inf"),
        "closeness": alignment.closeness_at(here.place), "covered": covered,
        "surface": alignment.surface(),
    }  # fmt: skip


def _verdict(
    alignment: Alignment, best: PoseOffset, rival: PoseOffset | None, chance: float, covered: float
) -> tuple[str, str]:
    """Return verdict and reason of a scan check."""
    at_pose = alignment.here
    fits = Text("{:.0%} of what stands lies on the scan's canopy and walls", at_pose.score)
    elsewhere = best.beyond(SAME_M, SAME_DEG)
    alternative = best if elsewhere else rival
    if elsewhere and alignment.z_score(best, at_pose) >= BETTER_SIGMAS:
        return DOUBTS, Text("{}, but {:.0%} {}", fits, best.score, best.words())
    if covered < LEAST_COVERED:
        return UNCLEAR, Text("the scan covers {:.0%} of what stands in view", covered)
    over_along = alignment.z_score_along(at_pose if elsewhere else best)
    if over_along <= -BETTER_SIGMAS:
        return DOUBTS, Text("{}, but more if it is moved along them", fits)
    if alternative is not None and (
        elsewhere or alignment.z_score(best, alternative) < CLEAR_SIGMAS
    ):
        return UNDECIDED, Text(
            "{}, and {:.0%} {}: both may be right", fits, alternative.score, alternative.words()
        )
    if over_along < CLEAR_SIGMAS:
        return UNDECIDED, Text(
            "{}, hardly more than if it is moved along them: it may be a street that looks alike",
            fits,
        )
    return CONFIRMS, Text("{}, by chance {:.0%}; most of all {}", fits, chance, best.words())
