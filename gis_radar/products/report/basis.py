"""What a report rests on: recorded time, road seen, tracks; and what may be concluded."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gis_radar.base import (
    STEP_S,
    THIN_SPACE,
    Clock,
    Text,
    figure_text,
    listed,
    localised,
    percent,
    plural,
    plus_minus,
    seconds_text,
    tr,
)
from gis_radar.measures import Runs
from gis_radar.products.heatmap.occupancy import mean_occupancy
from gis_radar.products.quality.quality import GOOD, Quality
from gis_radar.products.report.content import (
    TOO_LITTLE,
    Fact,
    Table,
    text_columns,
)
from gis_radar.products.report.lanes import (
    FAR_M,
    LEAST_SEEN,
    MOST_ERROR,
    far_lanes,
    part_and_base,
)
from gis_radar.products.report.results import NOT_KNOWN, ReportedTraffic, Results
from gis_radar.products.report.traffic import (
    lanes_counted,
    lanes_with_stop_lines,
    volume_text,
)
from gis_radar.scans import VIEW_ONLY

_NO_RUN = Text("The folder is not that of a run: settings are listed only as far as known.")
_SHORT_S = 900.0  # usual counts are of 15 minutes; shorter ones hold few cycles of a signal
DAY_S = 86_400.0


class ReportData(NamedTuple):
    """Data of a report, from which page, PDF and tables are made."""

    results: Results
    title: str
    clock: Clock
    quality: Quality | None  # what sensors delivered; None where that is not known
    lanes: pd.DataFrame  # by interval, from `sums_of`
    table: pd.DataFrame  # the lanes over the whole time, from `lane_table`
    traffic: ReportedTraffic | None = None  # by lane and turn; None where none is known


def recorded_runs(results: Results) -> dict[str, Runs]:
    """Return the steps in which frames of each sensor are valid."""
    return {name: results.dataset.frame_steps(name) for name in results.dataset.sensors}


def recorded_s(results: Results) -> float:
    """Return how long any sensor delivered frames, seconds."""
    return results.dataset.frame_steps().steps * STEP_S


# Names of the totals of lanes, their length, tiles, and tiles occupied or hit.
OCCUPIED_TOTALS = ("lanes_visible", "lane_length_visible_m", "tiles_visible", "tiles_occupied")
HIT_TOTALS = ("lanes_observed", "lane_length_observed_m", "tiles_observed", "tiles_hit")


def totals_of(data: ReportData) -> dict[str, Any]:
    """Count the totals of the whole time; the highest lane is None where none may be named."""
    heat, table, measure = data.results.heat, data.table, data.results.heat.measure
    (part_s, base_s), length_m = part_and_base(heat), heat.tiles["length_m"].to_numpy(np.float64)
    seen = base_s > 0
    lanes, length, tiles, used = OCCUPIED_TOTALS if measure == "occupancy" else HIT_TOTALS
    totals = {
        "recorded_s": round(recorded_s(data.results), 2),
        "lanes": len(table),
        lanes: int(table["share"].notna().sum()),
        "lane_length_m": round(float(length_m.sum()), 2),
        length: round(float(length_m[seen].sum()), 2),
        tiles: int(seen.sum()),
        used: int(np.count_nonzero(part_s[seen])),
    }
    known = heat.occupancy_shares()
    if known is None or not seen.any():
        return totals
    mean, error = mean_occupancy(heat.tiles, known)
    top = table.iloc[0] if table["rank"].iloc[0] == 1 else None
    return totals | {
        "lanes_ranked": int(table["rank"].gt(0).sum()),
        "highest_lane": None if top is None else int(top["lane"]),
        "highest_lane_occupancy": None if top is None else round(float(top["share"]), 6),
        "highest_lane_se": None if top is None else round(float(top["share_se"]), 6),
        "highest_lane_tracks": None if top is None else int(top["tracks"]),
        "mean_occupancy": round(mean, 6),
        "mean_occupancy_se": round(error, 6),
        **data.results.traffic,
    }


def facts_of(data: ReportData) -> list[Fact]:
    """Return the figures at the top, each with what it rests on."""
    total, measure = totals_of(data), data.results.heat.measure
    begin, end = data.results.heat.whole.span()
    base = "visible" if measure == "occupancy" else "observed"
    sensors, recorded = data.results.sensors, total["recorded_s"]
    length, all_m = total[f"lane_length_{base}_m"], total["lane_length_m"]
    names = listed(sensors) if len(sensors) < 5 else ""
    facts = [
        Fact(tr("Recorded"), seconds_text(recorded),
             tr("in {time} from begin to end", time=seconds_text((end - begin).total_seconds()))),
        Fact(tr("Sensors"), str(len(sensors)), names),
        Fact(
            tr("Lane length visible" if measure == "occupancy" else "Lane length observed"),
            tr("{part} of {all}", part=figure_text(length),
               all=f"{figure_text(all_m)}{THIN_SPACE}m"),
            tr("{part} of {all} lanes", part=total[f"lanes_{base}"], all=total["lanes"]),
        ),
    ]  # fmt: skip
    if "mean_occupancy" not in total:
        return facts
    if data.traffic and len(counted := lanes_counted(data.traffic)):
        facts.append(_busiest(data, data.traffic, counted))
    elif "vehicles" in total:
        heavy = tr("{n} of them heavy; no count of vehicles", n=figure_text(total["heavy"]))
        facts.append(Fact(tr("Tracks of vehicles"), figure_text(total["vehicles"]), heavy))
    mean = percent(total["mean_occupancy"], error=total["mean_occupancy_se"])
    facts.append(Fact(tr("Mean occupancy"), mean, tr("of all road that was visible")))
    return [*facts, _highest(data)]


def _busiest(data: ReportData, traffic: ReportedTraffic, counted: pd.DataFrame) -> Fact:
    """Return the lane of the highest volume, of those whose volume is known well enough."""
    sure = counted[
        (counted["visible_share"] >= LEAST_SEEN)
        & (counted["volume_se"] <= MOST_ERROR * counted["volume"])
    ]
    if sure.empty:
        return Fact(tr("Busiest lane"), tr("none to be named"), tr(TOO_LITTLE))
    top = sure.iloc[int(sure["volume"].argmax())]
    volume, lane = tr("{n} veh/h", n=volume_text(top)), _lane_name(data, int(top["lane"]))
    row = traffic.by_lane[traffic.by_lane["lane"] == top["lane"]]
    if far_lanes(row, traffic.network, traffic.dataset.poses()):
        lane = tr("{lane}; over {far} m from every sensor", lane=lane, far=int(FAR_M))
    among = plural(len(sure), "{n} lane with a sure volume", "{n} lanes with a sure volume")
    if top["lane"] in lanes_with_stop_lines(traffic):  # then only such lanes are counted
        among = plural(
            len(sure), "{n} lane with a sure volume at its stop line",
            "{n} lanes with a sure volume at their stop lines",
        )  # fmt: skip
    return Fact(tr("Busiest lane"), volume, tr("{lane}; first of {lanes}", lane=lane, lanes=among))


def _highest(data: ReportData) -> Fact:
    """Return the lane of the highest occupancy, where one may be named."""
    title, top = tr("Fullest lane"), data.table.iloc[0]
    if top["rank"] != 1:
        return Fact(title, tr("none to be named"), tr("see: Lanes"))
    ranked = int((data.table["rank"] > 0).sum())
    rests = tr(
        "{lane}; first of {lanes}",
        lane=_lane_name(data, int(top["lane"])),
        lanes=plural(ranked, "{n} ranked lane", "{n} ranked lanes"),
    )
    return Fact(title, percent(top["share"], error=top["share_se"]), rests)


def _lane_name(data: ReportData, lane: int) -> str:
    """Return the name of a lane, where its traffic is known, and its number on the plan."""
    lanes = data.traffic.by_lane if data.traffic else pd.DataFrame(columns=["lane", "name"])
    named = lanes.loc[lanes["lane"] == lane, "name"]
    return f"{named.iloc[0]} ({lane})" if len(named) else str(lane)


def as_high_as(table: pd.DataFrame) -> list[str]:
    """Return the ranked lanes that may be as high as the first: within the error of both."""
    ranked = table[table["rank"] > 0]
    if len(ranked) < 2:
        return []
    top, others = ranked.iloc[0], ranked.iloc[1:]
    apart = top["share"] - others["share"]
    near = apart <= np.hypot(top["share_se"], others["share_se"].to_numpy(np.float64))
    return [str(lane) for lane in others.loc[near, "lane"]]


def basis_of(data: ReportData) -> Table:
    """Return the table of what the report rests on, and what follows from it."""
    rows = [
        recorded_row(data), _seen_row(data), *_tracked_rows(data), *_counted_rows(data),
        *_ranked_rows(data), _placed_row(data.results), _hidden_row(data.results),
        _delivered_row(data), _sources_row(data.results),
    ]  # fmt: skip
    columns = text_columns(tr("What"), tr("Here"), tr("What follows"))
    caption = tr("What the figures of this report rest on")
    return Table(name="basis", caption=caption, columns=columns, rows=rows)


def recorded_row(data: ReportData) -> list[str]:
    """Return how much was recorded, and what it holds for.

    Parameters
    ----------
    data : ReportData
        Data of the report.

    Returns
    -------
    list of str
        Title, seconds by sensor, and what follows, in the current language.
    """
    runs = recorded_runs(data.results)
    by_sensor = [f"{name} {seconds_text(part.steps * STEP_S)}" for name, part in runs.items()]
    seconds = recorded_s(data.results)
    value = seconds_text(seconds) + (f" ({', '.join(by_sensor)})" if len(by_sensor) < 13 else "")
    follows = tr("Holds for this time, and not for other hours or days.")
    if seconds < _SHORT_S:
        follows = tr("A few cycles of a signal: nothing about a usual hour or day.")
    elif round(seconds) < DAY_S:  # the last frame ends a day some milliseconds early
        follows = tr("Less than a day: nothing about the hours that were not recorded.")
    return [tr("Recorded"), f"{value}; {data.clock.name}", follows]


def _seen_row(data: ReportData) -> list[str]:
    total, measure = totals_of(data), data.results.heat.measure
    base = "visible" if measure == "occupancy" else "observed"
    part, whole = total[f"lane_length_{base}_m"], total["lane_length_m"]
    value = tr(
        "{part} of {all} m of lane ({share})",
        part=figure_text(part), all=figure_text(whole), share=percent(part / whole, 0),
    )  # fmt: skip
    text = "Road that no sensor saw has no value: it is hatched in grey, and is not 0 %."
    return [tr("Road seen"), value, tr(text)]


def _tracked_rows(data: ReportData) -> list[list[str]]:
    """Return what is known of vehicles, in reports of occupancy."""
    if data.results.heat.measure != "occupancy":
        return []
    total = totals_of(data)
    value, follows = tr(NOT_KNOWN), tr("How many vehicles the figures rest on is not known.")
    if "vehicles" in total:
        heavy = figure_text(total["heavy"])
        tracks = plural(total["vehicles"], "{n} track", "{n} tracks")
        value = tr("{tracks}, {heavy} of heavy vehicles", tracks=tracks, heavy=heavy)
        follows = tr("No count of vehicles: a track may be a piece of a vehicle's way.")
    return [[tr("Vehicles followed"), value, follows]]


def _counted_rows(data: ReportData) -> list[list[str]]:
    """Return a row with the reason if volumes, speeds, turns and queues are not in the report."""
    if data.traffic is not None:
        return []
    name = tr("Volumes, speeds, turns, queues")
    if not data.results.dataset.has_vehicles:
        text = "Vehicles were not looked for: this report has no volumes, speeds, turns or queues."
        return [[name, tr("none"), tr(text)]]
    return [[name, tr("none"), tr("No lane was visible in this time.")]]


def _ranked_rows(data: ReportData) -> list[list[str]]:
    """Return which lanes are compared, in reports of occupancy."""
    if data.results.heat.measure != "occupancy":
        text = "Hits compare one place over time; lanes are in the order of their numbers."
        return [[tr("Lanes compared"), tr("none"), tr(text)]]
    number, all_of_them = int(data.table["rank"].gt(0).sum()), len(data.table)
    value = tr("{part} of {all} lanes are ranked", part=number, all=all_of_them)
    return [[tr("Lanes compared"), value, tr("The table of lanes says by which rule.")]]


def _placed_row(results: Results) -> list[str]:
    """Return the standard deviations of the sensors' places and yaws."""
    texts = []
    for pose in results.poses:
        sigma = pose.parsed_evidence().sigma
        if {"easting", "northing", "yaw"} <= set(sigma):
            across = float(np.hypot(sigma["easting"], sigma["northing"]))
            turned = plus_minus(sigma["yaw"], 2, "°")
            texts.append(f"{pose.sensor} {plus_minus(across, 2, ' m')}, {turned}")
    value = "; ".join(texts) or tr(NOT_KNOWN)
    text = "What was measured may lie aside by that much; an angle of 1° is 1 m at 57 m."
    return [tr("Where sensors stand"), value, tr(text)]


