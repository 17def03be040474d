"""Make a simulated city: sites drawn at random, their measured hours, and months drawn from these.

    python tools/simulated_city.py out/city --sites 20 --months 2

`CITY.toml` there names the sites, each with map, scan, recordings, poses and `SITE.toml`; `root`
has a dataset for each. Sites and months that are there already stay.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

sys.path.insert(0, str(Path(__file__).parents[1]))

import gis_radar as gr
from gis_radar.calibration import Finding
from simulation.city import (
    CITY,
    KNOCKED_AT,
    KNOCKED_DEG,
    MEASURED_DAY,
    TIMEZONE,
    CitySite,
    city_sites,
    make_site,
    write_city_file,
)
from simulation.drawn_days import DayDrawer, DrawnEvents, add_finding
from simulation.measured_minutes import PART_S, MeasuredParts

REMARK = (
    "SIMULATED, AND NOT MEASURED: {begin} to {end}. Each quarter of an hour of that time is a sum "
    "of {part_s} s parts, drawn at random from those measured on {day}."
)
README = """\
{city}: a simulated city of {sites} sites, to try gis_radar with. Nobody drives there.

sites/NAME   map, scan, recordings of {minutes:g} min a level of demand, true poses, SITE.toml
CITY.toml    names them all: gis-radar run CITY.toml
root         a dataset a site: the hours measured on {day}, and drawn months

The months before {day} were NOT MEASURED. Each quarter of an hour is a sum of measured parts of a
minute, drawn at random from the level of demand wanted then; see simulation/drawn_days.py. There:
{events}
"""
_TIME = "%Y-%m-%d %H:%MZ"
# Events by index of the site: a sensor that delivers nothing; a jam at the first site; demand as a
# share of the usual from a day on.
SILENT = {
    1: ("R1", datetime(2026, 10, 8, 9, tzinfo=UTC), datetime(2026, 10, 9, 6, tzinfo=UTC)),
    4: ("R2", datetime(2026, 10, 20, 14, tzinfo=UTC), datetime(2026, 10, 23, 8, tzinfo=UTC)),
}
JAM = (datetime(2026, 10, 14, 13, 30, tzinfo=UTC), datetime(2026, 10, 14, 16, 15, tzinfo=UTC))
SHARES = {3: {date(2026, 10, 1): 0.7}, 5: {date(2026, 10, 1): 1.25}}


def main(arguments: Sequence[str]) -> None:
    """Make the city, site by site."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sites", type=int, default=20)
    parser.add_argument("--months", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=2.0, help="length of each recording")
    parser.add_argument("--seed", type=int, default=1)
    known = parser.parse_args(arguments)
    sites = city_sites(known.folder, known.sites, seed=known.seed)
    root = known.folder / "root"
    root.mkdir(parents=True, exist_ok=True)
    for k, site in enumerate(sites):
        if not site.site_file.is_file():
            make_site(site, minutes=known.minutes, seed=1000 * known.seed + k)
        folder = root / f"site={site.name}"
        if not folder.is_dir():
            part = folder.with_name(f".{folder.name}.part")
            shutil.rmtree(part, ignore_errors=True)  # of a call that was broken off
            draw(measured(site, site.sensors, part), site, k, known)
            part.rename(folder)
        print(f"{k + 1}/{len(sites)} {site.name}: {', '.join(site.sensors)}", flush=True)
    write_city_file(known.folder, sites)
    write_readme(known.folder, sites, known.minutes)
    print(f"{known.folder}: its months were drawn from measured minutes, not measured")


def measured(site: CitySite, sensors: Sequence[str], folder: Path) -> gr.Dataset:
    """Measure the dataset of some sensors of a site."""
    tiles = gr.make_tiles(gr.read_map(site.folder / "map.osm", crs="EPSG:25832"))
    pairs = [(sensor, level) for sensor in sensors for level in site.levels]
    return gr.measure(
        [site.recording(*pair) for pair in pairs], [site.pose_file(name) for name, _ in pairs],
        tiles, site.folder / "map.osm", folder, scans=site.folder / "scan.laz", timezone=TIMEZONE,
        accept=sensors,
    )  # fmt: skip


