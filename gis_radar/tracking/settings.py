"""Settings of the tracker: constants of its stages, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass, field

from gis_radar.tracking.management_settings import (
    DetectabilitySettings,
    LinkSettings,
    StationarySettings,
    TallSettings,
    TrackManagementSettings,
)


@dataclass(frozen=True, kw_only=True)
class DetectionSettings:
    """Which detections can come from a vehicle on a lane.

    Parameters
    ----------
    low_m, high_m : float
        Height over the road between which vehicles scatter, metres: reflections at the road seem
        lower, the highest trucks are 4 m.
    height_rad : float
        Tolerance of the height by the elevation: 2 sigma of a recorded ARS548.
    moving_mps : float
        Least absolute range rate of a moving detection: seven sigma of a recorded ARS548.
    still_sigmas : float
        The same in standard deviations of the sensor's own noise, where that is more: at 500 fixed
        detections a frame, one seems to move every three minutes.
    noise_s, slow_mps, least_slow, peak_share : float, float, int, float
        The noise is measured in the first seconds, by detections slower than `slow_mps`, of which
        at least `least_slow` are needed (a sigma to 3 %). Their absolute values have to peak near
        zero: such a share is below a third of `slow_mps`; evenly spread it would be a third.
        `slow_mps` is also the upper bound of the threshold.
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
    """The forward filter: one state per vehicle, corrected frame by frame.

    Parameters
    ----------
    accel_mps2 : float
        Standard deviation of the acceleration that drivers choose.
    sideways_mps : float
        Standard deviation of the drift across the lane.
    range_rate_mps : float
        Standard deviation of a range rate, including what a turning body adds.
    least_cos : float
        Least cosine between line of sight and lane at which a range rate gives the speed.
    along_m, across_m : float
        How far outside of the body a detection may lie.
    azimuth_rad : float
        Standard deviation of the bearing, including the bias of each target.
    birth_s, births : float, int
        A track begins with so many detections within this time whose places and range rates agree:
        beyond 150 m a car gives one in half a second; false moving detections are at most one a
        frame, anywhere. Tracks of under six detections are dropped after the same time without one.
    coast_s, stand_s : float
        A track is continued for so long without a detection: then it may be 3 m off; and for so
        long at rest, where its detections are not used by this filter.
    standing_mps : float
        Below this speed a vehicle may stand.
    car_m : float
        Length of a car, the first guess for all vehicles.
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
        Distance along the road between the points that a path is fitted through.
    along_m, azimuth_rad : float
        Standard deviation of a detection along the road, and of its bearing including the bias of
        each target.
    range_rate_mps : float
        Standard deviation of a range rate, including what wheels and turning add.
    accel_var : float
        Variance that a driver's choice adds to the speed per second, m2/s3.
    end_share : float
        Share of detections from an end of the vehicle at which a sensor looks squarely; the others
        come from anywhere along the body.
    repeats : float
        Factor on the standard deviation of places, as a scatterer lasts for several frames.
    most_weight : float
        Largest weight of the detections in two metres of a path sideways, 1/m2.
    scatterer_m, aspect_rad : float
        Detections within this distance along the body and this difference of aspect are from one
        scatterer.
    weight, lasting : float, float
        Weight of each detection of a scatterer, together at most one; less where a metre of the
        body is detected in fewer half seconds than `lasting`.
    driving_mps, still_trust : float, float
        Detections of a vehicle slower than this count for its length with this weight: things
        beside it may be among them.
    least_off_mps, off_share : float, float
        A detection whose range rate differs by more than the larger of both does not count for the
        length; `off_share` is a share of the speed, for wheels and turning.
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
    """Which parts are of one body, and which bodies are no vehicles.

    Parameters
    ----------
    seen_s : float
        Time before and after a detection within which the state of its vehicle is known.
    left_m, bearing_rad : float
        Half the width of a truck, and the error of a bearing, for the distance sideways.
    rate_mps, wheel_share, swing : float
        Tolerance of a range rate: noise, a share of the speed, and a share of the speed at which
        the ends of a turning body swing.
    least_pure, most_split : float, int
        A part is split, at most so often, while a smaller share of it keeps its place in the moving
        frame.
    least_fit : float
        Least share of detections whose places and range rates fit.
    scatter_m : float
        Largest median scatter of places: scatterers change along a body.
    place_m : float
        Standard deviation of a mean place, for which scatterers last.
    reach_m : float
        From the middle of what is detected to any part of a truck with trailer.
    car_m : float
        Length of a car.
    gap_s, gap_spread : float
        Median of the time gap between drivers, and the standard deviation of its logarithm.
    long_share : float
        Share of vehicles over 7 m in traffic.
    least_odds : float
        Logarithm of the odds above which two parts are joined.
    least_rows : int
        Least number of detections of a part.
    driven_mps : float
        Vehicles above this speed certainly drive.
    cyclist_mps : float
        Largest speed of cyclists.
    person, vehicle : (float, float, float, float)
        Mean and standard deviation of the cross section, dB over that of vehicles, and of the
        logarithm of the spread of detections, metres: most people return 4 to 10 dB less;
        a cyclist of 1.8 x 0.6 m spreads by 0.55 m, a car by 1.4 m, bearing and smoothing add 0.5 m.
    faint_db : float
        Detections weaker by this belong to no vehicle at any speed: persons next to a passing one.
    faint_share, faint_odds : float, float
        Share of such detections of a vehicle; of a person it is the rest: a tenth of a car's, a
        fifth of a lorry's or a motorcycle's; nine tenths of a walker's, two thirds of a cyclist's.
        Logarithm of the odds above which an end of a track is of a person: eight in a row.
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
    person: tuple[float, float, float, float] = (-7.0, 3.0, -0.3, 0.45)
    vehicle: tuple[float, float, float, float] = (0.0, 4.0, 0.4, 0.5)
    faint_db: float = 9.0
    faint_share: float = 0.2
    faint_odds: float = 10.0


