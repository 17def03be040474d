"""Settings of the search for vehicles: constants of its stages, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class EchoSettings:
    """Which detections can come from a vehicle on a lane.

    Parameters
    ----------
    low_m, high_m : float
        Height over the road between which vehicles scatter, metres: reflections at the road seem
        lower, the highest trucks are 4 m.
    height_rad : float
        How much farther off a detection may seem by its elevation: 2 sigma of a recorded ARS548.
    moving_mps : float
        Least absolute range rate of a moving detection: seven sigma of a recorded ARS548.
    """

    low_m: float = -1.0
    high_m: float = 4.5
    height_rad: float = 0.035
    moving_mps: float = 0.15


@dataclass(frozen=True, kw_only=True)
class ForwardSettings:
    """The forward filter: a state a vehicle, corrected frame by frame.

    Parameters
    ----------
    accel_mps2 : float
        1 sigma of the acceleration that drivers choose.
    sideways_mps : float
        1 sigma of the drift across the lane.
    range_rate_mps : float
        1 sigma of a range rate, with what a turning body adds.
    least_cos : float
        Under it a range rate says nothing of the speed along the lane.
    along_m, across_m : float
        How far outside of the body a detection may lie.
    azimuth_rad : float
        1 sigma of the bearing, with its bias a target.
    birth_s, births : float, int
        A vehicle begins with so many detections within that time whose places and range rates
        agree: beyond 150 m a car returns once in half a second; false moving returns are one a
        frame or less, anywhere. A vehicle of under six detections is followed so long.
    coast_s, stand_s : float
        Without a detection a vehicle is followed so long: then it may be 3 m off; and where it
        stood, whose detections are not for this filter.
    standing_mps : float
        Under it a vehicle may stand.
    car_m : float
        Length of a car, which all are at first.
    """

    accel_mps2: float = 1.5
    sideways_mps: float = 0.3
    range_rate_mps: float = 0.25
    least_cos: float = 0.3
    along_m: float = 1.2
    across_m: float = 0.7
    azimuth_rad: float = 0.004
    birth_s: float = 1.5
    births: int = 3
    coast_s: float = 2.0
    stand_s: float = 20.0
    standing_mps: float = 0.7
    car_m: float = 4.6


@dataclass(frozen=True, kw_only=True)
class MotionSettings:
    """Smoothing of a motion, and the size of a vehicle.

    Parameters
    ----------
    spacing_m : float
        Way between the places that a path is laid through.
    along_m, azimuth_rad : float
        1 sigma of a detection along the road, and of its bearing with its bias a target.
    range_rate_mps : float
        1 sigma of a range rate, with what wheels and turning add.
    accel_var : float
        Variance of the speed that a driver's choice adds a second, m2/s3.
    end_share : float
        Of the returns of an end that is looked at squarely, so many come from that end; the rest
        from anywhere along the body.
    repeats : float
        So many times wider counts a place, since a scatterer of a body lasts for frames.
    most_weight : float
        Most that the detections of two metres of a path weigh sideways, 1/m2.
    scatterer_m, aspect_rad : float
        Detections so near each other along the body, from sides so near each other, are of one
        scatterer.
    weight, lasting : float, float
        Each of them weighs so much, all of them one at most; less where a metre of the body is seen
        in fewer half seconds than that.
    driving_mps, still_trust : float, float
        Detections of a vehicle that is slower tell its length with that weight: what stands beside
        it may be among them.
    least_off_mps, off_share : float, float
        A detection whose range rate is off by more, with that share of the speed for what wheels
        and turning add, tells nothing of the length.
    """

    spacing_m: float = 1.0
    along_m: float = 0.3
    azimuth_rad: float = 0.004
    range_rate_mps: float = 0.4
    accel_var: float = 2.0
    end_share: float = 0.75
    repeats: float = 4.0
    most_weight: float = 8.0
    scatterer_m: float = 0.5
    aspect_rad: float = 0.3
    weight: float = 0.25
    lasting: float = 4.0
    driving_mps: float = 1.0
    still_trust: float = 0.3
    least_off_mps: float = 0.4
    off_share: float = 0.05


@dataclass(frozen=True, kw_only=True)
class BodySettings:
    """Which parts are of one body, and who is no vehicle.

    Parameters
    ----------
    seen_s : float
        A frame is known so long before and after a detection of its vehicle.
    left_m, bearing_rad : float
        Half the width of a truck, and the error of a bearing, for what lies beside.
    rate_mps, wheel_share, swing : float
        How far a range rate may be off: by noise, by a share of the speed, and by how much of the
        turning the ends of a body swing.
    least_pure, most_split : float, int
        A part of which a smaller share keeps its place in the moving frame is split, so often.
    least_fit : float
        Share of the detections whose places and range rates have to fit.
    scatter_m : float
        Most median scatter of places: scatterers change along a body.
    place_m : float
        1 sigma of a mean place, for which scatterers last.
    reach_m : float
        From the middle of what is seen to any part of a truck with trailer.
    car_m : float
        Length of a car.
    gap_s, gap_spread : float
        Median of the time gap between drivers, and the sigma of its logarithm.
    long_share : float
        Share of vehicles over 7 m in traffic.
    least_odds : float
        Logarithm of the odds from which two are one.
    least_rows : int
        Parts of fewer detections are none.
    driven_mps : float
        Who is faster drives.
    cyclist_mps, walker_mps : float
        Cyclists and walkers are slower.
    person_db, walker_db : float
        By how much they return less than vehicles: cyclists and walkers are 7 to 12 dB weaker;
        creeping cars are as strong as cars.
    """

    seen_s: float = 0.35
    left_m: float = 1.7
    bearing_rad: float = 0.006
    rate_mps: float = 0.8
    wheel_share: float = 0.08
    swing: float = 0.6
    least_pure: float = 0.95
    most_split: int = 3
    least_fit: float = 0.7
    scatter_m: float = 2.5
    place_m: float = 0.4
    reach_m: float = 16.5
    car_m: float = 4.7
    gap_s: float = 1.8
    gap_spread: float = 0.6
    long_share: float = 0.12
    least_odds: float = 0.5
    least_rows: int = 5
    driven_mps: float = 8.0
    cyclist_mps: float = 7.5
    walker_mps: float = 2.5
    person_db: float = 5.0
    walker_db: float = 3.0


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
    sweep_mps, sweep_seen_s, sweep_edge_m : float
        Who drives over a place is so fast at least, was seen so shortly before or after, and its
        middle lies so far inside of the lane.
    fast_mps, after_s : float, (float, float)
        So soon before and after one drives over a place so fast, nobody stands there.
    least_built, built_share : int, float
        What is seen there nevertheless, so often and at that share of the drives, is of the road.
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
    sweep_edge_m: float = 0.3
    fast_mps: float = 4.0
    after_s: tuple[float, float] = (0.7, 2.5)
    least_built: int = 2
    built_share: float = 0.5
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
    """How parts of the life of a vehicle follow each other.

    Parameters
    ----------
    slow_mps : float
        Under it a vehicle may stand.
    left_m : float
        Half the width of a vehicle with the error of its place.
    away_m, empty_s, own_share : float, float, float
        Where a vehicle comes to rest or sets off is empty so long before it is nearer, or after it
        is farther, than that beyond its length. What is detected there then is not of it, and such
        a share of what is while it stands has to be.
    weaker_db : float
        What stands returns at most so much less than vehicles that drive.
    near_m, same_share : float
        Of two bodies within that distance that lie on each other by that share, one is.
    double_share : float
        Who lies on another vehicle for such a share of its life is that one.
    double_halves : int
        So many half seconds at a time of another's life are that one's: places are off for less.
    unseen_s : float
        A vehicle that drives is missed so long at most.
    wait_cost : float
        What a second of waiting unseen costs: two minutes cost as much as an end.
    end_cost : float
        What it costs that a life ends, or begins, in view.
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
    own_share: float = 0.5
    weaker_db: float = 6.0
    near_m: float = 15.0
    same_share: float = 0.4
    double_share: float = 0.5
    double_halves: int = 3
    unseen_s: float = 6.0
    wait_cost: float = 0.03
    end_cost: float = 8.0
    least_moving: int = 6
    least_way_m: float = 4.0
    alone_s: float = 3.0
    alone_rows: int = 10
    place_m: float = 0.5


