"""Settings of sight: every choice of its algorithm, with unit and source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class SightSettings:
    """What in a scan hides a tile from a sensor.

    Parameters
    ----------
    target_m : float
        Height over the road at which a tile counts as seen, metres (the contract).
    cell_m : float
        Side of the cells in which the scan is gathered, metres.
    window_m : float
        Windows of the scan begin at multiples of this, metres: poses of a track share them.
    tall_m : float
        What is lower over the ground does not hide: parked cars, hedges, rails.
    crown_m : float
        Something stands solid where no return from below lies in a square of this side, metres:
        crowns let pulses through, roofs do not.
    ground_m : float
        What is narrower is no ground, metres: cars, hedges.
    widest_roof_m : float
        In scans without classes: opening that removes roofs from the ground, metres.
    ground_cells : int
        That opening works on squares of so many cells a side.
    least_ground : float
        A scan with a smaller share of points in classes of ground is not classified.
    sunk_m : float
        A ray may pass so far under the ground's surface, metres: noise of scan and map. With 0.4
        rays from below reach the far side of ramps: 13 % of two levels wrongly seen, not 4 %.
    blocked_m : float
        Length of a ray inside what stands from which on it is hidden, metres; 1 or 1.5 move the
        shares wrongly seen by 0.4 %.
    step_m : float
        Distance of the samples of a ray, metres.
    skip_near_m, skip_far_m : float
        Ends of a ray that do not count, metres: a mast stands at a wall or in a crown.
    clear_m : float
        Over a road it is free up to here, metres: the least clearance of bridges and gates.
    levels_apart_m : float
        Tiles at one place that lie farther apart in height are on two levels, metres.
    shoulder_m : float
        Kerbs, shoulders and parapets beside an upper level's tiles belong to it, metres.
    opening_m : float
        Under a deck it is free so far beside the lower level's tiles, metres.
    deck_m : float
        Thickness of a deck, metres.
    gap_m : float
        Cells without points take the heights of ones so near, metres.
    unknown_m : float
        A ray that is not hidden and passes so far over what the scan does not cover: the tile
        counts as in sight, and is counted as not covered.
    least_covered : float
        Warn where the scan decides less than this share of the tiles in the view: the rim of a
        view reaches beyond most scans, and a tenth of it hardly changes a map.
    offset_m : float
        Median difference of the scan's and the tiles' road heights above which the two are not of
        one vertical system, metres.
    windows_kept : int
        Windows of the scan that are kept in memory, 10 MB each.
    pose_apart_m, pose_apart_deg : float
        A file of sight serves poses so near the one it was made for, metres and degrees: a tile,
        and half a metre at 60 m.
    moving_mps : float
        Least absolute range rate of what moves, m/s: leaves and walkers stay below.
    level_m : float
        A detection more than this from 1 m over a tile's road is of another level, metres.
    sector_deg, ring_m : float
        Recorded movement is compared with sight in cells of this direction and distance: wider than
        a radar's error of bearing, narrower than a house; the least driveway between two walls.
    sectors_in_row : int
        A contradiction is so many sectors wide: one alone is an edge, smeared by bearing errors.
    empty_share : float
        A cell is empty where less than this share of the expected movement is there: ghosts of
        facades come to a tenth at most.
    least_in_sector : float
        Frames of movement missed in a sector before it counts as empty.
    least_frames : float
        Frames of movement missed, or seen though hidden, in a run of sectors before it counts:
        half a dozen vehicles, each seen in several frames of several sectors.
    judged_frames : int
        A recording is compared from so many frames from one place on: five minutes at 20 Hz, three
        cycles of a signal. In less time ways stay empty by chance.
    moving_share : float
        Least share of the expected movement there: ghosts and lorries that look over a wall give
        less.
    """

    target_m: float = 0.6
    cell_m: float = 1.0
    window_m: float = 64.0
    tall_m: float = 2.5
    crown_m: float = 3.0
    ground_m: float = 12.0
    widest_roof_m: float = 40.0
    ground_cells: int = 2
    least_ground: float = 0.01
    sunk_m: float = 0.1
    blocked_m: float = 0.5
    step_m: float = 0.5
    skip_near_m: float = 2.0
    skip_far_m: float = 0.5
    clear_m: float = 4.5
    levels_apart_m: float = 3.0
    shoulder_m: float = 4.0
    opening_m: float = 8.0
    deck_m: float = 1.5
    gap_m: float = 3.0
    unknown_m: float = 10.0
    least_covered: float = 0.9
    offset_m: float = 2.0
    windows_kept: int = 8
    pose_apart_m: float = 0.5
    pose_apart_deg: float = 0.5
    moving_mps: float = 1.0
    level_m: float = 2.5
    sector_deg: float = 1.0
    ring_m: float = 10.0
    sectors_in_row: int = 3
    empty_share: float = 0.1
    least_in_sector: float = 2.0
    least_frames: float = 100.0
    judged_frames: int = 6000
    moving_share: float = 0.3


@dataclass(frozen=True, kw_only=True)
class GapSettings:
    """Which stretches of a lane count as never passed although vehicles pass on both sides.

    Parameters
    ----------
    piece_m : float
        Lanelets are looked at in pieces of this length, metres: a car's, so that the radar meets a
        vehicle several times on each.
    share : float
        A piece is empty where less than this share of the expected movement is there. Who queues on
        one side and drives freely past the piece is met ten times less often there.
    least_frames : float
        Frames with movement on a tile expected on such a stretch before it counts: some fifty
        vehicles on a car's length.
    shared : float
        A tile of which another lanelet's tile covers this share tells nothing of its own lane.
    """

    piece_m: float = 5.0
    share: float = 0.01
    least_frames: float = 100.0
    shared: float = 0.05


SIGHT_DEFAULTS = SightSettings()
GAPS = GapSettings()