@dataclass(frozen=True, kw_only=True)
class RouteSettings:
    """Which lanelet a vehicle follows.

    Parameters
    ----------
    left_m, turn_rad : float
        Standard deviation of the front's distance from the centre of its lanelet, and of its
        heading from that of the lanelet.
    most_rad : float
        Largest difference of headings at which a vehicle follows a lanelet.
    off_lane : float
        Cost of a step off all lanelets: that of three sigma beside one.
    change : float
        Cost of a change to a lanelet that is no successor: half a second beside the lane.
    """

    left_m: float = 1.0
    turn_rad: float = 0.3
    most_rad: float = 1.0
    off_lane: float = 9.0
    change: float = 30.0


@dataclass(frozen=True, kw_only=True)
class BlockSettings:
    """Into which blocks recordings are divided.

    Parameters
    ----------
    steps : int
        Steps of a block, at whole multiples: five minutes.
    margin_steps : int
        Steps before and after a block that are used to find its vehicles: a stationary vehicle is
        silent for 25 s in one case of ten.
    """

    steps: int = 6000
    margin_steps: int = 1200


@dataclass(frozen=True, kw_only=True)
class BatchSettings:
    """Which states of a motion are kept, and when a pose is doubtful.

    Parameters
    ----------
    seen_s : float
        A state is seen within so many seconds of a detection (the contract).
    through_mps : float
        Slower vehicles may turn in, park or load beside the lanes.
    least_judged : int
        Least number of vehicles by which a pose is judged.
    most_off_lane : float
        Share of a sensor's vehicles that follow no lanelet above which its pose is doubtful.
    most_beside_m : float
        Distance from the centres of lanes, common to all vehicles of a sensor or beyond that of
        other sensors, above which its pose is doubtful.
    lane_m, beside_m, shift_m : float, float, float
        Standard deviations: of the mean distance from a lane's centre of all its drivers, as
        recorded at three junctions; of a driver from that; of a pose.
    """

    seen_s: float = 0.5
    through_mps: float = 3.0
    least_judged: int = 8
    most_off_lane: float = 0.2
    most_beside_m: float = 0.6
    lane_m: float = 0.25
    beside_m: float = 0.7
    shift_m: float = 1.0


@dataclass(frozen=True, kw_only=True)
class VehicleSettings:
    """All settings of the tracker.

    Parameters
    ----------
    detections : DetectionSettings
        Which detections can come from vehicles.
    forward : ForwardSettings
        The forward filter.
    motion : MotionSettings
        Smoothing over complete tracks.
    bodies : BodySettings
        Which parts are of one body.
    detectability : DetectabilitySettings
        How many detections a vehicle in view is expected to give.
    stationary : StationarySettings
        Stationary vehicles on lanes.
    tall : TallSettings
        Heights that distinguish long vehicles.
    management : TrackManagementSettings
        Which tracks are complete, and of a vehicle.
    links : LinkSettings
        Which parts of tracks follow each other.
    routes : RouteSettings
        Which lanelets vehicles follow.
    blocks : BlockSettings
        How recordings are divided.
    batches : BatchSettings
        Which states are kept.
    """

    detections: DetectionSettings = field(default_factory=DetectionSettings)
    forward: ForwardSettings = field(default_factory=ForwardSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    bodies: BodySettings = field(default_factory=BodySettings)
    detectability: DetectabilitySettings = field(default_factory=DetectabilitySettings)
    stationary: StationarySettings = field(default_factory=StationarySettings)
    tall: TallSettings = field(default_factory=TallSettings)
    management: TrackManagementSettings = field(default_factory=TrackManagementSettings)
    links: LinkSettings = field(default_factory=LinkSettings)
    routes: RouteSettings = field(default_factory=RouteSettings)
    blocks: BlockSettings = field(default_factory=BlockSettings)
    batches: BatchSettings = field(default_factory=BatchSettings)


VEHICLE_DEFAULTS = VehicleSettings()
