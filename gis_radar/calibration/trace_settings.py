"""Settings of traces of vehicles and of the lanes that they are registered to."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TraceSettings:
    """How moving detections become tracks and samples.

    Parameters
    ----------
    frames, least_frames : int
        Window, 100 s at 20 Hz (the paper's n_f); fewer are refused: 5 s show no traffic.
    min_speed_mps : float
        Least absolute range rate (the paper).
    link_s : float
        Longest gap in a track: a far vehicle is hit in every fourth frame or so.
    range_m : float
        Largest disagreement of range and Doppler: between the faces of one vehicle.
    across_m, across_mps : float
        Largest step across the sight: a vehicle's size, and a crossing speed the Doppler misses.
    rate_mps : float
        Largest difference of range rates in a track: a vehicle that turns.
    segment_s : float
        A stream of vehicles that never breaks counts as several tracks of this length.
    min_points, min_path_m : int, float
        A track of fewer is a false alarm, a slow track of a shorter path is a leaf.
    sure_mps : float
        Median range rate that leaves stay below.
    walk_mps : float
        Tracks that are slower by range rates and way may be of walkers, with their limbs.
    creeping : float
        These are left out where they are more than that share of tracks: up to 0.11 in a gridlock,
        0.2 and more with 48 walkers in view; as many as the fit takes for strays do no harm.
    voxel_m, per_voxel : float, int
        Voxels wider than a vehicle, in which so many samples keep its faces' proportion.
    most : int
        Samples in all; cost grows in proportion.
    crowd_m : float
        Length over which the samples of a vehicle share its swaying (`Model.wander`).
    hidden_s, vehicle_m, stray_mps : float
        A track that begins where the last one of a hidden vehicle would be by then, within its
        length and a growing error, is of the same vehicle.
    pace_s, pace_mps : float
        Where a track begins and how it goes is taken over so long; of one vehicle's tracks the
        range rates differ by no more: more than `rate_mps`, as it may turn while it is hidden.
    pace_points : int
        Fewer detections in `pace_s` are no pace: of three the middle one may be a limb.
    spell_s : float
        Time over which they share an error of elevation (`Model.bent`), much shorter than the time
        in which it changes.
    """

    frames: int = 2000
    least_frames: int = 100
    min_speed_mps: float = 0.15
    link_s: float = 0.35
    range_m: float = 1.5
    across_m: float = 1.5
    across_mps: float = 6.0
    rate_mps: float = 1.5
    segment_s: float = 8.0
    min_points: int = 6
    min_path_m: float = 3.0
    sure_mps: float = 1.5
    walk_mps: float = 2.7
    creeping: float = 0.15
    voxel_m: float = 6.0
    per_voxel: int = 8
    most: int = 6000
    crowd_m: float = 10.0
    hidden_s: float = 6.0
    vehicle_m: float = 5.0
    stray_mps: float = 1.0
    pace_s: float = 0.5
    pace_mps: float = 3.0
    pace_points: int = 4
    spell_s: float = 1.0


@dataclass(frozen=True, kw_only=True)
class LaneSettings:
    """How lanes are sampled, and which of them a detection may lie on.

    Parameters
    ----------
    step_m, cell_m : float
        Spacing of centre line samples and edge of the grid's cells: bends of 10 m radius stay
        within 1 cm.
    bins : int
        Of direction, 22.5 degrees each: lanes of a junction stay apart.
    reach_m : float
        A point farther from every lane matches none; more than three lanes.
    margin_m : float
        Lanes beyond the farthest traces and the error of the guess.
    same_level_m : float
        Scanned points farther from the map's height are of another storey.
    scan_near_m, scan_points : float, int
        Scanned points that give a sample's height (their median).
    slope_reach : int
        Samples either way over which the rise is taken.
    most_slope : float
        Steeper is an error: roads rise 12 % at most (RAL), ramps 20 %.
    unlimited_mps : float
        Top speed where the map has no limit, 200 km/h.
    speeding, min_top_mps : float
        Top speed over the limit, and at least (54 km/h).
    level_m, level_share : float
        Largest height between sample and lane, plus that share of the range (3 degrees of tilt).
    border_m : float
        A sample nearer to its lane's middle is no other lane's: less than half a lane.
    slack_mps : float
        Range rates may disagree with a lane by noise and the turning of a long vehicle.
    """

    step_m: float = 1.0
    cell_m: float = 1.0
    bins: int = 16
    reach_m: float = 12.0
    margin_m: float = 20.0
    same_level_m: float = 2.0
    scan_near_m: float = 2.0
    scan_points: int = 12
    slope_reach: int = 3
    most_slope: float = 0.2
    unlimited_mps: float = 55.0
    speeding: float = 1.5
    min_top_mps: float = 15.0
    level_m: float = 4.0
    level_share: float = 0.05
    border_m: float = 1.0
    slack_mps: float = 0.5
