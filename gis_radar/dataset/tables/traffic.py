"""Lane measures and turns: traffic by lane in a quarter of an hour."""

import pyarrow as pa

from gis_radar.dataset.tables.table import TableColumn, TableSchema

_COUNT, _NUMBER = pa.int32(), pa.float32()
_INTERVAL = TableColumn("interval", _COUNT, "quarter of an hour of the UTC day, 0 to 95")
_VOLUME = (
    TableColumn("volume", _NUMBER, "vehicles in the whole interval, estimated", True),
    TableColumn("volume_se", _NUMBER, "standard error of volume, poses as given", True),
)

LANE_MEASURES = TableSchema(
    name="lane_measures",
    means="a lane in a quarter of an hour of the UTC day",
    columns=(
        TableColumn("lane", pa.int64(), "number of the lane, as in the layer `lanes`"),
        _INTERVAL,
        TableColumn("visible_share", _NUMBER, "share of it in which the counting line is visible"),
        TableColumn("counted", _COUNT, "fronts over the stop line, else over the middle", True),
        *_VOLUME,
        TableColumn("heavy", _NUMBER, "buses and trucks among `counted`: sum of p_heavy", True),
        TableColumn("speed_mean", _NUMBER, "space-mean speed on the lane, m/s", True),
        TableColumn("speed_time_mean", _NUMBER, "mean speed at the counting line, m/s", True),
        TableColumn(
            "speed_counts", pa.list_(_COUNT), "of `counted`, by 5 km/h; the last from 195", True
        ),
        TableColumn("occupancy", _NUMBER, "mean of its tiles, by visible steps", True),
        TableColumn("occupancy_se", _NUMBER, "standard error of occupancy, poses as given", True),
        TableColumn("density", _NUMBER, "vehicles a km", True),
        TableColumn("flow", _NUMBER, "vehicles an hour, mean along the lane", True),
        TableColumn("travel_time_s", _NUMBER, "over the whole lane, mean", True),
        TableColumn("delay_s", _NUMBER, "travel time beyond that at free speed", True),
        TableColumn("queue_max_m", _NUMBER, "farthest back of a queue from the stop line", True),
        TableColumn("queue_mean_m", _NUMBER, "mean back over time, 0 without a queue", True),
        TableColumn("stops", _COUNT, "vehicles that came to stand", True),
        TableColumn("visible_km_h", _NUMBER, "km of lane x hours visible: the weight of sums"),
    ),
    order=("lane", "interval"),
    period="day",
)

TURNS = TableSchema(
    name="turns",
    means="a way from a lane to the next one beyond a junction in a quarter of an hour",
    columns=(
        TableColumn("from_lane", pa.int64(), "number of the approach's lane"),
        TableColumn("to_lane", pa.int64(), "number of the exit's lane"),
        _INTERVAL,
        TableColumn(
            "visible_share", _NUMBER,
            "of the counting line of the approach or of the exit's begin, the less visible one",
        ),
        *_VOLUME,
    ),
    order=("from_lane", "to_lane", "interval"),
    period="day",
)  # fmt: skip