@dataclass(frozen=True, kw_only=True)
class RouteSettings:
    """Which lanelet a vehicle follows.

    Parameters
    ----------
    left_m, turn_rad : float
        1 sigma of the front's distance from the centre of its lanelet, and of its heading from it.
    most_rad : float
        Who is turned farther does not follow the lanelet.
    off_lane : float
        What a step off all lanelets costs: that of three sigma beside one.
    change : float
        What a change to a lanelet that does not follow costs: half a second beside the lane.
    """

    left_m: float = 1.0
    turn_rad: float = 0.3
    most_rad: float = 1.0
    off_lane: float = 9.0
    change: float = 30.0


@dataclass(frozen=True, kw_only=True)
class BlockSettings:
    """In which blocks recordings are read.

    Parameters
    ----------
    steps : int
        Steps of a block, at whole multiples: five minutes.
    margin_steps : int
        So many steps before and after a block help to know its vehicles: a vehicle that stands is
        hidden for 25 s in one case of ten.
    """

    steps: int = 6000
    margin_steps: int = 1200


@dataclass(frozen=True, kw_only=True)
class PieceSettings:
    """What is written of a motion.

    Parameters
    ----------
    seen_s : float
        A state is seen within so many seconds of a detection (the contract).
    unseen_steps : int
        So many steps a vehicle goes on before its first and after its last detection: into and out
        of the view, and while a radar misses it.
    driving_mps : float
        Who is slower does not.
    least_judged : int
        A pose is judged by so many vehicles.
    most_off_lane : float
        A pose is doubtful if a larger share of a sensor's vehicles follows no lanelet.
    """

    seen_s: float = 0.5
    unseen_steps: int = 20
    driving_mps: float = 1.0
    least_judged: int = 8
    most_off_lane: float = 0.2


