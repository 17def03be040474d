"""Settings of the scan check: every choice of its algorithm, with unit and source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ScanCheckSettings:
    """How still detections are compared with an airborne scan.

    Sensitivity (`bench/mask.py --sensitivity`, a sensor of a simulated town, at its true pose and
    3.5 m beside it): with `close_m`, `tall_m`, `overhead_m` or `least_spans` halved or doubled the
    verdicts stay `confirms` and `doubts`; the score moves by up to 0.09 at the true pose, and
    beside it by up to 0.10, with `close_m` doubled by 0.24.

    Parameters
    ----------
    frames : int
        Window at the end of the recording, 100 s at 20 Hz (the paper's n_f).
    slow_mps : float
        Largest absolute range rate: leaves rustle up to here.
    still_mps : float
        Up to here nothing moves (the paper's Doppler threshold); leaves do.
    spans, least_spans : int
        Of so many equal parts of the window a cell is hit in at least so many: what waits or
        passes is not.
    overhead_m : float
        Height over the ground from which on a detection counts: over parked cars, people, shrubs.
    patch_m : float
        Side of the squares that vote as one: a tree, or a piece of wall.
    tall_m : float
        Height from which on a step in the scan is a wall or a crown: over vans and hedges.
    jump_cells : int
        Window in which the step is looked for, cells of 0.5 m.
    gap_cells : int
        Holes of the scan up to so many cells are filled.
    ground_cells : int
        Side of a cell of the ground, cells of 0.5 m.
    widest_roof_m : float
        In scans without classes: opening that removes roofs from the ground.
    least_ground : float
        A scan with a smaller share of points in classes of ground is not classified.
    close_m : float
        Standard deviation of a detection's distance from its structure: a radar sees a wall, the
        scan the edge of its roof.
    coarse : int
        The search over all headings has cells so many times wider.
    turn_deg, shift_m : float
        Its step of heading, and its reach ahead and aside.
    candidates : int
        So many of its peaks are refined.
    steps : tuple of (float, float)
        Steps of the hill climbing, metres and degrees.
    lane_m, askew_deg : float
        From here on a pose is another one: a lane's width.
    same_m, same_deg : float
        Up to here it is the same one: nearer to this lane than to the next.
    better_sigmas : float
        By so much another pose must be better for `doubts`; chance is one in 700.
    clear_sigmas : float
        By so much the pose must be better than all others for `confirms`; chance is one in 40.
    least_cells, least_patches : int
        With fewer cells, or places, there is nothing to compare.
    least_covered : float
        Share of the cells that the scan must cover.
    least_reach_m, most_reach_m : float
        Limits of the radius: 300 m is the longest range of the sensors.
    margin_m : float
        Scan read beyond that radius: reach of the search (14 m) and of the walls.
    """

    frames: int = 2000
    slow_mps: float = 1.0
    still_mps: float = 0.15
    spans: int = 20
    least_spans: int = 8
    overhead_m: float = 2.0
    patch_m: float = 8.0
    tall_m: float = 2.5
    jump_cells: int = 3
    gap_cells: int = 3
    ground_cells: int = 4
    widest_roof_m: float = 40.0
    least_ground: float = 0.01
    close_m: float = 0.75
    coarse: int = 2
    turn_deg: float = 1.0
    shift_m: float = 10.0
    candidates: int = 8
    steps: tuple[tuple[float, float], ...] = ((1.0, 1.0), (0.5, 0.5), (0.25, 0.25), (0.1, 0.1))
    lane_m: float = 3.0
    askew_deg: float = 3.0
    same_m: float = 1.75
    same_deg: float = 1.5
    better_sigmas: float = 3.0
    clear_sigmas: float = 2.0
    least_cells: int = 60
    least_patches: int = 12
    least_covered: float = 0.5
    least_reach_m: float = 60.0
    most_reach_m: float = 300.0
    margin_m: float = 20.0


SCAN_CHECK = ScanCheckSettings()
