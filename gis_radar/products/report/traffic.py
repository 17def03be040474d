"""Traffic in a report: how many vehicles, how fast; where they turn; where and when they queue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    NO_FIGURE,
    THIN_SPACE,
    Clock,
    Text,
    by_number,
    figure_text,
    listed,
    percent,
    plural,
    seconds_text,
    tr,
    with_error,
)
from gis_radar.measures import JOINED_M, LEAST_VISIBLE_SHARE
from gis_radar.products import report_files as names
from gis_radar.products.report.chart import chart_over
from gis_radar.products.report.content import (
    NOT_SEEN,
    QUEUES,
    REPORT_WORDS,
    TOO_LITTLE,
    Chapter,
    Chart,
    Column,
    Figure,
    Table,
    number_column,
    text_rows,
)
from gis_radar.products.report.courses import (
    DIAGRAM_S,
    MOST_COURSES,
    LongQueue,
    course_title,
    draw_courses,
    longest_queue_text,
    presumed_note,
)
from gis_radar.products.report.lanes import FAR_M, far_lanes
from gis_radar.products.report.results import ReportedTraffic
from gis_radar.products.report.turns import turn_table, turning_diagram
from gis_radar.products.traffic import service_levels

_STRIPS, _MOST_CHARTS = 12, 2  # lanes of a chart, which fills a page; most charts
_LEAST_INTERVALS = 3  # for a chart over time: of two values the table has the mean
_MOST_LANES = 60  # rows of the table as read; the CSV file holds all
_MOST_QUEUES = 6  # lanes of the table of queues
LEAST_QUEUE_M = 7.5  # one vehicle and the gap before it
# A lane without a queue is slow below this share of its free speed, if it is occupied for so long:
# a single slow vehicle is no congestion.
_SLOW, _LEAST_OCCUPANCY = 0.5, 0.1
_LEVEL = Text("Level of service")
_LEVELS = Text("Levels of service are of signals, by the delay; in the handbook of 15 minutes.")


def traffic_chapters(traffic: ReportedTraffic, clock: Clock, *, paths: bool) -> list[Chapter]:
    """Return the chapters on traffic, each with the question that it answers.

    Parameters
    ----------
    traffic : ReportedTraffic
        The traffic.
    clock : Clock
        Clock of the site.
    paths : bool
        Whether diagrams of queues show the trajectories of vehicles.
    """
    clock = traffic.clock(clock)
    chapters = [
        Chapter("volumes", tr("How many vehicles, how fast?"),
                [_volume_table(traffic), *_volume_charts(traffic, clock)]),
    ]  # fmt: skip
    if traffic.by_turn["volume"].notna().any():
        turns = (turning_diagram(traffic), turn_table(traffic))
        chapters.append(Chapter("turns", tr("Where do they turn?"), turns))
    if slow := [*_queues(traffic, clock, paths=paths), *_slow_lanes(traffic)]:
        chapters.append(Chapter(QUEUES, tr("Where is it slow or full, and when?"), slow))
    return chapters


def lanes_with_stop_lines(traffic: ReportedTraffic) -> set[int]:
    """Return the lanes whose stop line the map draws."""
    return set(traffic.network.lane[traffic.network.has_stop_line].tolist())


def _lanes_by_name(traffic: ReportedTraffic) -> gpd.GeoDataFrame:
    """Return the lanes over the whole time: those with stop lines by name, then the others.

    Lanes within the junction are left out: they are turns.
    """
    network = traffic.network
    inside = set(network.lane[network.connector].tolist())
    rows = traffic.by_lane[~traffic.by_lane["lane"].isin(inside)]
    later = ~rows["lane"].isin(lanes_with_stop_lines(traffic))
    rows = rows.assign(later=later, order=rows["name"].map(by_number), hours=traffic.hours)
    return rows.sort_values(["later", "order"], ignore_index=True)


def lanes_counted(traffic: ReportedTraffic) -> pd.DataFrame:
    """Return lanes with a volume: those with stop lines, or all where none of them has one."""
    rows = _lanes_by_name(traffic)
    rows = rows[rows["volume"].notna()]
    before = rows["lane"].isin(lanes_with_stop_lines(traffic))
    return pd.DataFrame(rows[before] if before.any() else rows)


def volume_text(row: pd.Series) -> str:
    """Return the volume an hour of a lane with its standard error, or why there is none."""
    if pd.isna(row["volume"]):
        return tr(TOO_LITTLE if row["visible_share"] > 0.0 else NOT_SEEN)
    return with_error(row["volume"] / row["hours"], row["volume_se"] / row["hours"])


def _volume_table(traffic: ReportedTraffic) -> Table:
    """Return volumes, speeds and queues, a row a lane."""
    shown = (rows := _lanes_by_name(traffic)).head(_MOST_LANES)
    columns = _volume_columns()
    return Table(
        name="volumes", caption=tr("Traffic of lanes over the whole time"), columns=columns,
        rows=text_rows((row for _, row in shown.iterrows()), columns),
        note=" ".join(_volume_notes(traffic, rows, len(shown))),
        files=[(names.TRAFFIC_FILE, tr("each lane in each interval, with further measures"))],
    )  # fmt: skip


def _volume_columns() -> list[Column]:
    def counted(row: pd.Series) -> str:
        return tr(NOT_SEEN) if pd.isna(row["counted"]) else figure_text(int(row["counted"]))

    def heavy(row: pd.Series) -> str:
        known = pd.notna(row["counted"]) and row["counted"] > 0
        return percent(row["heavy"] / row["counted"], 0) if known else NO_FIGURE

    def queue(row: pd.Series) -> str:
        if pd.isna(row["stop_line"]):
            return NO_FIGURE
        # nothing stands in sight, and the first vehicle may stand farther back than that
        is_unknown = pd.isna(row["queue_max_m"]) or (
            row["queue_max_m"] == 0.0 and row["sight_m"] <= JOINED_M
        )
        return tr(NOT_SEEN) if is_unknown else longest_queue_text(row)

    return [
        Column(tr("Lane"), "", lambda row: str(row["name"]), False),
        number_column(lambda row: str(row["lane"])),
        Column(tr("Counted"), tr("vehicles"), counted),
        Column(tr("Volume"), tr("veh/h"), volume_text),
        Column(tr("Heavy"), tr("of those counted"), heavy),
        Column(tr("Mean speed"), tr("km/h, waiting included"),
               lambda row: figure_text(row["speed_kmh"])),
        Column(tr("Longest queue"), "m", queue),
    ]  # fmt: skip


def _volume_notes(traffic: ReportedTraffic, rows: pd.DataFrame, shown: int) -> list[str]:
    """Return notes on the table: definitions, missing values, lanes without a row."""
    seconds = (traffic.end - traffic.begin).total_seconds()
    notes = [
        tr("Vehicles are counted at the stop line, elsewhere in the middle of the lane. Volume is "
           "the estimate for an hour like this time, ± its standard error; the other figures have "
           "no known error. From {time} nothing follows about other hours or days.",
           time=seconds_text(seconds)),
    ]  # fmt: skip
    share = percent(LEAST_VISIBLE_SHARE, 0)
    if rows["volume"].isna().any():
        notes.append(
            tr("Not seen: the place of counting, or the begin of a queue, was not visible, which "
               "is not 0; too little seen: under {share} of the time.", share=share)
        )  # fmt: skip
    if rows["stop_line"].isna().all():
        notes.append(tr("The map has no stop lines, so queues are not known."))
    notes += presumed_note(rows)
    if far := far_lanes(rows, traffic.network, traffic.dataset.poses()):
        notes.append(
            tr("Over {far} m from every sensor, where more vehicles may be missed than ± states: "
               "{lanes}.", far=int(FAR_M), lanes=listed([*map(str, far)]))
        )  # fmt: skip
    if missing := len(traffic.network.lane) - len(traffic.by_lane):
        notes.append(
            plural(
                missing, REPORT_WORDS["occupancy"].unseen_one, REPORT_WORDS["occupancy"].unseen_many
            )
        )
    if len(rows) > shown:
        notes.append(tr("Here are {part} of {all} lanes.", part=shown, all=len(rows)))
    return notes


def _volume_charts(traffic: ReportedTraffic, clock: Clock) -> list[Chart]:
    """Draw the volume of lanes by interval."""
    return _charts(traffic, lanes_counted(traffic), _VOLUMES, clock)


class _Profile(NamedTuple):
    """Content of strips: columns of value and error, tops of scales, whether per hour, words."""

    columns: Sequence[str]
    tops: Sequence[float]
    an_hour: bool
    heading: str
    caption: str


_VOLUMES = _Profile(
    ("volume", "volume_se"), (60, 120, 300, 600, 900, 1200, 1800, 2400), True,
    Text("Lane; vehicles an hour; band: standard error"),
    Text("Volume of each lane in intervals of {length}, all on one scale; the band is its "
         "standard error. Hatched grey: not seen."),
)  # fmt: skip
_LONGEST_QUEUES = _Profile(
    ("queue_max_m", "unknown"), (20, 50, 100, 200, 300, 500), False,
    Text("Lane; longest queue, metres"),
    Text("Longest queue of each lane in intervals of {length}, all on one scale. Hatched grey: the "
         "stop line was not seen."),
)  # fmt: skip


def _charts(
    traffic: ReportedTraffic, lanes: pd.DataFrame, profile: _Profile, clock: Clock
) -> list[Chart]:
    """Draw a strip for each lane, up to `_MOST_CHARTS` charts; none of too few intervals."""
    if len(set(traffic.lanes["begin"])) < _LEAST_INTERVALS or lanes.empty:
        return []
    lanes = lanes.head(_STRIPS * _MOST_CHARTS)
    table = traffic.lanes.assign(unknown=np.nan).set_index(["lane", "begin"])
    table = table[[*profile.columns]].astype(float)
    table = table / (traffic.length_s / 3600.0) if profile.an_hour else table
    high = float(table.loc[lanes["lane"].tolist()].sum(axis=1).max())
    step = profile.tops[-1] / 4.0
    top = next((each for each in profile.tops if each >= high), float(np.ceil(high / step) * step))
    strips = [(str(row["name"]), table.loc[row["lane"]] / top) for _, row in lanes.iterrows()]
    return [
        _chart(strips[first : first + _STRIPS], top, traffic, profile, clock)
        for first in range(0, len(strips), _STRIPS)
    ]


def _chart(
    strips: Sequence[tuple[str, pd.DataFrame]], top: float, traffic: ReportedTraffic,
    profile: _Profile, clock: Clock,
) -> Chart:  # fmt: skip
    begin, end = (traffic.lanes[n].dt.tz_convert("UTC") for n in ("begin", "end"))
    edges = pd.date_range(begin.min(), end.max(), freq=timedelta(seconds=traffic.length_s))
    drawn = ((name, *rows.reindex(edges[:-1]).to_numpy().T) for name, rows in strips)
    length = f"{figure_text(traffic.length_s / 60.0)}{THIN_SPACE}min"
    return chart_over(
        [each.to_pydatetime() for each in edges], drawn, clock,
        caption=tr(profile.caption, length=length), heading=tr(profile.heading),
        alt=tr(
            "Chart of {n} lanes over {intervals} intervals; the table has the whole time.",
            n=len(strips), intervals=len(edges) - 1,
        ),
        top=figure_text(top),
    )  # fmt: skip


def _queues(traffic: ReportedTraffic, clock: Clock, *, paths: bool) -> list[Table | Figure | Chart]:
    """Return where vehicles queue: a table, and the course of the longest queues."""
    queues = traffic.by_lane[traffic.by_lane["queue_max_m"] >= LEAST_QUEUE_M]
    queues = queues.sort_values(["queue_max_m", "lane"], ascending=[False, True])
    if queues.empty:
        return []
    table = traffic.lanes.dropna(subset="queue_max_m").sort_values("queue_max_m", kind="stable")
    longest_by_lane = table.groupby("lane").last()
    longest = [
        LongQueue(
            int(row["lane"]), course_title(row), float(row["queue_max_m"]),
            longest_by_lane.loc[row["lane"], ["begin", "end"]].mean().to_pydatetime(),
        )
        for _, row in queues.head(MOST_COURSES).iterrows()
    ]  # fmt: skip
    span = (traffic.begin, traffic.end)
    long = int((traffic.end - traffic.begin).total_seconds() > DIAGRAM_S)  # diagrams show a part
    return [
        *draw_courses(traffic.dataset, longest, span, replace(clock, to_seconds=True), paths=paths),
        _queue_table(traffic, queues, longest_by_lane, clock),
        *_charts(traffic, queues.head(_MOST_QUEUES), _LONGEST_QUEUES, clock)[:long],
    ]


def _slow_lanes(traffic: ReportedTraffic) -> list[Table]:
    """Return the lanes without a known queue on which traffic is slow, as a table; [] if none."""
    network = traffic.network
    free_kmh = pd.Series(3.6 * network.free_speed, network.lane)
    inside = set(network.lane[network.connector].tolist())

    rows = traffic.by_lane.assign(free_kmh=traffic.by_lane["lane"].map(free_kmh))
    slow = (rows["speed_kmh"] < _SLOW * rows["free_kmh"]) & rows["queue_max_m"].isna()
    slow &= (rows["occupancy"] >= _LEAST_OCCUPANCY) & ~rows["lane"].isin(inside)
    lanes = rows[slow].sort_values(["speed_kmh", "lane"])
    if lanes.empty:
        return []

    def occupancy(row: pd.Series) -> str:
        return with_error(100.0 * row["occupancy"], 100.0 * row["occupancy_se"])

    columns = [
        Column(tr("Lane"), "", lambda row: str(row["name"]), False),
        number_column(lambda row: str(row["lane"])),
        Column(tr("Mean speed"), "km/h", lambda row: figure_text(row["speed_kmh"])),
        Column(tr("Free speed"), "km/h", lambda row: figure_text(row["free_kmh"])),
        Column(tr("Occupancy"), "%", occupancy),
    ]  # fmt: skip
    return [
        Table(
            name="slow", caption=tr("Slow lanes whose queue is not known"), columns=columns,
            rows=text_rows([row for _, row in lanes.head(_MOST_QUEUES).iterrows()], columns),
            note=tr(
                "Slow: over the whole time less than half of the free speed, which the map or the "
                "site file states, on a lane that is occupied for {share} of the time or more.",
                share=percent(_LEAST_OCCUPANCY, 0),
            ),
        )
    ]  # fmt: skip


def _queue_table(
    traffic: ReportedTraffic, queues: pd.DataFrame, longest_by_lane: pd.DataFrame, clock: Clock
) -> Table:
    def when(row: pd.Series) -> str:
        span = longest_by_lane.loc[row["lane"]]
        return clock.span(span["begin"].to_pydatetime(), span["end"].to_pydatetime())

    def figure(name: str) -> Column:
        title, unit = _OF_QUEUES[name]
        longest = name == "queue_max_m"
        return Column(
            tr(title),
            tr(unit),
            longest_queue_text if longest else lambda row: figure_text(float(row[name])),
        )

    several = len(set(traffic.lanes["begin"])) > 1
    columns = [
        Column(tr("Lane"), "", lambda row: str(row["name"]), False),
        number_column(lambda row: str(row["lane"])),
        figure("queue_max_m"),
        *([Column(tr("Reached"), clock.name, when, False)] if several else []),
        *(figure(name) for name in _OF_QUEUES
          if name != "queue_max_m" and queues[name].notna().any()),
    ]  # fmt: skip
    levels = service_levels(queues, "hcm")
    further = presumed_note(queues)
    if levels.notna().any():
        further.append(tr(_LEVELS))
        queues = queues.assign(los=levels.fillna(NO_FIGURE))
        columns.append(Column(tr(_LEVEL), "HCM", lambda row: str(row["los"])))
    rows = text_rows([row for _, row in queues.head(_MOST_QUEUES).iterrows()], columns)
    return Table(
        name="queues", caption=tr("The longest queues"), columns=columns, rows=rows,
        note=tr(
            "A queue is the vehicles that stand, from the stop line back, with no more than 10 m "
            "between them free or out of sight: a vehicle that was missed cuts it there, so it "
            "may be longer. 'At least' is where it reaches as far as the radars see. Nothing "
            "follows about why vehicles wait."
        ) + "".join(f" {each}" for each in further),
    )  # fmt: skip


_OF_QUEUES = {
    "queue_max_m": (Text("Longest queue"), Text("m")),
    "queue_mean_m": (Text("Mean queue"), Text("m")),
    "stops": (Text("Stops"), Text("vehicles")),
    "delay_s": (Text("Delay"), Text("s a vehicle")),
    "speed_kmh": (Text("Mean speed"), Text("km/h, waiting included")),
}
