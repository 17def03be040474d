"""Check a pose by what stands around the sensor, independently of lanes and traffic.

The score of a pose is how well what stands in a recording fits a scan; it is compared with the
scores of poses moved and turned from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import scipy
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

# Standard deviation of a detection's distance from its structure: a radar sees a wall, the scan the
# edge of its roof.
CLOSE_M = 0.75
LANE_M, ASKEW_DEG = 3.0, 3.0  # a pose moved (a lane's width) or turned so far is another pose
# Standard deviations by which another pose must be better for `doubts` (by chance one in 700), and
# the pose better than all others for `confirms` (one in 40).
BETTER_SIGMAS, CLEAR_SIGMAS = 3.0, 2.0
LEAST_CELLS = 60  # with fewer cells there is nothing to compare
LEAST_COVERED = 0.5  # share of the cells that the scan must cover
COARSE_CELLS = 2  # width of the cells in the search over all headings, in cells
TURN_DEG = 1.0  # step of heading of that search
CANDIDATES = 8  # peaks of that search that are refined
# Steps of the hill climbing, metres and degrees.
CLIMBING_STEPS: tuple[tuple[float, float], ...] = ((1.0, 1.0), (0.5, 0.5), (0.25, 0.25), (0.1, 0.1))
# A pose moved and turned by less is the same one: nearer to this lane than to the next.
SAME_M = 1.75
SAME_DEG = 1.5
LEAST_PATCHES = 12  # with fewer patches there is nothing to compare
# Limits of the radius: 300 m is the longest range of the sensors.
LEAST_REACH_M = 60.0
MOST_REACH_M = 300.0
MARGIN_M = 20.0  # scan read beyond that radius: farthest place that is compared

HERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Comparison of what stands with a scan.

    The score of a pose is the mean over the standing cells of `exp(-d^2 / 2 CLOSE_M^2)`, with `d`
    their distance to the nearest structure of the scan: about the share of them that fits.

    Parameters
    ----------
    standing : Standing
        The standing cells, in the level frame of the answer.
    closeness : (n, n) array
        That exponential for each cell of the frame, 0 to 1.
    """

    standing: Standing = field(repr=False)
    closeness: Floats = field(repr=False)

    def at(self, offset: Sequence[float]) -> Floats:
        """Return the closeness of each standing cell at (ahead, left, turn in degrees)."""
        ahead, left, turn = offset
        angle = np.radians(turn)
        cos, sin = np.cos(angle), np.sin(angle)
        x, y = self.standing.points[:, :2].T
        place = np.array([cos * x - sin * y + ahead, sin * x + cos * y + left]) / CELL_M
        place += len(self.closeness) // 2 - 0.5
        return np.asarray(
            scipy.ndimage.map_coordinates(self.closeness, place, order=1, mode="constant")
        )

    def score(self, offset: Sequence[float] = HERE) -> float:
        """Return the score at (ahead, left, turn in degrees)."""
        return float(self.at(offset).mean())

    def offset(self, place: Sequence[float]) -> PoseOffset:
        """Return an offset with its score."""
        ahead, left, turn = (float(value) for value in place)
        turn = (turn + 180.0) % 360.0 - 180.0
        return PoseOffset(ahead_m=ahead, left_m=left, turn_deg=turn, score=self.score(place))

    @property
    def here(self) -> PoseOffset:
        """The answer itself as an offset."""
        return self.offset(HERE)

    def z_score(self, one: PoseOffset, other: PoseOffset) -> float:
        """Return by how many standard deviations what stands prefers one offset to another.

        Neighbouring cells show one wall or one tree, so patches of them are the units.
        """
        return self._vote(self.at(one.place) - self.at(other.place))

    def over(self, chance: float) -> float:
        """Return by how many standard deviations the answer's score is above `chance`."""
        return self._vote(self.at(HERE) - chance)

    def _vote(self, gain: Floats) -> float:
        votes = np.bincount(self.standing.patch, gain)
        spread = float(np.sqrt((votes**2).sum()))
        return float(votes.sum()) / spread if spread > 0.0 else 0.0

    def climbed(self, place: Sequence[float], *, apart: bool = False) -> PoseOffset:
        """Climb from an offset to the top nearby; with `apart`, stay away from the answer."""
        best = self.offset(place)
        farthest_m = SHIFT_M * np.sqrt(2.0)
        for shift_m, turn_deg in CLIMBING_STEPS:
            step = np.array([shift_m, shift_m, turn_deg])
            for _ in range(30):
                around = [self.offset(best.place + move * step) for move in _MOVES]
                around = [o for o in around if o.shift_m <= farthest_m]
                if apart:
                    around = [o for o in around if o.beyond(LANE_M, ASKEW_DEG)]
                top = max(around, key=lambda o: o.score, default=best)
                if top.score <= best.score + 1e-9:
                    break
                best = top
        return best

    def surface(self) -> Floats:
        """Return the scores at the answer's heading, (ahead, left) every cell up to `shift_m`."""
        return np.asarray(_scores(self, [0.0])[0])

    def explored(self) -> tuple[list[PoseOffset], float]:
        """Return the best offsets apart from each other in all headings, and the mean score."""
        turns = np.arange(-180.0, 180.0, TURN_DEG)
        scores = _scores(self, turns.tolist(), COARSE_CELLS)
        size = (7, 5, 5)
        top = scipy.ndimage.maximum_filter(scores, size, mode=("wrap", "nearest", "nearest"))
        order = np.argsort(-np.where(scores == top, scores, -1.0), axis=None)[:CANDIDATES]
        turn, ahead, left = np.unravel_index(order, scores.shape)
        middle, cell_m = scores.shape[1] // 2, CELL_M * COARSE_CELLS
        places = np.column_stack([(ahead - middle) * cell_m, (left - middle) * cell_m, turns[turn]])
        return [self.offset(place) for place in places], float(scores.mean())


