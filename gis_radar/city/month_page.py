"""The page of a city's month: one file of all sites, their lanes, and the health of the fleet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gis_radar.base import (
    QUIET,
    THIN_SPACE,
    Clock,
    Floats,
    GisRadarError,
    InputError,
    Reporter,
    UsageError,
    atomic_write,
    class_label,
    current_language,
    figure_text,
    folder_to_fill,
    in_language,
    known_language,
    percent,
    step_begin,
    tr,
    zone_of,
)
from gis_radar.calibration import HealthState
from gis_radar.city.city import RESULTS, City, open_city
from gis_radar.city.executors import Workers, workers_of
from gis_radar.city.health import health_of, worst_first
from gis_radar.city.month import CityMonth, month_of
from gis_radar.city.month_map import draw_city
from gis_radar.city.month_tables import (
    change_table,
    changes_of,
    health_table,
    lane_rows,
    odd_table,
    sensor_faults,
    share_with_error,
    site_table,
    worst_lanes,
)
from gis_radar.city.site_month import SiteMonth, occupancy_of_lanes, site_month
from gis_radar.products import (
    NOT_TOLD,
    Fact,
    Report,
    Strip,
    colour_classes,
    made_by,
    read_run,
    render_page,
    strip_of,
)

MONTH_PAGE = "month.html"
_PROFILES = 12  # sites whose profiles are drawn
_HOURS = 24
_MANY_SITES = 6  # from so many sites on, processes save more time than their start takes
_TOPS = (50, 100, 200, 300, 500, 750, 1000, 1500, 2000, 3000, 5000, 7500, 10_000)  # veh/h


class Profile(NamedTuple):
    """The volume of a site by the hour of the day, as the page draws it.

    Parameters
    ----------
    name : str
        The site.
    top : str
        The highest value of its scale.
    weekdays, weekend : Strip
        Lines and bands.
    words : str
        Description of both, for screen readers.
    """

    name: str
    top: str
    weekdays: Strip
    weekend: Strip
    words: str


def write_month_page(
    root: str | Path | City,
    month: str | None = None,
    *,
    output: str | Path | None = None,
    title: str | None = None,
    timezone: str | None = None,
    language: str | None = None,
    workers: Workers | None = None,
    reporter: Reporter = QUIET,
) -> Report:
    """Write the page of a city's month, `month.html`: one file that opens without a network.

    Parameters
    ----------
    root : str, Path or City
        The city.
    month : str
        The month, such as `2026-10`, by the clocks of each site.
    output : str or Path, optional
        Folder that the page goes to; by default that of the city.
    title : str, optional
        Name of the city; by default that of its run, else of its folder.
    timezone : str, optional
        Time zone of the page's times; by default that of its run, else that of most sites.
    language : str, optional
        `en` or `de`; by default that of its run, else of most sites' results, else `en`.
    workers : Workers, optional
        Workers that read the sites; by default processes of this machine, or this process where
        there are few sites.
    reporter : Reporter
        Receives progress, and a warning for each site that is left out.

    Returns
    -------
    Report
        The file and figures.

    Raises
    ------
    UsageError
        If there is no such month, time zone or language.
    InputError
        If the folder is no city, or no site has data of the month.
    OutputError
        If the page cannot be written.
    """
    city = open_city(root, reporter=reporter)
    chosen = month_of(city, month)
    if title is not None and not title.strip():
        raise UsageError("the title is empty", hint="leave it out, or give the name of the city")
    run = read_run(city.root)  # of the city's run, as its city file stated
    zones = Counter(each.timezone for each in city.sites.values())
    zone = timezone or run.get("timezone") or zones.most_common(1)[0][0]
    place = city.root if output is None else Path(output)
    with in_language(known_language(language or run.get("language") or _language_of(city))):
        first, last = chosen.span(next(iter(city.sites.values())))
        end = min(last, chosen.last_step) + 1
        clock = Clock(
            zone=zone_of(zone), first=step_begin(first), last=step_begin(end), to_seconds=False
        )
        sites, health, left_out = _sites(chosen, place.absolute(), workers, reporter)
        name = title or run.get("title") or city.root.resolve().name
        page, summary = _page(chosen, sites, health, clock, name, left_out)
    with folder_to_fill(place), atomic_write(place / MONTH_PAGE) as private:
        private.write_text(page, encoding="utf-8", newline="\n")
    return Report(outputs=[place / MONTH_PAGE], summary=summary)


def _language_of(city: City) -> str:
    """Return the language of most sites' results."""
    known = Counter[str]()
    for name in city.sites:
        with suppress(GisRadarError):  # its site is left out, and named
            site = read_run(city.root / RESULTS / name).get("site") or {}
            known.update([str(site["language"])] if site.get("language") else [])
    return known.most_common(1)[0][0] if known else "en"


