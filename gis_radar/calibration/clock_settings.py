"""Settings of the clocks: every constant by which clocks are compared, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ClockSettings:
    """Constants by which clocks are compared; those in effect are written to the file of clocks.

    Sensitivity, on the sample's two sensors (sigma 10 ms): half or twice any constant of the rough
    search does not change the offset; half or twice a limit of speed or height, or a constant of
    the pairing up to `place_m`, changes it by under 10 ms; twice `min_cosine` leaves no traffic.

    Parameters
    ----------
    min_speed_mps, max_speed_mps : float
        Speeds along a lane that count, m/s: over walkers and leaves, under 216 km/h.
    min_cosine : float
        Between lane and line of sight; across it (60 deg) the range rate implies no speed.
    max_over_road_m : float
        Height over the road, metres: the 4 m of a vehicle in the EU, and half a metre of error.
    window_s : (float, float)
        What is read, seconds about the begin of the last recording: an hour of traffic, and twice
        an hour by which a clock may be off.
    max_offset_s : float
        Largest offset looked for, beyond what the begins of the times differ by: over an hour,
        the usual mistake of a time zone.
    bin_s, cell_m, cell_mps : float
        Cells in which agreement is counted: in a bin a vehicle moves by about a cell.
    peak_bins, around_bins, apart_bins : int
        Width of a peak (1.25 s, a vehicle's time in a cell), of its surroundings (40 s, within a
        cycle of signals), and how far off a second peak is another one (5 s).
    rough_score, rough_ratio : float
        Least height of the best lag in robust standard deviations over the agreement at other
        lags, of which there are tens of thousands; and over the next best lag.
    rough_pairs : int
        Least cells that both saw: fewer are chance.
    pair_s, pair_mps : float
        Largest differences of time and speed of a pair: the rough offset's error, and a turn.
    pair_m : tuple of float
        Largest gap along the lane, metres, iteration by iteration; the last one stays. A car's
        length and the error of both poses.
    place_m : float
        Length of lane that shares a bias of the two poses, metres.
    vehicle_s : float
        Detections of one lanelet within it count as one vehicle: about the least headway.
    most_fitted, most_checked : int
        Detections of a pair of sensors in the fit and in the validation; time grows in proportion.
    face_m, face_sigma_m : float
        From a vehicle's middle to the reflections of its front or rear, and one sigma, metres.
    place_sigma_m, vehicle_sigma_m : float
        Sigma of the bias of a place, and least one of a vehicle, metres: poses within lanes, and
        the spread of reflections.
    drift_sigma : float
        Prior sigma of a drift: quartz clocks of radars keep within 100 ppm.
    odd_drift, odd_drift_sigmas, odd_drift_sigma, most_drift : float
        Of a clock that is no quartz: a drift over `odd_drift`, and over so many of its sigmas under
        the wide prior `odd_drift_sigma`, is fitted with that prior. An ARS430 was 0.8 % slow; over
        `most_drift` a unit is mistaken.
    huber : float
        Residuals over so many standard deviations weigh less (Huber 1964).
    rounds, weight_rounds : int
        Most pairings of the fit, and reweightings in each; pairings end below `converged_s`.
    converged_s : float
        A change of the offset below it ends the fit, seconds: far under any sigma.
    least_pairs, least_vehicles : int
        Fewer are refused: a sigma from fewer vehicles is not one.
    max_sigma_s : float
        A larger sigma is refused, seconds: five steps.
    max_change_s : float
        A fit that leaves the rough offset by more is of another lag, seconds.
    near_m, near_s, near_mps : float
        Both saw a vehicle where place, time and speed differ by less.
    decoys_s : tuple of float
        Lags, seconds off the answer, at which far less may agree.
    least_share, least_ratio : float
        Least share seen by both at the answer, and over that at any decoy.
    least_checked : int
        Least detections of a sensor where and while the other one recorded.
    drift_sigmas : float
        A drift below so many of its sigmas counts as none: over hours it would only carry noise.
    contradiction_sigmas : float
        Pairs of sensors that differ by more are warned of.
    """

    min_speed_mps: float = 1.5
    max_speed_mps: float = 60.0
    min_cosine: float = 0.5
    max_over_road_m: float = 4.5
    window_s: tuple[float, float] = (-4000.0, 7600.0)
    max_offset_s: float = 4000.0
    bin_s: float = 0.25
    cell_m: float = 4.0
    cell_mps: float = 3.0
    peak_bins: int = 5
    around_bins: int = 161
    apart_bins: int = 20
    rough_score: float = 8.0
    rough_ratio: float = 1.25
    rough_pairs: int = 20
    pair_s: float = 0.35
    pair_mps: float = 1.5
    pair_m: tuple[float, ...] = (12.0, 9.0, 7.0)
    place_m: float = 10.0
    vehicle_s: float = 4.0
    most_fitted: int = 15_000
    most_checked: int = 20_000
    face_m: float = 1.2
    face_sigma_m: float = 1.0
    place_sigma_m: float = 0.7
    vehicle_sigma_m: float = 0.5
    drift_sigma: float = 100e-6
    odd_drift: float = 1e-3
    odd_drift_sigmas: float = 5.0
    odd_drift_sigma: float = 0.01
    most_drift: float = 0.01
    huber: float = 1.5
    rounds: int = 12
    weight_rounds: int = 8
    converged_s: float = 2e-4
    least_pairs: int = 50
    least_vehicles: int = 8
    max_sigma_s: float = 0.25
    max_change_s: float = 2.0
    near_m: float = 8.0
    near_s: float = 0.2
    near_mps: float = 1.0
    decoys_s: tuple[float, ...] = (-3.0, -2.0, -1.5, 1.5, 2.0, 3.0)
    least_share: float = 0.45
    least_ratio: float = 1.3
    least_checked: int = 50
    drift_sigmas: float = 3.0
    contradiction_sigmas: float = 4.0


CLOCKS = ClockSettings()
