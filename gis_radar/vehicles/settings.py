"""Settings of the search for vehicles: constants of its stages, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass, field

from gis_radar.vehicles.life_settings import (
    DetectabilitySettings,
    LifeSettings,
    LinkSettings,
    StandingSettings,
    TallSettings,
)


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
    still_sigmas : float
        A radar with more noise needs more: so many sigma, with which 500 fixed returns a frame
        seem to move once in three minutes.
    noise_s, slow_mps, least_slow, peak_share : float, float, int, float
        The noise is that of detections of the first seconds that are slower than this, of so many
        at least (a sigma to 3 %), of which such a share is slower than a third of it: evenly
        spread it would be a third. Never is more needed than this.
    """

    low_m: float = -1.0
    high_m: float = 4.5
    height_rad: float = 0.035
    moving_mps: float = 0.15
    still_sigmas: float = 5.0
    noise_s: float = 20.0
    slow_mps: float = 0.3
    least_slow: int = 1000
    peak_share: float = 0.5


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
    faint_db : float
        What returns so much less is no vehicle, however fast: persons followed with a passing one.
    faint_share, faint_odds : float, float
        Such a share of the returns of a vehicle is so faint, and of those of a person all but that:
        a tenth of a car's, a fifth of a lorry's or a motorcycle's; nine tenths of a walker's, two
        thirds of a cyclist's. From which logarithm of odds an end is of a person: eight in a row.
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
    faint_db: float = 9.0
    faint_share: float = 0.2
    faint_odds: float = 10.0


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
    through_mps : float
        Who is slower may turn in, park or load, beside the lanes.
    least_judged : int
        A pose is judged by so many vehicles.
    most_off_lane : float
        A pose is doubtful if a larger share of a sensor's vehicles follows no lanelet.
    most_beside_m : float
        It is, too, if they all are off to one side by more, or farther from their lanes' centres
        than those of other sensors.
    lane_m, beside_m, shift_m : float, float, float
        1 sigma of where drivers of a lane all are beside its centre, as recorded at three
        junctions, of where one is found beside that, and of a pose.
    """

    seen_s: float = 0.5
    unseen_steps: int = 20
    driving_mps: float = 1.0
    through_mps: float = 3.0
    least_judged: int = 8
    most_off_lane: float = 0.2
    most_beside_m: float = 0.6
    lane_m: float = 0.25
    beside_m: float = 0.7
    shift_m: float = 1.0


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
        What is a whole life.
    links : LinkSettings
        Which parts of lives follow each other.
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
    links: LinkSettings = field(default_factory=LinkSettings)
    routes: RouteSettings = field(default_factory=RouteSettings)
    blocks: BlockSettings = field(default_factory=BlockSettings)
    pieces: PieceSettings = field(default_factory=PieceSettings)


DEFAULTS = VehicleSettings()
