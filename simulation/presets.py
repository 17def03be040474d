"""Models of radars and drivers by name.

Sources of `AS_RECORDED`: public recordings, four of an ARS548 (firmware 5.48.6; front and side,
still scenes) and three of an ARS430 (people walking). ``tests/test_as_recorded.py`` measures the
same figures on a simulated recording.
"""

from __future__ import annotations

from dataclasses import replace

from simulation.driving import LaneKeeping
from simulation.radar import RadarModel
from simulation.targets import Lasting

TEXTBOOK = RadarModel()
AS_RECORDED = RadarModel(
    density=1.1,  # a car gives 1-2 detections a frame at 25-75 m, 0.2-0.6 at 75-150 m
    static_per_frame=54.0,  # 45-52 a frame in a still yard, after neighbours were merged
    # 0.25-0.43 a frame seem to move, evenly from 60 to 300 m and up to 27 m/s, once 105 m/s
    false_alarms=0.34,
    false_moving=1.0,
    false_mps=27.0,
    false_tail=0.003,
    false_from_m=60.0,
    false_doppler_share=0.0,
    # of one target from frame to frame: 0.006-0.011 m, 0.03-0.06 deg, 0.1-1.95 deg, 0.5 dB
    range_m=0.008,
    azimuth_deg=0.045,
    elevation_deg=0.3,
    rcs_db=0.4,
    range_rate_mps=0.016,  # of still targets: 0.015-0.017 m/s
    rcs_scale_db=-11.0,  # what stands still: quartiles -14, -7, -1
    rcs_floor_db=-20.0,
    quantum=(2.0**-8, 2.0**-8, 2.0**-8, 2.0**-8, 1.0),  # RCS is an int8
    cycle_s=(0.0413, 0.0515, 0.0572),
    targets=Lasting(range_m=0.1, azimuth_deg=0.15, elevation_deg=1.0, seconds=3.0, softness_db=1.0),
)
SIDE_AS_RECORDED = replace(AS_RECORDED, cycle_s=(0.047, 0.051, 0.052))
HARSH = replace(
    AS_RECORDED,
    reach_m=75.0,
    density=0.7,
    static_per_frame=30.0,
    ghost_share=0.1,
    leak=0.02,
    false_alarms=2.0,
    range_m=0.02,
    azimuth_deg=0.1,
    elevation_deg=0.6,
    range_rate_mps=0.03,
    targets=Lasting(range_m=0.2, azimuth_deg=0.3, elevation_deg=2.0, seconds=3.0, softness_db=3.0),
)

RADARS = {
    "textbook": TEXTBOOK,
    "as recorded": AS_RECORDED,
    "as recorded, side": SIDE_AS_RECORDED,
    "harsh": HARSH,
}

# From tracks recorded at three junctions, as offsets from the middle of their maps' lanes, positive
# to the left. Means of straight lanes: the 10/50/90 % quantiles are -0.29/-0.04/0.07 m at one
# junction, -0.20/0.15/0.31 m at another; means of turning lanes: -0.45 to 0.70 m. Deviation between
# vehicles of a lane: 0.30-0.47 m, turning 0.28-0.45 m. 9-15 % of the samples are over 1 m off.
DRIVERS_AS_RECORDED = LaneKeeping(
    mean_m=-0.04,
    lane_m=0.18,
    turn_m=0.36,
    driver_m=0.37,
    wander_m=0.2,
    cut_m2=2.0,
    round_m=1.45,
    round_every_m=130.0,
    straddling=0.03,
)
DRIVERS = {"textbook": LaneKeeping(), "as recorded": DRIVERS_AS_RECORDED}