def draw(dataset: gr.Dataset, site: CitySite, number: int, known: argparse.Namespace) -> None:
    """Draw the months before the measured day, with the events of the site."""
    zone = ZoneInfo(TIMEZONE)
    end = datetime(MEASURED_DAY.year, MEASURED_DAY.month, 1, tzinfo=zone)
    begin = end
    for _ in range(known.months):
        begin = (begin - timedelta(days=1)).replace(day=1)
    silent = {SILENT[number][0]: SILENT[number][1:]} if number in SILENT else {}
    events = DrawnEvents(
        jam=JAM if number == 0 else None, silent=silent, shares=SHARES.get(number, {})
    )
    heard = {frozenset(site.sensors) - {*silent}, frozenset(site.sensors)} - {frozenset()}
    drawer = DayDrawer(
        dataset=dataset, parts=parts_of(dataset, site, heard, known.minutes),
        demands=[level.demand for level in site.levels], events=events, seed=known.seed + number,
    )  # fmt: skip
    remark = REMARK.format(
        begin=f"{begin:%Y-%m-%d}", end=f"{end - timedelta(days=1):%Y-%m-%d}", part_s=PART_S,
        day=f"{MEASURED_DAY:%Y-%m-%d}",
    )  # fmt: skip
    drawn = drawer.draw(begin.astimezone(UTC), end.astimezone(UTC), remark=remark)
    if site.knocked:
        cause = f"it was knocked on {KNOCKED_AT:%Y-%m-%d}: its yaw changed by {KNOCKED_DEG:g} deg"
        evidence = drawn.manifest.findings[site.knocked].evidence
        add_finding(
            drawn,
            Finding(
                sensor=site.knocked, verdict="fits", evidence=evidence, cause=cause,
                advice="find its pose again",
            ),
        )  # fmt: skip


def parts_of(
    dataset: gr.Dataset, site: CitySite, heard: set[frozenset[str]], minutes: float
) -> Mapping[frozenset[str], MeasuredParts]:
    """Return the measured parts by the sensors that deliver, measured with these alone."""
    begins = [level.begin for level in site.levels]
    count, found = int(minutes * 60.0) // PART_S, dict[frozenset[str], MeasuredParts]()
    for sensors in heard:
        aside = dataset.folder.with_name(f".{site.name}.part")
        is_whole = sensors == frozenset(site.sensors)
        mine = dataset if is_whole else measured(site, sorted(sensors), aside)
        found[sensors] = MeasuredParts.of(mine, begins, count)
        shutil.rmtree(aside, ignore_errors=True)
    return found


def write_readme(folder: Path, sites: Sequence[CitySite], minutes: float) -> None:
    """Write `README.txt`: what the city is, and its events."""
    events = [(sites[0], f"an incident, {JAM[0]:{_TIME}} to {JAM[1]:{_TIME}}")]
    for k, site in enumerate(sites):
        if k in SILENT:
            sensor, begin, end = SILENT[k]
            events.append((site, f"{sensor} fails, {begin:{_TIME}} to {end:{_TIME}}"))
        if site.knocked:
            events.append((site, f"{site.knocked} is knocked, {KNOCKED_AT:{_TIME}}"))
        for day, share in SHARES.get(k, {}).items():
            events.append((site, f"{share:.0%} of the usual demand since {day}"))
    text = README.format(
        city=CITY, sites=len(sites), minutes=minutes, day=f"{MEASURED_DAY:%Y-%m-%d}",
        events="\n".join(f"- {site.name}: {text}" for site, text in events),
    )  # fmt: skip
    (folder / "README.txt").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