def _sites(
    month: CityMonth, place: Path, workers: Workers | None, reporter: Reporter
) -> tuple[list[SiteMonth], pd.DataFrame, dict[str, str]]:
    """Gather the sites and the health of the fleet; a site that cannot be read is left out."""
    names, read = list(month.city.sites), dict[str, tuple[SiteMonth, pd.DataFrame]]()
    left_out = dict[str, str]()
    tasks = {name: (_site, month.of_site(name), name, place, current_language()) for name in names}
    for done, (name, site) in enumerate(_read(tasks, workers, reporter), start=1):
        if isinstance(site, GisRadarError):
            left_out[name] = str(site)
            reporter.warn("site {} is left out: {}", name, site)
        else:
            read[name] = site
        reporter.progress("reading the sites", done, len(names))
    if not read:
        why = next(iter(left_out.values()))
        raise InputError("{}: no site can be read: {}", month.city.root, why)
    sites, health = zip(*(read[name] for name in names if name in read), strict=True)
    return list(sites), worst_first(pd.concat(health, ignore_index=True)), left_out


def _read(
    tasks: Mapping[str, Sequence[Any]], workers: Workers | None, reporter: Reporter
) -> Iterator[tuple[str, Any]]:
    """Yield the result of each site's task, or its error, in the order in which they end."""
    if workers is not None:
        yield from workers.results(tasks)
    elif len(tasks) >= _MANY_SITES:
        with workers_of(None, None, reporter) as processes:
            yield from processes.results(tasks)
    else:
        for name, (work, *given) in tasks.items():
            try:
                yield name, work(*given)
            except GisRadarError as error:
                yield name, error


def _site(
    month: CityMonth, name: str, place: Path, language: str
) -> tuple[SiteMonth, pd.DataFrame]:
    """Return a site's month and the health of its sensors."""
    with in_language(language):
        return site_month(month, name, place), health_of(month, [name])


def _page(
    month: CityMonth, sites: Sequence[SiteMonth], health: pd.DataFrame, clock: Clock, title: str,
    left_out: dict[str, str],
) -> tuple[str, dict[str, Any]]:  # fmt: skip
    """Return the page, and its figures for the command line."""
    worst, changes = worst_lanes(sites), changes_of(sites)
    fault_counts = health[health["state"] != HealthState.WORKS].groupby("site").size()
    faulty = {str(name): int(number) for name, number in fault_counts.items()}
    facts = _facts(sites, health, worst)
    legend = [(each.colour, class_label(each.label, current_language()))
              for each in colour_classes("occupancy")]  # fmt: skip
    remarks = [
        *(tr("Site {name} is left out: {why}", name=name, why=tr(why))
          for name, why in left_out.items()),
        *_not_measured(sites), *_ends_early(month, sites, clock),
        *sensor_faults(health, sites, clock),
    ]  # fmt: skip
    text = files("gis_radar.city").joinpath("month_page.html.jinja").read_text(encoding="utf-8")
    city_map = draw_city(sites, faulty, legend)
    css = _rules(legend)
    page = render_page(
        text, css=css, title=title, subtitle=clock.long_span(clock.first, clock.last),
        zone=clock.name, facts=facts, remarks=remarks, map=city_map,
        sites=site_table(sites, health), worst=lane_rows(worst) if len(worst) else None,
        odd=odd_table(sites, clock), profiles=_profiles(sites),
        changes=change_table(changes, sites),
        health=health_table(health, sites, clock), made_by=made_by(),
    )  # fmt: skip
    significant = changes[changes["verdict"] != NOT_TOLD] if len(changes) else changes
    return page, {
        "title": title, "month": month.month, "timezone": str(clock.zone),
        "sites": len(sites), "sites_without_data": sum(each.lanes is None for each in sites),
        "sites_left_out": left_out, "sensors": len(health),
        "sensors_by_state": {str(n): int(v) for n, v in health["state"].value_counts().items()},
        "lanes_with_a_change": int(significant["lane"].notna().sum()) if len(significant) else 0,
        "odd_times": sum(len(each.odd_times) for each in sites),
        "facts": {fact.name: f"{fact.value} ({fact.rests})" for fact in facts},
        "remarks": remarks,
    }  # fmt: skip


def _not_measured(sites: Sequence[SiteMonth]) -> list[str]:
    """Return what the datasets state of hours that were not measured, with the sites of each."""
    titles: dict[str, list[str]] = {}
    for site in sites:
        if site.remark:
            titles.setdefault(site.remark, []).append(site.title)
    return [
        f"{remark} {tr('All sites.') if len(of) == len(sites) else ', '.join(of) + '.'}"
        for remark, of in titles.items()
    ]


