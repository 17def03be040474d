"""Tables of a city's month: sites, the worst lanes, what changed, the health of the fleet."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup

from gis_radar.base import (
    NO_FIGURE,
    THIN_SPACE,
    Clock,
    figure_text,
    percent,
    plural,
    seconds_text,
    tr,
)
from gis_radar.calibration import HealthState
from gis_radar.city.odd_times import OddTime
from gis_radar.city.site_month import SiteMonth
from gis_radar.products import (
    LEAST_QUEUE_M,
    NOT_TOLD,
    Column,
    Table,
    change_rows,
    longest_queue_text,
    presumed_note,
    text_rows,
    with_verdicts,
)

_WORST_LANES = 20  # rows of the table
_MOST_CHANGES = 30  # rows of the table
_MOST_ODD = 20  # rows of the table
_MOST_NAMED = 6  # sensors of a state in a sentence


def site_table(sites: Sequence[SiteMonth], health: pd.DataFrame) -> Table:
    """Return what each site saw, those with the largest gaps first."""
    seen = health.groupby("site")["share"].min()
    ordered = sorted(sites, key=lambda each: (seen.get(each.name, 0.0), each.name))
    number = {each.name: place for place, each in enumerate(sites, start=1)}
    faulty = health[health["state"] != HealthState.WORKS].groupby("site").size()
    count = health.groupby("site").size()

    def sensors(site: SiteMonth) -> str:
        bad, of = int(faulty.get(site.name, 0)), int(count.get(site.name, 0))
        return tr("{n} of {all}", n=of - bad, all=of)

    def day(site: SiteMonth, *, is_weekend: bool) -> str:
        volume, error = site.day_volume(is_weekend=is_weekend)
        return value_with_error(volume, error)

    def hourly(site: SiteMonth) -> str:
        return value_with_error(*site.volume)

    columns = [
        Column(tr("Site"), "", _site_link, False),
        Column(tr("No."), tr("on the map"), lambda site: str(number[site.name])),
        Column(tr("Time with data"), tr("of the worst sensor"),
               lambda site: percent(float(seen.get(site.name, 0.0)), 0)),
        Column(tr("Sensors"), tr("that work"), sensors),
        Column(tr("Lanes"), tr("visible"), _lanes_seen),
        Column(tr("Mean occupancy"), tr("of visible time"),
               lambda site: share_with_error(*site.occupancy)),
        Column(tr("Volume"), tr("veh/h, time with data"), hourly),
        Column(tr("Monday to Friday"), tr("veh a day"), lambda site: day(site, is_weekend=False)),
        Column(tr("Saturday, Sunday"), tr("veh a day"), lambda site: day(site, is_weekend=True)),
    ]  # fmt: skip
    notes = [
        tr("Vehicles are counted once each: at the stop lines, else where lanes begin. ± is the "
           "standard error, rounded up; it holds what was not visible, but no error that all days "
           "share, such as vehicles that are always missed or followed as two: that one is mostly "
           "larger. A dash: not known, which is not 0; vehicles a day need all 24 hours."),
    ]  # fmt: skip
    return Table(
        name="sites", caption=tr("Sites, those with the largest gaps first"), columns=columns,
        rows=text_rows(ordered, columns), note=" ".join(notes),
    )  # fmt: skip


def _site_link(site: SiteMonth) -> str:
    if not site.link:
        return site.title
    return Markup('<a href="{}">{}</a>').format(site.link, site.title)


def _lanes_seen(site: SiteMonth) -> str:
    if site.lanes is None:
        return NO_FIGURE
    return f"{int((site.lanes['visible_share'] > 0.0).sum())}"


def worst_lanes(sites: Sequence[SiteMonth]) -> pd.DataFrame:
    """Return the lanes on which most time is lost, and where that is not known those that queue."""
    parts = [
        each.lanes[~each.lanes["is_inside"]].assign(site=each.title)
        for each in sites
        if each.lanes is not None
    ]
    if not parts:
        return pd.DataFrame()
    table = pd.concat(parts, ignore_index=True)
    lost = table["delay_s"].astype(float) * table["volume_veh_h"].astype(float) / 3600.0
    table = table.assign(lost_h=lost)
    slow = (lost > 0.0) | (table["queue_max_m"].astype(float) >= LEAST_QUEUE_M)
    order = ["lost_h", "queue_mean_m", "occupancy"]
    return table[slow].sort_values(order, ascending=False, na_position="last").head(_WORST_LANES)


def lane_rows(worst: pd.DataFrame) -> Table:
    """Return the table of the worst lanes for the page."""

    def off(name: str, error: str, digits: int) -> Callable[[pd.Series], str]:
        return lambda row: value_with_error(float(row[name]), float(row[error]), digits)

    columns = [
        Column(tr("Lane"), "", lambda row: f"{row['site']}: {row['name']}", False),
        Column(tr("Time lost"), tr("vehicle hours an hour"),
               lambda row: figure_text(float(row["lost_h"]), 1)),
        Column(tr("Delay"), tr("s a vehicle"), off("delay_s", "delay_se", 0)),
        Column(tr("Level of service"), "HCM",
               lambda row: row["level"] if isinstance(row["level"], str) else NO_FIGURE),
        Column(tr("Worst hour"), tr("Monday to Friday; delay"), _worst_hour),
        Column(tr("Mean queue"), "m", off("queue_mean_m", "queue_se", 1)),
        Column(tr("Longest queue"), "m", _queue_text),
        Column(tr("Mean occupancy"), tr("of visible time"),
               lambda row: share_with_error(row["occupancy"], row["occupancy_se"])),
        Column(tr("Volume"), tr("veh/h"), _volume_text),
    ]  # fmt: skip
    return Table(
        name="worst", caption=tr("Lanes on which most time is lost"), columns=columns,
        rows=text_rows((row for _, row in worst.iterrows()), columns),
        note=" ".join([tr(
            "Time lost is the delay times the volume. ± is the standard error: of delays and "
            "queues by how the days of the month differ, none of less than three days; of the "
            "others by what was not seen. Delays count from the free speed as stated, so an error "
            "of that is in all of them. Nothing follows about why vehicles wait."
        ), *presumed_note(worst)]),
    )  # fmt: skip


def _worst_hour(row: pd.Series) -> str:
    if pd.isna(row["worst_hour"]):
        return NO_FIGURE
    hour, delay_s = int(row["worst_hour"]), figure_text(float(row["worst_delay_s"]))
    return tr("{begin} to {end} h: {delay} s", begin=hour, end=hour + 1, delay=delay_s)


def value_with_error(value: float, error: float, digits: int = 0) -> str:
    """Return a value with its standard error, rounded up, so that only an error of 0 reads as 0."""
    text = figure_text(value, digits)
    if not (np.isfinite(value) and np.isfinite(error)):
        return text
    unit = 10.0**-digits
    return f"{text}{THIN_SPACE}±{THIN_SPACE}{figure_text(np.ceil(error / unit) * unit, digits)}"


def share_with_error(share: float, error: float) -> str:
    """Return a share as percent with its standard error, rounded up as well."""
    return percent(share, error=np.ceil(error * 1000.0) / 1000.0)


def _queue_text(row: pd.Series) -> str:
    return NO_FIGURE if pd.isna(row["queue_max_m"]) else longest_queue_text(row)


def _volume_text(row: pd.Series) -> str:
    if pd.isna(row["volume_veh_h"]):
        return NO_FIGURE
    relative = row["volume_se"] / row["volume"] if row["volume"] > 0.0 else 0.0
    return value_with_error(row["volume_veh_h"], row["volume_veh_h"] * relative)


def changes_of(sites: Sequence[SiteMonth]) -> pd.DataFrame:
    """Return all comparisons with the month before; verdicts hold for the whole city together."""
    parts = [each.changes for each in sites if each.changes is not None]
    return with_verdicts(pd.concat(parts, ignore_index=True)) if parts else pd.DataFrame()


def change_table(changes: pd.DataFrame, sites: Sequence[SiteMonth]) -> Table:
    """Return what changed against the month before: whole sites first, then by certainty."""
    titles = {each.name: each.title for each in sites}
    significant = changes[changes["verdict"] != NOT_TOLD] if len(changes) else changes
    rows = []
    if len(significant):
        significant = significant.assign(
            name=significant["site"].map(titles) + ": " + significant["name"],
            is_lane=significant["lane"].notna(),
        )
        significant = significant.sort_values(["is_lane", "p_corrected"], kind="stable")
        rows = [
            *change_rows(significant[~significant["is_lane"]]),
            *change_rows(significant[significant["is_lane"]]),
        ]
    columns = [
        Column(tr("Lane"), "", lambda row: row["name"], False),
        Column(tr("Measure"), "", lambda row: row["measure"], False),
        Column(tr("Month before"), "", lambda row: row["before"]),
        Column(tr("This month"), "", lambda row: row["after"]),
        Column(tr("Difference"), tr("95 % interval"), lambda row: row["difference"]),
        Column(tr("What it means"), "", lambda row: row["words"], False),
        Column(tr("Rests on"), "", lambda row: row["units"], False),
    ]
    return Table(
        name="changes", caption=tr("What changed against the month before"), columns=columns,
        rows=text_rows(rows[:_MOST_CHANGES], columns),
        note=" ".join(_change_notes(changes, sites, len(rows))),
    )  # fmt: skip


def _change_notes(changes: pd.DataFrame, sites: Sequence[SiteMonth], differences: int) -> list[str]:
    with_both = sum(each.changes is not None for each in sites)
    if not with_both:
        return [tr("No site has enough data in both months that the same sensors saw alike.")]
    lanes = changes[["site", "lane"]].dropna().drop_duplicates()
    notes = [
        tr("Only what the same sensors saw alike in both months: {lanes} lanes of {sites} sites. A "
           "difference is told where chance gives one in the whole city in less than 5 % of "
           "months.", lanes=figure_text(len(lanes)), sites=figure_text(with_both)),
    ]  # fmt: skip
    if not differences:
        notes.insert(0, tr("No difference is told."))
    if differences > _MOST_CHANGES:
        notes.append(
            tr("Here are {part} of {all} differences.", part=_MOST_CHANGES, all=differences)
        )
    if left_out := sum(each.not_alike for each in sites):
        notes.append(
            plural(left_out, "{n} lane was not seen alike.", "{n} lanes were not seen alike.")
        )
    return notes


def odd_table(sites: Sequence[SiteMonth], clock: Clock) -> Table | None:
    """Return the hours in which far more time was lost than usual, the most first."""
    found = [(site, each) for site in sites for each in site.odd_times]
    found.sort(key=lambda pair: -pair[1].beyond_h)

    def lane(pair: tuple[SiteMonth, OddTime]) -> str:
        site, odd = pair
        assert site.lanes is not None  # noqa: S101 - it has lost time
        names = site.lanes.set_index("lane")["name"]
        return str(names.get(odd.lane, NO_FIGURE))

    columns = [
        Column(tr("Site"), "", lambda pair: pair[0].title, False),
        Column(tr("From"), "", lambda pair: clock.stamp(pair[1].begin.to_pydatetime()), False),
        Column(tr("Until"), "", lambda pair: clock.stamp(pair[1].end.to_pydatetime()), False),
        Column(tr("Time lost"), tr("vehicle hours"),
               lambda pair: figure_text(pair[1].lost_h, 1)),
        Column(tr("Usual"), tr("vehicle hours"), lambda pair: figure_text(pair[1].usual_h, 1)),
        Column(tr("Most of it"), tr("lane"), lane, False),
    ]  # fmt: skip
    note = tr(
        "Hours with at least 1.5 times the usual time lost that are also over one vehicle hour, "
        "and over six standard deviations of such hours, above the usual; neighbouring hours "
        "belong to them from half of that on. Usual is the median of the month at that hour, over "
        "Mondays to Fridays or over weekends, of at least four days. All visible lanes with a free "
        "speed count, so a sensor that moved can look like this, too."
    )
    if len(found) > _MOST_ODD:
        note += " " + tr("Here are {part} of {all}.", part=_MOST_ODD, all=len(found))
    if not found:
        return None
    return Table(
        name="odd", caption=tr("Hours with far more time lost than usual"), columns=columns,
        rows=text_rows(found[:_MOST_ODD], columns), note=note,
    )  # fmt: skip


def health_table(health: pd.DataFrame, sites: Sequence[SiteMonth], clock: Clock) -> Table:
    """Return the table of sensors for the page, worst first."""
    titles = {each.name: each.title for each in sites}

    def when(moment: pd.Timestamp) -> str:
        return NO_FIGURE if pd.isna(moment) else clock.stamp(moment.to_pydatetime())

    def gap(row: pd.Series) -> str:
        if pd.isna(row["gap_s"]):
            return NO_FIGURE
        return tr(
            "{time} from {begin}", time=seconds_text(row["gap_s"]), begin=when(row["gap_begin"])
        )

    columns = [
        Column(tr("Sensor"), "", lambda row: f"{titles[row['site']]}: {row['sensor']}", False),
        Column(tr("State"), "", lambda row: tr(row["state"]), False),
        Column(tr("Since"), "", lambda row: when(row["since"]), False),
        Column(tr("Time with data"), tr("of the month"), lambda row: percent(row["share"], 0)),
        Column(tr("Longest gap"), "", gap, False),
        Column(tr("What is known"), "", lambda row: row["reasons"] or NO_FIGURE, False),
    ]
    works = int((health["state"] == HealthState.WORKS).sum())
    return Table(
        name="health", caption=tr("Sensors, worst first"), columns=columns,
        rows=text_rows((row for _, row in health.iterrows()), columns),
        note=tr(
            "{n} of {all} sensors work: with data for 95 % of the month or more, without a gap "
            "over an hour, at one place, with a pose and a clock that fit.",
            n=works, all=len(health),
        ),
    )  # fmt: skip


def sensor_faults(health: pd.DataFrame, sites: Sequence[SiteMonth], clock: Clock) -> list[str]:
    """Return a sentence for each faulty state with its sensors and since when, worst first."""
    titles = {each.name: each.title for each in sites}
    sentences = []
    for state, rows in health[health["state"] != HealthState.WORKS].groupby("state", sort=False):
        names = []
        for _, row in rows.head(_MOST_NAMED).iterrows():
            name = f"{titles[row['site']]} {row['sensor']}"
            if pd.notna(row["since"]):
                time = clock.stamp(row["since"].to_pydatetime())
                name = tr("{sensor} (since {time})", sensor=name, time=time)
            names.append(name)
        more = tr(" and {n} more", n=len(rows) - _MOST_NAMED) if len(rows) > _MOST_NAMED else ""
        sentences.append(f"{tr('Sensors')}, {tr(str(state))}: {', '.join(names)}{more}")
    return sentences
