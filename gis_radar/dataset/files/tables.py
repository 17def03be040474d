"""The tables of a dataset: their columns with types, units and order."""

from __future__ import annotations

import pyarrow as pa

from gis_radar.base import Text
from gis_radar.dataset.files.schema import (
    FIRST,
    LAST,
    POSE,
    SENSOR,
    STEP,
    TILE,
    VEHICLE,
    TableColumn,
    TableSchema,
)

SCHEMA = 1
"""Of the contract: readers refuse a newer one."""

_SHORT, _LONG, _SINGLE, _DOUBLE = pa.int32(), pa.int64(), pa.float32(), pa.float64()
_FLAG, _TEXT = pa.bool_(), pa.string()

FRAMES = TableSchema(
    name="frames",
    means="a frame of a sensor",
    columns=(
        SENSOR,
        TableColumn("time_us", _LONG, "time since 1970, corrected, microseconds"),
        FIRST,
        TableColumn("last_step", _LONG, "last step in which it is valid, perhaps of the next hour"),
        TableColumn("detections", _SHORT, "detections"),
        TableColumn("moving", _SHORT, "of them, moving ones"),
        TableColumn("pose", _TEXT, "pose in `sights` whose tiles were in sight"),
        TableColumn("wild", _SHORT, "detections too fast for any vehicle"),
        TableColumn("tiles_hit", _SHORT, "tiles that it hit"),
        TableColumn("tiles_seen", _SHORT, "tiles in sight of its pose"),
        TableColumn("checksum", _SHORT, "16 bits of a hash, equal where frames repeat"),
        TableColumn("shift_us", _LONG, "what was added to its time, microseconds"),
        TableColumn("pose_in_force", _TEXT, "pose in `poses` by which it lies in the map"),
    ),
    order=("sensor", "time_us"),
    span=("first_step", "first_step"),
)

HITS = TableSchema(
    name="hits",
    means="a tile that was hit in a step, all sensors together",
    columns=(TILE, STEP),
    order=("tile_id", "step"),
    span=("step", "step"),
)


def _runs_of_tiles(name: str, means: str, *further: TableColumn) -> TableSchema:
    return TableSchema(
        name=name, means=means, columns=(TILE, FIRST, LAST, *further),
        order=("tile_id", "first_step"), span=("first_step", "last_step"), runs=True,
    )  # fmt: skip


OBSERVED = _runs_of_tiles("observed", "a run of steps in which a tile was observed")
VISIBLE = _runs_of_tiles(
    "visible", "a run of steps in which a tile was visible, and `seen` the same",
    TableColumn("seen", _FLAG, "not hidden by vehicles; else hidden for up to 10 s"),
)  # fmt: skip
OCCUPIED = _runs_of_tiles(
    "occupied",
    "a run of steps in which a tile was occupied, visible or not, and `seen` the same",
    TableColumn("seen", _FLAG, "the vehicle was measured within 0.5 s"),
)

TRACKS = TableSchema(
    name="tracks",
    means="the state of a vehicle at a step's begin",
    columns=(
        VEHICLE, STEP,
        TableColumn("x_cm", _SHORT, "centre of the footprint, east of the dataset's origin"),
        TableColumn("y_cm", _SHORT, "north of it"),
        TableColumn("heading_cdeg", _SHORT, "0.01 deg counter-clockwise from grid east"),
        TableColumn("speed_cms", _SHORT, "cm/s"),
        TableColumn("lanelet_id", _LONG, "the lanelet it follows; null off the lanes", True),
        TableColumn("s_cm", _SHORT, "its front along the lanelet; null off the lanes", True),
        TableColumn("d_cm", _SHORT, "left of the lanelet's centre; null off the lanes", True),
        TableColumn("seen", _FLAG, "measured within 0.5 s, else inferred"),
    ),
    order=("vehicle", "step"),
    span=("step", "step"),
)  # fmt: skip

VEHICLES = TableSchema(
    name="vehicles",
    means="a vehicle in an hour",
    columns=(
        VEHICLE, FIRST, LAST,
        TableColumn("length_m", _SINGLE, "length"),
        TableColumn("width_m", _SINGLE, "width"),
        TableColumn("length_sigma_m", _SINGLE, "standard error of the length"),
        TableColumn("p_exists", _SINGLE, "probability that it exists; null: not known", True),
        TableColumn("p_heavy", _SINGLE, "probability that it is a bus or a truck over 3.5 t"),
        TableColumn("lanelets", pa.list_(_LONG), "the lanelets it followed, in order"),
    ),
    order=("vehicle",),
    span=("first_step", "last_step"),
)  # fmt: skip

CONTINUED = TableSchema(
    name="continued",
    means="two numbers of one vehicle on either side of the hour's begin",
    columns=(
        TableColumn("vehicle", _LONG, "its number in the hour before"),
        TableColumn("next", _LONG, "its number in this hour"),
    ),
    order=("vehicle",),
)