def _ends_early(month: CityMonth, sites: Sequence[SiteMonth], clock: Clock) -> list[str]:
    """Return whether the data end before the month, and how many sites have none."""
    found = []
    if month.last_step < month.span(next(iter(month.city.sites.values())))[1]:
        found.append(tr("The newest data are of {time}: all is of the month up to then.",
                        time=clock.stamp(clock.last)))  # fmt: skip
    without = [each.title for each in sites if each.lanes is None]
    if without:
        found.append(tr("No data of this month: {names}", names=", ".join(without)))
    return found


def _facts(sites: Sequence[SiteMonth], health: pd.DataFrame, worst: pd.DataFrame) -> list[Fact]:
    """Return the figures at the top."""
    with_data = sum(each.lanes is not None for each in sites)
    works = int((health["state"] == HealthState.WORKS).sum())
    tables = [each.lanes for each in sites if each.lanes is not None]
    lanes = sum(int((each["volume"].notna() & ~each["is_inside"]).sum()) for each in tables)
    facts = [
        Fact(tr("Sites with data"), tr("{n} of {all}", n=with_data, all=len(sites)),
             tr("{n} lanes with a volume", n=figure_text(lanes))),
        Fact(tr("Sensors that work"), tr("{n} of {all}", n=works, all=len(health)),
             tr("with data for {share} of the month on average",
                share=percent(float(health["share"].mean()), 0))),
    ]  # fmt: skip
    mean = occupancy_of_lanes(pd.concat(tables)) if tables else (np.nan, np.nan)
    if np.isfinite(mean[0]):
        text = tr("mean of the sites' lanes, by time and length visible")
        facts.append(Fact(tr("Mean occupancy"), share_with_error(*mean), text))
    if len(worst):
        row = worst.iloc[0]
        lane = f"{row['site']}: {row['name']}"
        if pd.notna(row["lost_h"]):
            text = tr("vehicle hours an hour, by a delay of {delay} s a vehicle; {lane}",
                      delay=figure_text(float(row["delay_s"])), lane=lane)  # fmt: skip
            facts.append(Fact(tr("Most time lost"), figure_text(float(row["lost_h"]), 1), text))
        else:
            longest = f"{figure_text(float(row['queue_max_m']))}{THIN_SPACE}m"
            facts.append(Fact(tr("Longest queue"), longest, lane))
    return facts


def _profiles(sites: Sequence[SiteMonth]) -> list[Profile]:
    """Return the profiles of the sites with most vehicles, all on one scale."""
    with_profile = [each for each in sites if each.profile is not None
             and each.profile["volume"].notna().any()]  # fmt: skip
    with_profile = sorted(with_profile, key=lambda each: -np.nan_to_num(each.volume[0]))[:_PROFILES]
    tables = [each.profile for each in with_profile if each.profile is not None]
    high = max((float((t["volume"] + t["volume_se"]).max()) for t in tables), default=0.0)
    top = next((each for each in _TOPS if each >= high), high)
    edges = np.linspace(0.0, 1.0, _HOURS + 1)
    profiles = []
    for site, table in zip(with_profile, tables, strict=True):
        strips, words = [], []
        for is_weekend, name in ((False, tr("Monday to Friday")), (True, tr("Saturday, Sunday"))):
            of_days = table[table["is_weekend"] == is_weekend].sort_values("hour")
            volume, error = (of_days[n].to_numpy(np.float64) for n in ("volume", "volume_se"))
            strips.append(strip_of(name, edges, volume / top, error / top))
            words.append(f"{name}: {_peak(volume)}")
        words_of_all = f"{site.title}; " + "; ".join(words)
        profiles.append(Profile(site.title, figure_text(top), strips[0], strips[1], words_of_all))
    return profiles


def _peak(volume: Floats) -> str:
    if not np.isfinite(volume).any():
        return tr("not known")
    hour = int(np.nanargmax(volume))
    return tr("most from {begin} to {end} h, {n} vehicles an hour", begin=hour, end=hour + 1,
              n=figure_text(float(volume[hour])))  # fmt: skip


def _rules(legend: Sequence[tuple[str, str]]) -> str:
    """Return the page's own rules, and those of the classes' colours."""
    own = files("gis_radar.city").joinpath("month_page.css").read_text(encoding="utf-8")
    return own + "".join(
        f".class-{colour[1:]} {{ background: {colour}; fill: {colour}; }}\n" for colour, _ in legend
    )
