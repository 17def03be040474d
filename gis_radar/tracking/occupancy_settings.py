"""Settings of footprints, visibility and the error of occupancy, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class OccupancySettings:
    """Constants of occupied and hidden tiles; those in effect are written to the manifest.

    Parameters
    ----------
    overlap_m : float
        A footprint occupies a tile when it overlaps the middle cross-line by so much, metres, or by
        half of the cross-line or of the vehicle's width where that is less (the contract).
    same_level_m : float
        A footprint is on the level of a tile when their roads are within so many metres of height
        (the contract): over a crossfall, under the clearance of a bridge.
    strip_m : float
        A longer vehicle is the strip of its width along the path its front took, metres (the
        contract): the longest single vehicle without a joint.
    path_step_m : float
        Distance of the points of such a path, metres: on a curve of 10 m radius its chord is 1 cm
        off the arc.
    hidden_s : float
        A tile stays visible for so long while other vehicles hide it, seconds (the contract).
    unseen_s : float
        Runs of visible steps are split where other vehicles hide the tile for so long,
        seconds: a vehicle's passing hides for less, and tracks bridge that.
    look_steps : int
        Lines of sight are looked along once in so many steps, and where the sensors change: a
        vehicle at 15 m/s goes 3 m in 0.2 s, which 10 s of hiding do not depend on.
    target_m : float
        Height over the road at which a tile is looked at, metres (the contract): a car's bumper.
    car_height_m, van_height_m, heavy_height_m : float
        Height of the box of a car, of a van and of a heavy vehicle, metres: a compact car; panel
        vans are 2.2 to 2.8 m; a box body or trailer is 3.5 to 4 m. All heights 0.2 m lower or
        higher change the visible time of streets full of queues by 2 %.
    van_m : float
        A vehicle that is not heavy and longer than this is a van, metres: cars end at 5.1 m, vans
        with a high roof begin at 5.3 m.
    sensor_over_road_m : float
        Height of a sensor over the road where tiles have no heights, metres: a mast or a signal
        head stands 4 to 6 m high.
    """

    overlap_m: float = 0.5
    same_level_m: float = 2.0
    strip_m: float = 12.0
    path_step_m: float = 1.0
    hidden_s: float = 10.0
    unseen_s: float = 1.0
    look_steps: int = 4
    target_m: float = 0.6
    car_height_m: float = 1.5
    van_height_m: float = 2.3
    heavy_height_m: float = 3.5
    van_m: float = 5.2
    sensor_over_road_m: float = 5.0


OCCUPANCY_DEFAULTS = OccupancySettings()