def _hidden_row(results: Results) -> list[str]:
    """Return whether an airborne scan tells what hides the road."""
    if results.dataset.manifest.settings["sight"] == VIEW_ONLY:
        text = "Road behind houses and trees counts as seen and reads as empty."
        return [tr("What hides road"), tr("not known: no airborne scan"), tr(text)]
    text = "Road behind houses and trees counts as not seen; other vehicles hide it for moments."
    return [tr("What hides road"), tr("from an airborne scan"), tr(text)]


def _delivered_row(data: ReportData) -> list[str]:
    """Return in how many hours of sensors the tests of data quality found faults."""
    name = tr("What sensors delivered")
    if data.quality is None:
        return [name, tr(NOT_KNOWN), ""]
    table = data.quality.table
    good, hours = int(table["verdict"].eq(GOOD).sum()), len(table)
    value = tr("no fault in what was recorded")
    if good < hours:
        value = tr("faults in {bad} of {all} hours of sensors", bad=hours - good, all=hours)
    text = "An hour counts as soon as some of it was recorded: see the seconds in the table."
    return [name, value, tr(text)]


def _sources_row(results: Results) -> list[str]:
    sources = "; ".join(results.credits) or tr(NOT_KNOWN)
    return [
        tr("Map and data"),
        sources,
        tr("The lanes are those of the map; an error in it stays."),
    ]


def remarks_of(data: ReportData) -> list[str]:
    """Return the remarks at the top of the report, a sentence each."""
    results = data.results
    zone = data.clock.zone
    return [
        *(tr("No result for sensor {name}: {why}", name=name, why=tr(localised(why, zone)))
          for name, why in results.lost.items()),
        *(tr(each) for each in own_remarks(data)),
        *results.warnings,
        *([] if results.run else [tr(_NO_RUN)]),
    ]  # fmt: skip


def own_remarks(data: ReportData) -> list[Text]:
    """Return the remarks that the report itself adds: too short a time, faults of recordings."""
    begin, end = data.results.heat.whole.span()
    seconds = min(recorded_s(data.results), (end - begin).total_seconds())
    remarks = []
    if seconds < _SHORT_S:
        span = seconds_text(seconds)
        remarks.append(
            Text("Only {} were recorded: a few cycles of a signal, and no usual day", span)
        )
    if not data.results.warnings:  # else the run has warned
        remarks += [Text("{}", doubt) for doubt in data.results.dataset.doubts]
    if data.quality is not None:
        remarks += [
            Text("Sensor {}", localised(line, data.clock.zone)) for line in data.quality.warnings()
        ]
    return remarks