_MOVES = np.array([move for move in product((-1, 0, 1), repeat=3) if any(move)], float)


def align(standing: Standing, structure: Structure) -> Alignment:
    """Compare what stands with a scan that shows something."""
    away = scipy.ndimage.distance_transform_edt(~structure.visible) * CELL_M
    closeness = np.asarray(np.exp(-0.5 * (away / CLOSE_M) ** 2))
    return Alignment(standing=standing, closeness=closeness)


def _scores(alignment: Alignment, turns_deg: Sequence[float], coarse: int = 1) -> Floats:
    """Return the scores of all shifts at once, by convolution: (headings, ahead, left)."""
    field, points = alignment.closeness, alignment.standing.points[:, :2]
    if coarse > 1:
        field = scipy.ndimage.gaussian_filter(field, coarse * CLOSE_M / CELL_M / 2.0)
    size, cell_m = len(field) // coarse, CELL_M * coarse
    field = field[: size * coarse, : size * coarse]
    field = field.reshape(size, coarse, size, coarse).mean(axis=(1, 3))
    side = int(scipy.fft.next_fast_len(size, real=True))
    spectrum = scipy.fft.rfft2(field.astype(np.float32), (side, side))
    most = round(SHIFT_M / cell_m)
    reach = np.arange(-most, most + 1)
    scores = []
    for angle in np.radians(turns_deg):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        place = np.floor(points @ turn / cell_m + size / 2.0).astype(np.int64)
        count = np.bincount(place[:, 0] * side + place[:, 1], minlength=side**2)
        image = scipy.fft.rfft2(count.astype(np.float32).reshape(side, side))
        rows = scipy.fft.ifft(spectrum * np.conj(image), axis=0)[reach]  # only shifts within reach
        found = scipy.fft.irfft(rows, side, axis=1)[:, reach]
        scores.append(np.asarray(found, np.float64) / len(points))
    return np.stack(scores)


