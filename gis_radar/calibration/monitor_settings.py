"""Settings of the tracking: every constant of its algorithms, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import radians
from typing import Any

from scipy.special import gammaincinv

from gis_radar.calibration.settings import LocalizationSettings, Schedule, changed
from gis_radar.calibration.solver import FAR

HOUR_S = 3600.0

Six = tuple[float, float, float, float, float, float]
_WINDOW = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=12)
_LANE_OFF = Schedule(scales_m=(0.75, 0.3), rounds=3)
_FAR = replace(FAR, rounds=12)


@dataclass(frozen=True, kw_only=True)
class AlarmSettings:
    """Settings of the alarm: how a small move is noticed against the sensor's own first hour.

    Lengths across a lane are means of a vehicle in a cell. *Measured* is on two hours of the sample
    junction, simulated as recorded (`bench/alarm.py`).

    Parameters
    ----------
    cell_m, stretch_m : float
        Cells of lanes, in which a vehicle's place is one number; and stretches, in which whatever
        makes drivers change their habit (a parked van, a cyclist) concerns all cells.
    apart_m, same_line_m : float
        Where lanes of one direction run nearer than a lane's width, and are not the same line, a
        vehicle may be of either: left out.
    same_way : float
        Cosine of the angle between directions that are one, 25 degrees.
    within_m, taper_m : float
        Half a lane: what is farther from its middle drives elsewhere; and from where on it counts
        less and less.
    over_m : (float, float)
        Heights over the road between which vehicles reflect.
    half_width_m : float
        From a vehicle's side to its middle, as in the localization.
    least_mps : float
        What is slower may walk.
    smooth_s : float
        A detection's velocity is the slope of its track so long before and after.
    whole_s : float
        Tracks are not cut, a vehicle is one cluster: any length beyond that of the window.
    hidden_s, vehicle_m, stray_mps : float
        A track that begins where the last one of a hidden vehicle would be by then, within its
        length and a growing error, is of the same vehicle.
    least_hits : int
        Fewer detections in a cell state no mean.
    driver_m, sway_m, hit_m : float
        Standard deviations: between vehicles, from cell to cell, and of one detection (faces,
        bearing). Measured: 0.35, 0.45 to 0.49, 0.3 to 0.6.
    tall_m, bump_m, elevation_hit_m, elevation_rad : float
        The same of heights over the road, and what grows with range; measured.
    block_s : float
        Traffic is summed by blocks, and tested at the end of each.
    warm_up : int
        Blocks of reference with which the dispersion can be measured.
    settle_s : float
        A vehicle counts in the block so long after its last detection, when none may follow.
    blocks : tuple of int
        Newest blocks that are tested: five for a strong move, nine for a small one (with
        `settle_s` within ten minutes), thirty for light traffic.
    share : float
        The tested blocks are at most that share of all there are: no alarm before 15 minutes,
        nine blocks are tested from 27 on, thirty from 90 on.
    reference_h, reference_vehicles : float, int
        The reference is the first hour; then it forgets within an hour or so many vehicles,
        whichever takes longer, to follow what changes slowly.
    least_vehicles : int
        Fewer in the tested blocks contradict nothing.
    known : float
        Cells of which the reference holds less than so many vehicles do not measure dispersion.
    least_seen : float
        Combinations of moves and habits that blocks show less than so well do not, either.
    dispersion, dispersion_blocks : float
        Ratio of the scatter between blocks to what independent vehicles make (broken tracks,
        platoons; measured 1.4 to 2.1): before it is measured at the sensor, and how many blocks
        that counts for.
    stretch_habit_m, outlier : float
        How far drivers change their habit on a stretch within an hour, one standard deviation; and
        from how many on it is no habit but an obstacle, which weighs less and less.
    common_m, breadth_m : float
        The same of all drivers at once (rain, night), and of where vehicles reflect, seen from the
        sensor (trucks are broader).
    height_habit_m, taller_m : float
        The same of heights over the road: of a stretch, of all vehicles.
    gate : float
        Score beyond which a move is noticed: 0.2 false alarms a month, 95 % under 2.0, by the tail
        of 240 hours of changing traffic (`bench/alarm.py`).
    rounds : int
        Reweightings of stretches.
    """

    cell_m: float = 12.0
    stretch_m: float = 48.0
    apart_m: float = 2.2
    same_line_m: float = 0.3
    same_way: float = 0.9
    within_m: float = 1.75
    taper_m: float = 1.3
    over_m: tuple[float, float] = (-2.0, 5.0)
    half_width_m: float = 0.9
    least_mps: float = 2.7
    smooth_s: float = 1.0
    whole_s: float = 1e6
    hidden_s: float = 6.0
    vehicle_m: float = 5.0
    stray_mps: float = 1.0
    least_hits: int = 3
    driver_m: float = 0.35
    sway_m: float = 0.46
    hit_m: float = 0.5
    tall_m: float = 0.55
    bump_m: float = 0.3
    elevation_hit_m: float = 1.0
    elevation_rad: float = 0.014
    block_s: float = 60.0
    warm_up: int = 10
    settle_s: float = 7.0
    blocks: tuple[int, ...] = (5, 9, 30)
    share: float = 0.34
    reference_h: float = 1.0
    reference_vehicles: int = 1000
    least_vehicles: int = 12
    known: float = 3.0
    least_seen: float = 0.05
    dispersion: float = 2.0
    dispersion_blocks: float = 20.0
    stretch_habit_m: float = 0.05
    outlier: float = 2.0
    common_m: float = 0.05
    breadth_m: float = 0.02
    height_habit_m: float = 0.08
    taller_m: float = 0.15
    gate: float = 24.0
    rounds: int = 4


@dataclass(frozen=True, kw_only=True)
class StillTargetSettings:
    """Settings of the second change detector: what stands still around the sensor.

    *Recorded* is on recordings of an ARS548 (a target repeats to 0.01 m, 0.05 and 0.1 to 2 degrees;
    over seconds it wanders by 0.1 m, 0.15 and 1 degree), *measured* on `bench/alarm.py`.

    Parameters
    ----------
    block_s : float
        The place of a target is its median over so long: a shake is shorter, and four cycles.
    reach_m, cell_m, cell_rad : float
        Hits are mapped by range and azimuth, up to there and in such cells: finer than a target's
        wander.
    first_search, search_blocks : int
        Targets are looked for after two minutes, and new ones every five.
    least_rate : float
        Hits a frame that make a target. Recorded: cells hit in half of the frames or more hold 46
        to 84 % of the still detections.
    gate_m, gate_rad : float
        How far from its mean a detection is still of a target: three times its wander and the
        wanted move, to either side; across it is `wanted_m` more.
    apart_m : float
        Targets stand at least so far apart: gates do not overlap at 100 m, and a parked car is
        two targets at most.
    least_share : float
        A target is seen in a block with that share of its usual hits.
    gone_blocks : int
        A target that was not seen for so many blocks, an hour, is dropped.
    reference_blocks : int
        The mean forgets within so many blocks, 10 minutes: twice what is tested; over an hour the
        drift allowed to a mast would hide half a degree.
    least_age : int
        Blocks in a mean that counts; no verdict before seven minutes.
    blocks : tuple of int
        Newest blocks that are tested for a move, longer than any gust.
    blow_blocks, latest_blocks : int
        The newest ones that exclude a blow; and those that show how far a move went.
    lasting_blocks : int
        So many tests in a row find a move that is one; the scatter of some dozen targets is a
        rough figure, and in one test in some thousands far too small.
    least_targets, least_present : int, float
        Fewer targets, or a smaller share of all, contradict nothing: in snow, or after a blow that
        puts all beyond their gates.
    wander_m, wander_rad : float, (float, float)
        Recorded; only where the search for the common move begins.
    least_scatter : (float, float, float)
        No target repeats better than that, range, azimuth and elevation; what is recorded is stored
        in steps of that size.
    outlier : float
        From so many times the scatter on a target counts less (Cauchy's weight): a car that came
        where another left.
    rounds : int
        Of weights and scatter; both are settled after seven.
    wanted_m, wanted_rad, sure : float
        The move to be noticed; where a standard deviation is over that share of it, in the plane or
        of an angle, vehicles are asked, too.
    gate : float
        Score beyond which a move is noticed, from 120 hours of changing days of one radar
        (`bench/alarm.py --seed 1`); false alarms on other hours are in docs/limits.md.
    """

    block_s: float = 20.0
    reach_m: float = 300.0
    cell_m: float = 0.2
    cell_rad: float = radians(0.4)
    first_search: int = 6
    search_blocks: int = 15
    least_rate: float = 0.3
    gate_m: float = 0.7
    gate_rad: float = radians(1.0)
    apart_m: float = 3.0
    least_share: float = 0.5
    gone_blocks: int = 180
    reference_blocks: int = 30
    least_age: int = 6
    blocks: tuple[int, ...] = (6, 15)
    blow_blocks: int = 1
    latest_blocks: int = 3
    lasting_blocks: int = 3
    least_targets: int = 12
    least_present: float = 0.5
    wander_m: float = 0.1
    wander_rad: tuple[float, float] = (radians(0.15), radians(1.0))
    least_scatter: tuple[float, float, float] = (0.004, radians(0.005), radians(0.02))
    outlier: float = 2.0
    rounds: int = 10
    wanted_m: float = 0.3
    wanted_rad: float = radians(0.5)
    sure: float = 0.34
    gate: float = 28.0


@dataclass(frozen=True, kw_only=True)
class MonitorSettings:
    """All settings of the tracking.

    Vectors of six are easting, northing, height and turns about the map's axes: metres, radians.

    Parameters
    ----------
    cycle_s : float
        Time between two corrected poses, seconds (the paper).
    least_cycle : float
        A last cycle shorter than that share of one gives no pose.
    drift : (6,) tuple
        1 sigma of how far a mast bends within an hour, in sun and wind.
    by_hand : (6,) tuple
        1 sigma of a start pose that states none: measured with tape, compass and spirit level.
    least_sigma : (6,) tuple
        Least sigma of a start pose; keeps the covariance regular.
    noise_share : float
        Share of the variance of a localized pose that is noise of its window; the rest, errors
        of the map and the model, is in every window.
    near : (6,) tuple
        1 sigma of the prior under which a window is fitted: around the expected pose, wide.
    window : Schedule
        Fit of a window: it starts within decimetres.
    least_known, unknown : float
        Information of the data below that share of the prior's is none, and counts as `unknown`.
    reach_grows : float
        Lanes are sampled so many times as far as the traces reach, so that it is done rarely.
    other_lane, other_lane_m : float
        A pose a lane off refutes the start where the vehicles prefer it by so many standard
        deviations (one more than separates two answers of a localization), and it is so far off.
    lane_off : Schedule
        Of a first fit from a lane off: most come back, half of `other_lane_m` near, and are fitted
        no further.
    lengths_s : tuple of float
        Newest parts of the window that are tested for a move: a short one soon shows a blow, but
        holds few vehicles; a long one shows a shift of some decimetres.
    false_alarms : float
        Moves reported an hour where none was; at most, as if all tests were independent.
    suspect : float
        Level of chi2 above which a move is looked for and the pose's sigma widened.
    scatter_tests, assumed_tests : int
        So many of the last tests measure by how much chi2 is larger here than it should be, with
        so many assumed as it should be. Simulated drivers as recorded: 2 to 3 times, and one false
        move in some minutes without it.
    newest_vehicles : int
        Least vehicles in a tested part; it grows until it holds them.
    agreement : float
        Standard errors by which its vehicles must prefer the move, each counting as one.
        Measured where both other figures are beyond chance: at rest in light traffic 0.1 to 1.5,
        within 25 s of a turn by a degree 1.9 to 2.2, after a shift of half a metre 2.6 to 3.3.
    mature_s : float
        Seconds of data before a tested part from which the pose is known.
    settled_s : float
        A deviation that does not last so long is a shake, seconds.
    latest_s : float
        Newest seconds in which the new pose must still be the better one.
    slice_s : float
        Resolution of the time of a move, seconds: half a second to either side.
    back_s : float
        How long ago a move is looked for, seconds: within the window of 100 s, less `mature_s`.
    change_rounds : int
        Time and pose of a move are estimated in turn so often.
    knock : (6,) tuple
        1 sigma of how far a blow moves a sensor that is still in use.
    far : Schedule
        Fit after a suspected move.
    farthest : float
        Where no near fit lies on lanes, the pose is searched within so many sigmas of `knock`.
    lost_s : float
        `moved` with unknown pose after so many seconds of rejected fits: a whole window.
    alarm : AlarmSettings
        Of small moves.
    still : StillTargetSettings
        Of what stands still.
    localization : LocalizationSettings
        Of window, traces, lanes and fits.
    """

    cycle_s: float = 5.0
    least_cycle: float = 0.5
    drift: Six = (0.02, 0.02, 0.01, radians(0.1), radians(0.1), radians(0.1))
    by_hand: Six = (1.0, 1.0, 1.0, radians(2.0), radians(2.0), radians(2.0))
    least_sigma: Six = (1e-3, 1e-3, 1e-3, radians(1e-3), radians(1e-3), radians(1e-3))
    noise_share: float = 0.3
    near: Six = (1.0, 1.0, 1.0, radians(2.0), radians(2.0), radians(2.0))
    window: Schedule = _WINDOW
    least_known: float = 0.05
    unknown: float = 1e-4
    reach_grows: float = 1.2
    other_lane: float = 3.5
    other_lane_m: float = 1.0
    lane_off: Schedule = _LANE_OFF
    lengths_s: tuple[float, ...] = (20.0, 60.0)
    false_alarms: float = 0.01
    suspect: float = 0.95
    scatter_tests: int = 60
    assumed_tests: int = 4
    newest_vehicles: int = 8
    agreement: float = 1.65
    mature_s: float = 30.0
    settled_s: float = 15.0
    latest_s: float = 8.0
    slice_s: float = 1.0
    back_s: float = 75.0
    change_rounds: int = 2
    knock: Six = (0.7, 0.7, 0.4, radians(3.0), radians(3.0), radians(4.0))
    far: Schedule = _FAR
    farthest: float = 4.0
    lost_s: float = 100.0
    alarm: AlarmSettings = field(default_factory=AlarmSettings)
    still: StillTargetSettings = field(default_factory=StillTargetSettings)
    localization: LocalizationSettings = field(default_factory=LocalizationSettings)

    @property
    def gate(self) -> float:
        """Largest chi2 of six degrees of freedom that is chance, by `false_alarms`."""
        tests = HOUR_S / self.cycle_s * len(self.lengths_s)  # an hour
        return chi2_quantile(1.0 - self.false_alarms / tests)

    @property
    def median_chi2(self) -> float:
        """Median of chi2 of six degrees of freedom."""
        return chi2_quantile(0.5)

    @property
    def suspect_chi2(self) -> float:
        """Chi2 of six degrees of freedom above which a move is looked for."""
        return chi2_quantile(self.suspect)

    def changes(self) -> dict[str, Any]:
        """Return the settings that differ from the defaults, by dotted name."""
        return changed(self, MONITOR)


def chi2_quantile(level: float) -> float:
    """Return the quantile of chi2 of six degrees of freedom, without loading scipy.stats."""
    return float(2.0 * gammaincinv(3.0, level))


MONITOR = MonitorSettings()
ALARM = MONITOR.alarm
