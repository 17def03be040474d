"""Settings of stationary vehicles and of track management: constants with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DetectabilitySettings:
    """How many detections a vehicle in plain view is expected to give.

    Parameters
    ----------
    cell_m : float
        Size of the map cells in which the rate of detections is learned, together with their
        neighbours.
    driving_mps : float
        Least speed of the vehicles from which it is learned.
    least_s : float
        Least total time of vehicles in a cell; with less, the rate is unknown.
    silent_s : float
        Shorter gaps between detections are ignored.
    most_due : float
        A vehicle with this many expected detections and none observed is not there.
    """

    cell_m: float = 6.0
    driving_mps: float = 3.0
    least_s: float = 1.0
    silent_s: float = 2.0
    most_due: float = 60.0


@dataclass(frozen=True, kw_only=True)
class StationarySettings:
    """Which still detections on a lane come from stationary vehicles.

    Parameters
    ----------
    inside_m : float
        Least distance from the lane's edge of detections of stationary vehicles; kerbs, signs and
        parked cars lie nearer to it.
    high_m : float
        A scatterer whose median height over the road is larger hangs above the lane.
    cell_m : float
        Length of the cells of a strip: the scatter of a scatterer.
    silence_s : float
        After a longer gap without a detection a scatterer counts as a new one: a stationary vehicle
        is silent for 9 to 25 s in one case of ten. One that is first detected so soon after the
        first detection of all stood there before; so near the last of all, it stays.
    slice_s : float
        Interval at which the stationary vehicles are determined.
    pass_mps, pass_seen_s, pass_near_m : float
        A vehicle drives over a place if it is at least so fast, was detected within this time of
        the moment, and its middle comes so near to the place, or to the middle of the lane: half
        the width of two cars and the error of their places; 0.7 and 1.3 m change the shares of time
        of towns by less than 0.3 %.
    fast_mps, after_s : float, (float, float)
        Between these times before and after a vehicle of at least this speed drives over a place,
        no vehicle stands there.
    least_built, built_share : int, float
        Detections that appear at a place nevertheless, after so many passes and after this share
        of them, belong to the road.
    more_sigmas, car_m : float, float
        Except where the count over a car's length of the lane exceeds the usual count by so many
        standard deviations.
    gap_m, easy_m, tight : float
        Least gap between vehicles in a queue; the gap that drivers keep without effort; the cost of
        a smaller one, per square metre.
    shortest_m : float
        Least length; anything shorter cannot be distinguished from a sign.
    power : float
        The weight of repeated detections of one scatterer is their number to this power.
    window_m, most_weight : float
        Detections within this distance together have at most this weight.
    new_cost : float
        Logarithm of the odds that evidence has to exceed for a vehicle to be assumed.
    stick : float
        Gain of a vehicle that stood in the same place one slice before.
    clutter : float
        Density of detections that belong to no vehicle, per metre.
    end_m, end_share : float
        Standard deviation of the detections of a vehicle's end, and their share where a sensor
        looks squarely at it.
    least_detections, least_s, rate_share : int, float, float
        Least number of detections, least duration, and least share of the rate at which vehicles
        of the same recordings are detected at that range.
    """

    inside_m: float = 0.5
    high_m: float = 3.2
    cell_m: float = 0.25
    silence_s: float = 10.0
    slice_s: float = 1.0
    pass_mps: float = 1.5
    pass_seen_s: float = 0.75
    pass_near_m: float = 1.0
    fast_mps: float = 4.0
    after_s: tuple[float, float] = (0.7, 2.5)
    least_built: int = 2
    built_share: float = 0.5
    more_sigmas: float = 3.0
    car_m: float = 4.5
    gap_m: float = 1.0
    easy_m: float = 2.0
    tight: float = 8.0
    shortest_m: float = 3.4
    power: float = 0.5
    window_m: float = 5.0
    most_weight: float = 24.0
    new_cost: float = 7.0
    stick: float = 12.0
    clutter: float = 0.02
    end_m: float = 0.35
    end_share: float = 0.6
    least_detections: int = 6
    least_s: float = 2.0
    rate_share: float = 0.1


@dataclass(frozen=True, kw_only=True)
class TallSettings:
    """How heights over the road distinguish long vehicles from several short ones.

    Parameters
    ----------
    car_m, lorry_m : (float, float)
        Mean height of the detections of a car, and of a lorry or bus, with its standard deviation
        between vehicles: the middle of their bodies.
    bias_rad, elevation_rad : float
        Standard deviation of the elevation: of a target over its whole time, and from detection to
        detection.
    least_rows : int
        Least number of heights; fewer are ignored.
    most_odds : float
        Bound of the logarithm of the odds from heights.
    lorry_share : float
        Share of lorries and buses in traffic.
    """

    car_m: tuple[float, float] = (0.75, 0.3)
    lorry_m: tuple[float, float] = (1.6, 0.5)
    bias_rad: float = 0.006
    elevation_rad: float = 0.0175
    least_rows: int = 10
    most_odds: float = 4.0
    lorry_share: float = 0.12


@dataclass(frozen=True, kw_only=True)
class TrackManagementSettings:
    """Which tracks are complete, and which are of no vehicle.

    Parameters
    ----------
    slow_mps : float
        Below this speed a vehicle may stand.
    left_m : float
        Half the width of a vehicle with the error of its place.
    away_m, empty_s, search_s, own_share : float, float, float, float
        Whether still detections belong to a vehicle that comes to rest or sets off is decided by
        how often its place gives detections while it is empty: in the nearest `empty_s` seconds in
        which the vehicle is at least `away_m` beyond its length away, searched for up to `search_s`
        within the block and its margins. The vehicle's own share must be at least `own_share`.
    apart_s : float
        Least time between two vehicles at one place.
    least_moving, least_way_m : int, float
        Least number of moving detections and least distance of a vehicle; otherwise the detections
        are false.
    alone_s, alone_rows : float, int
        Least duration and number of detections of a vehicle that never moves.
    place_m : float
        Standard deviation of the place of a stationary vehicle.
    """

    slow_mps: float = 0.7
    left_m: float = 1.1
    away_m: float = 2.0
    empty_s: float = 3.0
    search_s: float = 60.0
    own_share: float = 0.5
    apart_s: float = 1.0
    least_moving: int = 6
    least_way_m: float = 4.0
    alone_s: float = 3.0
    alone_rows: int = 10
    place_m: float = 0.5


@dataclass(frozen=True, kw_only=True)
class LinkSettings:
    """Which part of a track may follow another; costs are negative logarithms of odds.

    Parameters
    ----------
    overlap_s : float
        Largest overlap in time of the second part with the first.
    waiting_mps, waiting_m, waiting_rad : float
        Largest speed at both ends, largest distance and largest turn of a vehicle that waits
        between its parts.
    braking_mps2 : float
        Usual braking and acceleration, which give the distance that a waiting vehicle covers.
    place_m : float
        Error of the ends of two parts of one vehicle: half a car.
    stop_cost, wait_cost : float
        Cost of a stop and of each second of it: two minutes cost half as much as an end.
    unseen_s, turning_rad : float
        Longest time without detections and largest turn of a moving vehicle.
    slowing_mps2, gaining_mps2 : float
        How much slower than the mean of both ends, and faster than the faster end, the mean speed
        of an undetected moving vehicle may be, per second: it may stop and start in between.
    braked_mps2, briefly_s : float
        For gaps up to this duration it is not slower than the slower end after braking so.
    usual_mps2, unseen_cost, way_cost : float
        Standard deviation of the mean speed about that of both ends, per second; cost of the square
        root of an undetected second, and of a metre.
    sure_mps, most_sigma : float
        Standard deviation of the speed at an end; parts that differ by more sigmas are of
        different vehicles.
    back_m, beside_m, drift : float
        How far behind, and how far beside the straight continuation the next part may begin, the
        latter with so much more per metre.
    end_cost : float
        Cost of a track that ends or begins in view.
    """

    overlap_s: float = 2.0
    waiting_mps: float = 5.0
    waiting_m: float = 9.0
    waiting_rad: float = 0.6
    braking_mps2: float = 3.0
    place_m: float = 1.0
    stop_cost: float = 0.5
    wait_cost: float = 0.03
    unseen_s: float = 6.0
    turning_rad: float = 1.9
    slowing_mps2: float = 0.6
    gaining_mps2: float = 0.5
    braked_mps2: float = 1.2
    briefly_s: float = 3.0
    usual_mps2: float = 0.7
    unseen_cost: float = 0.15
    way_cost: float = 0.03
    sure_mps: float = 0.5
    most_sigma: float = 3.0
    back_m: float = 3.0
    beside_m: float = 1.6
    drift: float = 0.15
    end_cost: float = 8.0
