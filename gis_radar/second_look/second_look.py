"""Check a pose by what stands around the sensor, independently of lanes and traffic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from gis_radar.arrays import Floats
from gis_radar.errors import InputError
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Recording
from gis_radar.scans.scan import open_scan
from gis_radar.second_look.alignment import Alignment, PoseOffset, align
from gis_radar.second_look.settings import DEFAULTS, SecondLookSettings
from gis_radar.second_look.standing import LevelFrame, Slow, Standing, read_slow, standing
from gis_radar.second_look.structure import Structure, box_around, read_structure

CONFIRMS, DOUBTS, NOTHING = "confirms", "doubts", "nothing to compare"


@dataclass(frozen=True, kw_only=True)
class SecondLook:
    """What stands around a sensor, compared with an airborne scan at a pose, and the verdict.

    The score is the share of what stands (cells of half a metre) that is on canopy and walls of
    the scan. It does not measure height, roll and pitch.

    Parameters
    ----------
    pose : Pose
        The pose that was looked at.
    verdict : str
        `confirms`, `doubts` or `nothing to compare`.
    reason : str
        Why, in one line.
    score : float
        Score at the pose, 0 to 1; NaN where there was nothing to compare.
    chance : float
        Mean score of all poses up to 10 m away, in all headings.
    best : PoseOffset, optional
        Where the score is highest, near the pose or up to 10 m ahead and aside, in all headings.
    rival : PoseOffset, optional
        The best one a lane (3 m) or 3 degrees and more away from the pose.
    lead : float
        By how many standard deviations what stands prefers the pose to `rival`; negative where it
        prefers the rival, infinite where there is none.
    standing : Standing
        What stands, in the level frame of the pose.
    closeness : (n,) array
        How close each of its cells is to a structure, 0 to 1; the score is the mean.
    covered : float
        Share of those cells over which the scan has points.
    structure : Structure
        What the scan shows.
    surface : (k, k) array
        Scores at the pose's heading, (ahead, left) every 0.5 m from -10 to 10 m.
    range_m : float
        Slant range of 99.9 % of the recording's detections, metres; 0 without any.
    settings : SecondLookSettings
        What was in effect.
    """

    pose: Pose
    verdict: str
    reason: str
    score: float = float("nan")
    chance: float = float("nan")
    best: PoseOffset | None = None
    rival: PoseOffset | None = None
    lead: float = float("nan")
    standing: Standing = field(repr=False)
    closeness: Floats = field(repr=False, default_factory=lambda: np.empty(0))
    covered: float = float("nan")
    structure: Structure = field(repr=False)
    surface: Floats = field(repr=False, default_factory=lambda: np.empty((0, 0)))
    settings: SecondLookSettings = field(repr=False, default=DEFAULTS)
    range_m: float = 0.0

    @property
    def level(self) -> LevelFrame:
        """The frame of the cells and the structure."""
        return LevelFrame(pose=self.pose)

    def __repr__(self) -> str:
        return f"SecondLook({self.pose.sensor}: {self.verdict}: {self.reason})"

    def figures(self) -> Mapping[str, Any]:
        """Return the figures and the settings in effect, ready for JSON.

        `best_east_m`, `best_north_m` and `best_turn_deg` lead from the pose to where the score is
        highest.
        """
        found: dict[str, Any] = {
            "verdict": self.verdict,
            "reason": self.reason,
            "standing_cells": len(self.standing),
            "scan_classified": self.structure.classified,
        }
        if self.best is not None:
            east, north = self._east_north(self.best)
            found |= {
                "covered": round(self.covered, 3),
                "score": round(self.score, 3),
                "chance": round(self.chance, 3),
                "best_score": round(self.best.score, 3),
                "best_east_m": round(east, 2),
                "best_north_m": round(north, 2),
                "best_turn_deg": round(self.best.turn_deg, 2),
            }
        if self.rival is not None:
            found |= {"rival_score": round(self.rival.score, 3), "lead": round(self.lead, 2)}
        return found | {"settings": asdict(self.settings)}

    def _east_north(self, offset: PoseOffset) -> tuple[float, float]:
        place = np.array([[offset.ahead_m, offset.left_m]])
        east, north = self.level.to_map(place)[0] - self.pose.position[:2]
        return float(east), float(north)


def require_scans_near(
    scans: Sequence[str | Path],
    crs: CRS,
    place: Sequence[float],
    *,
    scan_crs: Any = None,
    settings: SecondLookSettings = DEFAULTS,
) -> None:
    """Refuse scans that cannot serve a second look at a sensor; reads their headers only.

    Parameters
    ----------
    scans, scan_crs, settings
        As for :func:`second_look`.
    crs : CRS
        The map frame.
    place : (easting, northing, ...)
        About where the sensor is, metres.

    Raises
    ------
    InputError
        If none of them reaches within 300 m, or one is damaged; CrsError if one has no projected,
        metric coordinate system.
    """
    box = box_around(place[0], place[1], settings.most_reach_m)
    # each is opened, so that a bad one is refused at once
    near = [open_scan(scan, crs=scan_crs).touches(box, crs) for scan in scans]
    if not any(near):
        raise _elsewhere(scans, settings.most_reach_m, "the sensor", place, crs)


def _elsewhere(
    scans: Sequence[str | Path], reach_m: float, what: str, place: Sequence[float], crs: CRS
) -> InputError:
    names = ", ".join(str(scan) for scan in scans[:3]) + (" ..." if len(scans) > 3 else "")
    return InputError(
        f"{names}: no point within {reach_m:.0f} m of {what}",
        hint=f"it stands at {place[0]:.0f} {place[1]:.0f} in {crs.name}; "
        "take the scan of that place",
    )


def second_look(
    recording: str | Path | Recording,
    pose: Pose,
    scans: Sequence[str | Path],
    *,
    scan_crs: Any = None,
    settings: SecondLookSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> SecondLook:
    """Check whether what stands around a sensor agrees with a pose (the paper's Fig. 2).

    Facades, crowns with their rustling leaves, and poles are detected repeatedly at one place. At
    the right pose they are on the canopy and at the walls of an airborne scan, and at no other
    pose nearby. Lanes and traffic are not used.

    Parameters
    ----------
    recording : str, Path or Recording
        What the sensor recorded; its last 2000 frames count.
    pose : Pose
        The pose to check.
    scans : sequence of paths
        Airborne scans (LAS, LAZ, COPC), whole and not masked; classified or not.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    settings : SecondLookSettings
        Choices of the algorithm.
    reporter : Reporter
        Where progress and the verdict go.

    Returns
    -------
    SecondLook

    Raises
    ------
    InputError
        If a file cannot be read, or no scan has a point near the pose; CrsError if a scan has no
        projected, metric coordinate system.
    """
    slow = read_slow(recording, settings=settings, reporter=reporter)
    level = LevelFrame(pose=pose)
    reach_m = float(np.clip(slow.reach_m, settings.least_reach_m, settings.most_reach_m))
    structure = read_structure(
        scans, level, reach_m=reach_m + settings.margin_m, scan_crs=scan_crs, settings=settings,
        reporter=reporter,
    )  # fmt: skip
    if structure is None:
        raise _elsewhere(scans, reach_m, pose.sensor, pose.position.tolist(), pose.crs)
    found = standing(slow, level, structure.ground, reach_m=reach_m, settings=settings)
    look = SecondLook(
        pose=pose, verdict=NOTHING, reason=_too_little(slow, found, structure, settings),
        standing=found, structure=structure, range_m=slow.range_m, settings=settings,
    )  # fmt: skip
    look = look if look.reason else _compare(look)
    text = f"second look: {look.verdict}: {look.reason}"
    reporter.log(text, "warning" if look.verdict == DOUBTS else "info")
    return look


def _too_little(
    slow: Slow, found: Standing, structure: Structure, settings: SecondLookSettings
) -> str:
    """Return why there is nothing to compare, or nothing."""
    if len(slow.points) == 0:
        return "the recording has no still detections"
    if len(found) < settings.least_cells or found.patches < settings.least_patches:
        return f"little stands in view: {len(found)} cells in {found.patches} places"
    if not structure.visible.any():
        return "the scan shows neither canopy nor walls here"
    return ""


def _compare(look: SecondLook) -> SecondLook:
    """Return the look with scores, and with the verdict that follows from them."""
    found, structure, settings = look.standing, look.structure, look.settings
    alignment = align(found, structure, settings)
    here = alignment.here
    peaks, chance = alignment.explored()
    tops = [alignment.climbed(peak.place) for peak in (here, *peaks)]
    best = max(tops, key=lambda top: top.score)
    others = [o for o in (*peaks, *tops) if o.beyond(settings.lane_m, settings.askew_deg)]
    rivals = [alignment.climbed(other.place, apart=True) for other in others]
    rival = max(rivals, key=lambda top: top.score, default=None)
    rows, columns = LevelFrame.cells(found.points, len(structure.top))
    look = replace(
        look, score=here.score, chance=chance, best=best, rival=rival,
        lead=alignment.lead(here, rival) if rival else float("inf"),
        closeness=alignment.at(here.place), surface=alignment.surface(),
        covered=float(np.isfinite(structure.top[rows, columns]).mean()),
    )  # fmt: skip
    verdict, reason = _verdict(look, alignment, best)
    return replace(look, verdict=verdict, reason=reason)


def _verdict(look: SecondLook, alignment: Alignment, best: PoseOffset) -> tuple[str, str]:
    limits = look.settings
    fits = f"{look.score:.0%} of what stands lies on the scan's canopy and walls"
    elsewhere = best.beyond(limits.same_m, limits.same_deg)
    other = best if elsewhere else look.rival
    if elsewhere and alignment.lead(best, alignment.here) >= limits.better_sigmas:
        return DOUBTS, f"{fits}, but {best.score:.0%} {best.words()}"
    if look.covered < limits.least_covered:
        return NOTHING, f"the scan covers {look.covered:.0%} of what stands in view"
    if alignment.over(look.chance) < limits.better_sigmas:
        return DOUBTS, f"{fits}, hardly more than by chance ({look.chance:.0%})"
    if other is not None and (elsewhere or alignment.lead(best, other) < limits.clear_sigmas):
        return NOTHING, f"{fits}, and {other.score:.0%} {other.words()}: both may be right"
    return CONFIRMS, f"{fits}, by chance {look.chance:.0%}; most of all {best.words()}"