@dataclass(frozen=True, kw_only=True)
class VehicleSettings:
    """All settings of the search for vehicles.

    Parameters
    ----------
    echoes : EchoSettings
        Which detections can come from vehicles.
    forward : ForwardSettings
        Following them forward in time.
    motion : MotionSettings
        Smoothing over their lives.
    bodies : BodySettings
        Which parts are of one body.
    detectability : DetectabilitySettings
        How many detections they are due.
    standing : StandingSettings
        What stands on lanes and is a vehicle.
    tall : TallSettings
        What their heights tell of their lengths.
    lives : LifeSettings
        How what moves and what stands are joined.
    routes : RouteSettings
        Which lanelets they follow.
    blocks : BlockSettings
        How recordings are read.
    pieces : PieceSettings
        What is written of them.
    """

    echoes: EchoSettings = field(default_factory=EchoSettings)
    forward: ForwardSettings = field(default_factory=ForwardSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    bodies: BodySettings = field(default_factory=BodySettings)
    detectability: DetectabilitySettings = field(default_factory=DetectabilitySettings)
    standing: StandingSettings = field(default_factory=StandingSettings)
    tall: TallSettings = field(default_factory=TallSettings)
    lives: LifeSettings = field(default_factory=LifeSettings)
    routes: RouteSettings = field(default_factory=RouteSettings)
    blocks: BlockSettings = field(default_factory=BlockSettings)
    pieces: PieceSettings = field(default_factory=PieceSettings)


DEFAULTS = VehicleSettings()
