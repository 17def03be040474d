"""Settings of what stands, and of whole lives of vehicles: constants with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DetectabilitySettings:
    """How many detections a vehicle is due where it is in plain view.

    Parameters
    ----------
    cell_m : float
        Size of the cells of the map in which that is learned, together with their neighbours.
    driving_mps : float
        Vehicles that drive so fast tell it.
    least_s : float
        Where they were for less time all together, nothing is known.
    silent_s : float
        Shorter silences mean nothing: a vehicle can be in one for a few frames.
    most_due : float
        A vehicle of which so many detections are due and none comes is not there.
    """

    cell_m: float = 6.0
    driving_mps: float = 3.0
    least_s: float = 1.0
    silent_s: float = 2.0
    most_due: float = 60.0


@dataclass(frozen=True, kw_only=True)
class StandingSettings:
    """What stands on a lane and is a vehicle.

    Parameters
    ----------
    inside_m : float
        Detections of vehicles that stand lie so far inside of the lane's edge: kerbs, signs and
        parked cars do not.
    high_m : float
        What is higher over the road by its median hangs above it.
    cell_m : float
        Length of the cells of a strip: the scatter of a scatterer.
    silence_s : float
        After so long without a detection a scatterer counts anew: a vehicle that stands is silent
        for 9 to 25 s in one case of ten. One seen so soon after the first or before the last
        detection of all stood before, or stands on.
    slice_s : float
        So often it is asked which vehicles stand.
    sweep_mps, sweep_seen_s, sweep_near_m : float
        Who drives over a place is so fast at least, was seen so shortly before or after, and its
        middle comes so near to the place, or to the middle of the lane: half the width of two cars
        and the error of where they are; 0.7 and 1.3 m change the shares of time of towns by less
        than 0.3 %.
    fast_mps, after_s : float, (float, float)
        So soon before and after one drives over a place so fast, nobody stands there.
    least_built, built_share : int, float
        What is seen there nevertheless, so often and at that share of the drives, is of the road.
    more_sigmas, car_m : float, float
        But for what comes more often, by so many sigma of a count, than usual then, from as
        much of the lane as a car takes.
    gap_m, easy_m, tight : float
        Least room between vehicles in a queue; from there on drivers leave it easily; what it costs
        to leave less, by metre squared.
    shortest_m : float
        A shorter vehicle than the shortest car is not told from a sign.
    power : float
        Many detections of one scatterer weigh as their number to this power.
    window_m, most_weight : float
        Detections within so many metres weigh so much together at most.
    new_cost : float
        What a vehicle has to gain over nothing standing there, as a logarithm of odds.
    stick : float
        What one gains that stood so before.
    clutter : float
        Density of returns that are of no vehicle, a metre.
    end_m, end_share : float
        1 sigma of the returns of an end, and their share where it is looked at squarely.
    least_echoes, least_s, rate_share : int, float, float
        Fewer detections, in less time, or at a smaller share of the rate at which vehicles of the
        same recordings are seen at that range, are no vehicle.
    """

    inside_m: float = 0.5
    high_m: float = 3.2
    cell_m: float = 0.25
    silence_s: float = 10.0
    slice_s: float = 1.0
    sweep_mps: float = 1.5
    sweep_seen_s: float = 0.75
    sweep_near_m: float = 1.0
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
    least_echoes: int = 6
    least_s: float = 2.0
    rate_share: float = 0.1


@dataclass(frozen=True, kw_only=True)
class TallSettings:
    """What heights over the road tell of lengths.

    Parameters
    ----------
    car_m, lorry_m : (float, float)
        Mean height of the returns of a car, of a lorry or a bus, and its sigma from one to the
        next: the middle of their bodies.
    bias_rad, elevation_rad : float
        1 sigma of the elevation, of a target as long as it is seen and from detection to detection.
    least_rows : int
        Fewer heights tell nothing.
    most_odds : float
        Heights tell no more than that, as a logarithm of odds.
    lorry_share : float
        Share of lorries and buses in traffic.
    least_odds : float
        Two stands of which more speaks for one lorry than for two vehicles are one.
    gap_m, both_share : float, float
        Two that are one are no farther apart, and stand for such a share of their time together.
    """

    car_m: tuple[float, float] = (0.75, 0.3)
    lorry_m: tuple[float, float] = (1.6, 0.5)
    bias_rad: float = 0.006
    elevation_rad: float = 0.0175
    least_rows: int = 10
    most_odds: float = 4.0
    lorry_share: float = 0.12
    least_odds: float = 2.0
    gap_m: float = 5.0
    both_share: float = 0.6


@dataclass(frozen=True, kw_only=True)
class LifeSettings:
    """What is a whole life of a vehicle, and what is one that is found twice.

    Parameters
    ----------
    slow_mps : float
        Under it a vehicle may stand.
    left_m : float
        Half the width of a vehicle with the error of its place.
    away_m, empty_s, search_s, own_share : float, float, float, float
        Where a vehicle comes to rest or sets off is empty so long before it is nearer, or after it
        is farther, than that beyond its length: the nearest such seconds within what blocks hold
        around their span.
        What is detected there then is not of it, and such a share of what is while it stands has to
        be.
    apart_s : float
        Who drove over a place was there so long before the next one came to it.
    weaker_db : float
        What stands returns at most so much less than vehicles that drive.
    near_m, same_share : float
        Of two bodies within that distance that lie on each other by that share, one is.
    double_share : float
        Who lies on another vehicle for such a share of its life is that one.
    double_halves : int
        Who lies on another for so many half seconds at its begin or end is that one then: places
        are off for less.
    least_moving, least_way_m : int, float
        A vehicle has so many moving detections and made so much way, or is a false return.
    alone_s, alone_rows : float, int
        One that never moves is seen so long and often.
    place_m : float
        1 sigma of where it stands.
    """

    slow_mps: float = 0.7
    left_m: float = 1.1
    away_m: float = 2.0
    empty_s: float = 3.0
    search_s: float = 60.0
    own_share: float = 0.5
    apart_s: float = 1.0
    weaker_db: float = 6.0
    near_m: float = 15.0
    same_share: float = 0.4
    double_share: float = 0.5
    double_halves: int = 3
    least_moving: int = 6
    least_way_m: float = 4.0
    alone_s: float = 3.0
    alone_rows: int = 10
    place_m: float = 0.5


@dataclass(frozen=True, kw_only=True)
class LinkSettings:
    """Which part of a life may follow another one; costs are negative logarithms of odds.

    Parameters
    ----------
    overlap_s : float
        The second part begins so long before the end of the first at most.
    waiting_mps, waiting_m, waiting_rad : float
        Who waits in between is slower at both ends, came so far and turned so much at most.
    braking_mps2 : float
        How drivers brake and start, which tells the way of one that waits.
    place_m : float
        By how much the ends of two parts of one vehicle may be off: half a car.
    stop_cost, wait_cost : float
        What a stop and each second of it cost: two minutes cost half as much as an end.
    unseen_s, turning_rad : float
        Who drives is missed so long and turns so much at most.
    slowing_mps2, gaining_mps2 : float
        By how much slower than both ends' mean, and faster than the faster one, the mean speed of
        who drives unseen may be, for each second: stops and starts in between.
    braked_mps2, briefly_s : float
        For so short a time it is no slower than the slower end after braking so.
    usual_mps2, unseen_cost, way_cost : float
        How the mean speed scatters about that of both ends, for each second; what the root of a
        second unseen costs, and a metre of way.
    sure_mps, most_sigma : float
        1 sigma of a speed at an end; what is more sigmas off is another one.
    back_m, beside_m, drift : float
        How far behind, or beside the way straight on it may come out, and beside by how much more
        for each metre of way.
    end_cost : float
        What it costs that a life ends, or begins, in view.
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