PASSAGES = TableSchema(
    name="passages",
    means="a vehicle's front passes the middle of a lanelet",
    columns=(
        VEHICLE,
        TableColumn("lanelet_id", _LONG, "the lanelet"),
        STEP,
        TableColumn("speed_cms", _SHORT, "estimated speed of the vehicle in that step, cm/s"),
        TableColumn("p_heavy", _SINGLE, "probability that it is a bus or a truck over 3.5 t"),
    ),
    order=("step", "vehicle", "lanelet_id"),
    span=("step", "step"),
)

TILE_COUNTS = TableSchema(
    name="tile_counts",
    means="a tile in a quarter of an hour of the UTC day",
    columns=(
        TILE,
        TableColumn("interval", _SHORT, "quarter of an hour of the UTC day, 0 to 95"),
        TableColumn("hit_steps", _SHORT, "steps both hit and observed"),
        TableColumn("observed_steps", _SHORT, "steps observed"),
        TableColumn("occupied_steps", _SHORT, "steps both occupied and visible"),
        TableColumn("visible_steps", _SHORT, "steps visible"),
        TableColumn("hidden_steps", _SHORT, "steps observed and not visible"),
        TableColumn("occupied_variance", _SINGLE, "of occupied_steps by the tracks, steps^2"),
        TableColumn("inferred_steps", _SHORT, "steps visible while hidden by vehicles"),
    ),
    order=("tile_id", "interval"),
    period="day",
)

_INTERVAL = TableColumn("interval", _SHORT, "quarter of an hour of the UTC day, 0 to 95")
_VOLUME = (
    TableColumn("volume", _SINGLE, "vehicles in the whole interval, estimated", True),
    TableColumn("volume_se", _SINGLE, "standard error of volume, poses as given", True),
)

LANE_MEASURES = TableSchema(
    name="lane_measures",
    means="a lane in a quarter of an hour of the UTC day",
    columns=(
        TableColumn("lane", _LONG, "number of the lane, as in the layer `lanes`"),
        _INTERVAL,
        TableColumn("visible_share", _SINGLE, "share of it in which the counting line is visible"),
        TableColumn("counted", _SHORT, "fronts over the stop line, else over the middle", True),
        *_VOLUME,
        TableColumn("heavy", _SINGLE, "buses and trucks among `counted`: sum of p_heavy", True),
        TableColumn("speed_mean", _SINGLE, "space-mean speed on the lane, m/s", True),
        TableColumn("speed_time_mean", _SINGLE, "mean speed at the counting line, m/s", True),
        TableColumn(
            "speed_counts", pa.list_(_SHORT), "of `counted`, by 5 km/h; the last from 195", True
        ),
        TableColumn("occupancy", _SINGLE, "mean of its tiles, by visible steps", True),
        TableColumn("occupancy_se", _SINGLE, "standard error of occupancy, poses as given", True),
        TableColumn("density", _SINGLE, "vehicles a km", True),
        TableColumn("flow", _SINGLE, "vehicles an hour, mean along the lane", True),
        TableColumn("travel_time_s", _SINGLE, "over the whole lane, mean", True),
        TableColumn("delay_s", _SINGLE, "travel time beyond that at free speed", True),
        TableColumn(
            "queue_max_m",
            _SINGLE,
            "farthest back of a queue from the stop line, drawn or presumed",
            True,
        ),
        TableColumn("queue_mean_m", _SINGLE, "mean back over time, 0 without a queue", True),
        TableColumn("stops", _SHORT, "vehicles that came to stand", True),
        TableColumn("visible_km_h", _SINGLE, "km of lane x hours visible: the weight of sums"),
    ),
    order=("lane", "interval"),
    period="day",
)

TURNS = TableSchema(
    name="turns",
    means="a way from a lane to the next one beyond a junction in a quarter of an hour",
    columns=(
        TableColumn("from_lane", _LONG, "number of the approach's lane"),
        TableColumn("to_lane", _LONG, "number of the exit's lane"),
        _INTERVAL,
        TableColumn(
            "visible_share", _SINGLE,
            "of the counting line of the approach or of the exit's begin, the less visible one",
        ),
        *_VOLUME,
    ),
    order=("from_lane", "to_lane", "interval"),
    period="day",
)  # fmt: skip

_SUMMED = {_SHORT: _LONG, _SINGLE: _DOUBLE}
_WEEKDAY = TableColumn("weekday", _SHORT, "day of the week by the site's clocks, 0: Monday")
_HOUR = TableColumn("hour", _SHORT, "hour of the day by the site's clocks, 0 to 23")

