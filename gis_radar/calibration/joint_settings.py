"""Settings of vehicles that two sensors see, which relate their poses."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, log, radians


@dataclass(frozen=True, kw_only=True)
class CorrespondenceSettings:
    """Which tracks of two radars are one vehicle, and how well its place is known.

    Parameters
    ----------
    window_s : float
        Of the recordings of several days, the seconds in which most sensors recorded: 2000 frames.
    moment_s : float
        Length of a moment: two or more frames of each radar; a vehicle goes 2-3 m.
    least_moments : int
        Two tracks with fewer common moments are no pair: a second of common sight.
    least_cosine : float
        Between sight and lane, below which the Doppler tells no speed (70 degrees).
    least_straight : float
        Mean of the unit vectors of travel of a moment; below, its detections lie on several lanes.
    longest_m : float
        Detections of one moment farther apart along the lane are of several vehicles, or a lorry.
    least_alike : float
        Cosine between the directions of travel (30 degrees: a bend, and a guess's yaw).
    speed_mps : float
        Largest difference of speeds: wheels, noise of the Doppler over the cosine.
    level_m : float
        Largest difference of heights: bridges are higher.
    least_share : float
        Of the moments that two tracks have in common, in which speed and direction must agree.
    farthest_m : float
        Pairs farther apart than a pose may be wrong are not looked at.
    half_length_m, half_length_spread_m, half_length_sigma_m : float
        From the middle of vehicles to what reflects at their ends, how they differ, and how well
        the mean is known: half of 4.5 m, less 0.1 to 0.35 m, as wheels and the underbody reflect
        from behind a face (1.9 and 2.0 m at the true poses of two simulators).
    half_width_sigma_m, side_sigma : float
        The same of the mean half width, and of the sides' strength (logarithm).
    spot_m : tuple of float
        How far off its mean place, along and across, a vehicle shows for one radar against the
        other for all of its way: mirrors, wheels, rounded corners, hidden ends.
    stretch_m, stretch_sigma_m : float, tuple of float
        What is alike for all vehicles on a stretch of a lane, as both radars see them from there:
        along and across, 0.2 to 0.3 and 0.1 m at the true poses of two simulators.
    moment_sigma_m : float
        Of one moment by itself beside its faces: the radar's range, and its speed times lateness.
    memory_s : float
        Moments closer than this share their error: places that reflect change as aspects do.
    clock_s : float
        Offset of a sensor's clock, one standard deviation: NTP on a local network.
    free_clock_s : float
        The same where it is asked whether clocks are off: at more, no vehicle finds its pair.
    most_lag_s : float
        Largest offset of clocks that is looked for: beyond it, radars have no common time at all.
    clock_rates : tuple of float
        Rates of clocks that are looked for: quartz keeps 1e-4, an ARS430 was 0.8 % slow.
    lag_s : float
        Votes for a lag nearer than this agree: a vehicle's length at 30 km/h, poses within 1 m.
    lag_place_m, lag_speed_mps : float
        Moments farther apart are of two places; slower vehicles tell no time.
    lag_z : float
        By how many standard deviations, as counts scatter, the votes for a lag exceed those for
        any other and for none, and with another rate those without: chance gave 3 in 13.
    lag_clear : float
        Standard deviations by which vehicles must prefer a lag to another place of the sensor.
    same_lag_s : float
        Lags nearer than this are one.
    clock_sigmas : float
        Standard deviations beyond which a clock's offset is remarked upon.
    freedom : float
        Degrees of freedom of Student's t for a pair's misfit: every tenth pair or so is wrong.
    gate_chi2 : float
        Two degrees of freedom: 1 in 1000 true pairs is lost.
    least_pairs : int
        Fewer pairs neither place a sensor nor contradict a pose.
    firm_pairs : int
        Fewer move no pose that is certain by itself: a cluster-robust covariance needs 20 to 50
        clusters (Cameron, Miller 2015), and few vehicles are all on one lane.
    fixed_m : float
        A pose less certain along its weakest direction is looked for along it.
    step_m, reach_m : float
        Grid on which the shift between two sensors is looked for, and how far at least.
    apart_m : float
        Shifts nearer than this, a vehicle's length, are one answer: the adjustment pulls them in.
    clear : float
        Standard deviations by which vehicles must prefer a place to all others (as for one sensor),
        and to what chance gives.
    chance_s : tuple of float
        What chance gives is seen where one sensor's times are wrong by so much: other traffic.
    contradiction_chi2 : float
        Three degrees of freedom: 1 in 1000 sites is refused in error.
    rounds : int
        Of pairing and fitting; two or three are enough.
    """

    window_s: float = 100.0
    moment_s: float = 0.2
    least_moments: int = 5
    least_cosine: float = cos(radians(70.0))
    least_straight: float = 0.95
    longest_m: float = 7.0
    least_alike: float = cos(radians(30.0))
    speed_mps: float = 2.5
    level_m: float = 3.0
    least_share: float = 0.7
    farthest_m: float = 60.0
    half_length_m: float = 2.05
    half_length_spread_m: float = 0.6
    half_length_sigma_m: float = 0.25
    half_width_sigma_m: float = 0.1
    side_sigma: float = log(1.5)
    spot_m: tuple[float, float] = (0.7, 0.35)
    stretch_m: float = 30.0
    stretch_sigma_m: tuple[float, float] = (0.3, 0.1)
    moment_sigma_m: float = 0.3
    memory_s: float = 1.0
    clock_s: float = 0.02
    free_clock_s: float = 1.0
    most_lag_s: float = 10.0
    clock_rates: tuple[float, ...] = (
        -0.012, -0.01, -0.008, -0.006, -0.004, -0.002, 0.002, 0.004, 0.006, 0.008, 0.01, 0.012,
    )  # fmt: skip
    lag_s: float = 0.25
    lag_place_m: float = 4.0
    lag_speed_mps: float = 3.0
    lag_z: float = 5.0
    lag_clear: float = 2.0
    same_lag_s: float = 1.0
    clock_sigmas: float = 4.0
    freedom: float = 4.0
    gate_chi2: float = 13.8
    least_pairs: int = 4
    firm_pairs: int = 20
    fixed_m: float = 1.0
    step_m: float = 1.0
    reach_m: float = 6.0
    apart_m: float = 5.0
    clear: float = 2.5
    chance_s: tuple[float, ...] = (-15.0, -8.0, 8.0, 15.0)
    contradiction_chi2: float = 16.3
    rounds: int = 6

    @property
    def share(self) -> float:
        """Weight of a moment among those that share their error."""
        return min(self.moment_s / self.memory_s, 1.0)


MATCHING = CorrespondenceSettings()