def require_scans_near(
    scans: Sequence[str | Path],
    crs: CRS,
    place: Sequence[float],
    *,
    name: str = "the sensor",
    scan_crs: Any = None,
) -> None:
    """Refuse scans that cannot serve to check a sensor's pose; reads their headers only.

    Parameters
    ----------
    scans, scan_crs
        As for :func:`scan_check`.
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
    reach_m = MOST_REACH_M
    box = box_with_margin((place[0], place[1], place[0], place[1]), reach_m)
    # all are opened, so that a damaged one is refused at once
    near = [open_scan(scan, crs=scan_crs).touches(box, crs) for scan in scans]
    if not any(near):
        raise _elsewhere(scans, reach_m, name, place, crs)


def _elsewhere(
    scans: Sequence[str | Path], reach_m: float, what: str, place: Sequence[float], crs: CRS
) -> InputError:
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
    """Check whether what stands around a sensor agrees with a pose (the paper's Fig. 2).

    Facades, crowns with their rustling leaves, and poles are detected repeatedly at one place. At
    the right pose they are on the canopy and at the walls of an airborne scan, and at no other
    pose nearby. Lanes and traffic are not used.

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
    reach_m = float(np.clip(slow.reach_m, LEAST_REACH_M, MOST_REACH_M))
    structure = read_structure(
        scans, level, reach_m=reach_m + MARGIN_M, scan_crs=scan_crs, reporter=reporter
    )
    if structure is None:
        raise _elsewhere(scans, reach_m, pose.sensor, pose.position.tolist(), pose.crs)
    found = standing(slow, level, structure.ground, reach_m=reach_m)
    reason = _too_little(slow, found, structure)
    compared = {"verdict": UNCLEAR, "reason": reason} if reason else _compared(found, structure)
    look = ScanCheck(
        pose=pose, standing=found, structure=structure, range_m=slow.range_m, **compared
    )
    text = Text("scan check: {}: {}", look.verdict, look.reason)
    reporter.log(text, "warning" if look.verdict in {DOUBTS, UNDECIDED} else "info")
    return look


def _too_little(slow: Slow, found: Standing, structure: Structure) -> str:
    """Return why there is nothing to compare; empty where there is enough."""
    if len(slow.points) == 0:
        return "the recording has no still detections with an elevation"
    if len(found) < LEAST_CELLS or found.patches < LEAST_PATCHES:
        return Text("little stands in view: {} cells in {} places", len(found), found.patches)
    if not structure.visible.any():
        return "the scan shows neither canopy nor walls here"
    return ""


def _compared(found: Standing, structure: Structure) -> dict[str, Any]:
    """Return the fields of a scan check that come from comparing, verdict and reason included."""
    alignment = align(found, structure)
    here = alignment.here
    peaks, chance = alignment.explored()
    tops = [alignment.climbed(peak.place) for peak in (here, *peaks)]
    best = max(tops, key=lambda top: top.score)
    others = [o for o in (*peaks, *tops) if o.beyond(LANE_M, ASKEW_DEG)]
    rivals = [alignment.climbed(other.place, apart=True) for other in others]
    rival = max(rivals, key=lambda top: top.score, default=None)
    rows, columns = LevelFrame.cells(found.points, len(structure.top))
    covered = float(np.isfinite(structure.top[rows, columns]).mean())
    verdict, reason = _verdict(alignment, best, rival, chance, covered)
    return {
        "verdict": verdict, "reason": reason, "score": here.score, "chance": chance, "best": best,
        "rival": rival, "z_score": alignment.z_score(here, rival) if rival else float("inf"),
        "closeness": alignment.at(here.place), "covered": covered, "surface": alignment.surface(),
    }  # fmt: skip


def _verdict(
    alignment: Alignment, best: PoseOffset, rival: PoseOffset | None, chance: float, covered: float
) -> tuple[str, str]:
    here = alignment.here
    fits = Text("{:.0%} of what stands lies on the scan's canopy and walls", here.score)
    elsewhere = best.beyond(SAME_M, SAME_DEG)
    other = best if elsewhere else rival
    if elsewhere and alignment.z_score(best, here) >= BETTER_SIGMAS:
        return DOUBTS, Text("{}, but {:.0%} {}", fits, best.score, best.words())
    if covered < LEAST_COVERED:
        return UNCLEAR, Text("the scan covers {:.0%} of what stands in view", covered)
    if alignment.over(chance) < BETTER_SIGMAS:
        return DOUBTS, Text("{}, hardly more than by chance ({:.0%})", fits, chance)
    if other is not None and (elsewhere or alignment.z_score(best, other) < CLEAR_SIGMAS):
        return UNDECIDED, Text(
            "{}, and {:.0%} {}: both may be right", fits, other.score, other.words()
        )
    return CONFIRMS, Text("{}, by chance {:.0%}; most of all {}", fits, chance, best.words())