LANE_MONTHS = TableSchema(
    name="lane_months",
    means="a lane in an hour of the day, on one day of the week, of a month: sums of quarters",
    columns=(
        TableColumn("lane", _LONG, "number of the lane, as in the layer `lanes`"),
        _WEEKDAY,
        _HOUR,
        TableColumn("quarters", _SHORT, "quarters of an hour of which the volume is known"),
        TableColumn("visible_s", _DOUBLE, "seconds in which the counting line was visible"),
        TableColumn("counted", _LONG, "fronts over the stop line, else over the middle"),
        TableColumn("volume", _DOUBLE, "vehicles in `quarters`, estimated"),
        TableColumn("volume_variance", _DOUBLE, "of volume, poses as given"),
        TableColumn("heavy", _DOUBLE, "buses and trucks among `counted`"),
        TableColumn("speed_counts", pa.list_(_LONG), "of `counted`, by 5 km/h; the last from 195"),
        TableColumn("visible_km_h", _DOUBLE, "km of lane x hours visible"),
        TableColumn("occupied_km_h", _DOUBLE, "occupancy x visible_km_h"),
        TableColumn("occupied_variance", _DOUBLE, "of occupied_km_h, poses as given"),
        TableColumn("vehicle_km", _DOUBLE, "flow x visible_km_h: driven where visible"),
        TableColumn("vehicle_h", _DOUBLE, "density x visible_km_h: spent where visible"),
        TableColumn("delay_h", _DOUBLE, "delay x volume, hours"),
        TableColumn(
            "queue_m_s",
            _DOUBLE,
            "mean back of the queue x seconds visible; x 900 where the counting line never is",
        ),
        TableColumn("queue_max_m", _DOUBLE, "farthest back of a queue from the stop line", True),
        TableColumn("stops", _LONG, "vehicles that came to stand"),
    ),
    order=("lane", "weekday", "hour"),
    period="month",
)

TILE_MONTHS = TableSchema(
    name="tile_months",
    means="a tile in an hour of the day of a month: sums of `tile_counts`",
    columns=(
        TILE,
        _HOUR,
        *(
            TableColumn(each.name, _SUMMED[each.type], each.means)
            for each in TILE_COUNTS.columns[2:]
        ),
    ),
    order=("tile_id", "hour"),
    period="month",
)

RECORDINGS = TableSchema(
    name="recordings",
    means="a recording and the hours that were made with it",
    columns=(
        TableColumn("path", _TEXT, Text("the file")),
        TableColumn("digest", _TEXT, "SHA-256 of the file"),
        SENSOR, POSE,
        TableColumn("first_time", _DOUBLE, "first frame, UNIX seconds, corrected"),
        TableColumn("last_time", _DOUBLE, "last frame, UNIX seconds, corrected"),
        TableColumn("clock_offset", _DOUBLE, "by which its clock is ahead, seconds"),
        TableColumn("clock_drift_ppm", _DOUBLE, "by how much its clock runs fast, us/s"),
        TableColumn("clock_at", _DOUBLE, "when the offset holds, UNIX seconds of its clock"),
        TableColumn("validity_s", _DOUBLE, "how long its frames are valid, seconds"),
        TableColumn("rows", _LONG, "rows of the file"),
        TableColumn("has_rates", _FLAG, "whether it has range rates"),
        TableColumn("has_elevation", _FLAG, "whether it measures elevation"),
        TableColumn("hours", pa.list_(_LONG), "hours since 1970 that were made with it"),
        TableColumn("sights", _TEXT, "digest of what its poses see, as in `sights`", True),
    ),
    order=("sensor", "first_time", "digest"),
    period="dataset",
)  # fmt: skip

POSES = TableSchema(
    name="poses",
    means="where a sensor stands and looks",
    columns=(
        POSE, SENSOR,
        *(TableColumn(name, _DOUBLE, "metres") for name in ("easting", "northing", "height")),
        *(TableColumn(name, _DOUBLE, "degrees") for name in ("yaw", "pitch", "roll")),
        TableColumn("track", _TEXT, "pose track that it is of, as in `recordings.pose`"),
        TableColumn("since", _DOUBLE, "from when on it holds, UNIX seconds; null: always", True),
        TableColumn("sight", _TEXT, "pose in `sights` that has seen the same, and in `frames`"),
        TableColumn("road_m", _DOUBLE, "height of the road near it, metres; null: unknown", True),
        TableColumn("document", _TEXT, "the pose as JSON"),
    ),
    order=("pose",),
    period="dataset",
)  # fmt: skip

SIGHTS = TableSchema(
    name="sights",
    means="a tile in sight of a pose",
    columns=(POSE, TILE),
    order=("pose", "tile_id"),
    period="dataset",
)

HIT_TABLES = (FRAMES, HITS, OBSERVED)
_VEHICLE_TABLES = (VISIBLE, OCCUPIED, TRACKS, VEHICLES, CONTINUED, PASSAGES)
"""Absent where there are no range rates or lanes, or only hits are asked for."""

HOUR_TABLES = (*HIT_TABLES, *_VEHICLE_TABLES)
DAY_TABLES = (TILE_COUNTS, LANE_MEASURES, TURNS)
MONTH_TABLES = (LANE_MONTHS, TILE_MONTHS)
TABLES = {
    table.name: table
    for table in (*HOUR_TABLES, *DAY_TABLES, *MONTH_TABLES, RECORDINGS, POSES, SIGHTS)
}
