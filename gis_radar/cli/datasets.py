"""The commands about a dataset: traffic, compare, query, publish, dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar import base, measures, products
from gis_radar import dataset as dataset_room
from gis_radar.base import Reporter, Text, UsageError
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import DURATION, FILE, begin_end, csv_locale, folder_output, language
from gis_radar.cli.options import dataset as dataset_argument

_TOO_SHORT = Text(
    "no interval was visible for a fifth of its length, which a volume needs: "
    "take a shorter interval"
)
_NO_STOP_LINES = Text(
    "the map has no stop line on the lanes in sight: queues are measured from presumed ones "
    "before junctions, cycles and levels of service are not known (draw each as a way of type "
    "stop_line across its lane)"
)
_SERVICE_INTERVAL = "15min"
_OTHER_LEVELS = "levels of service are of 15 minutes in the handbook, here of {}"
DAY_S = 86_400.0
_DIGITS = 4  # of numbers in a profile as CSV: far below their errors
several_sites = click.argument("folder", metavar="DATASET|CITY", type=FILE)


def _dataset_or_city(folder: Path, reporter: Reporter) -> gr.Dataset | gr.City:
    """Open a dataset, or a folder with a dataset a site."""
    if products.is_city(folder):
        return gr.open_city(folder, reporter=reporter)
    return gr.open_dataset(folder, reporter=reporter)


@command(example="gis-radar traffic dataset/ --interval 15min -o traffic/")
@dataset_argument
@folder_output
@click.option(
    "--interval", default="15min", show_default=True,
    help="Length of the intervals: 1min, 5min, 15min, 1h, 24h; they follow the site's clocks.",
)  # fmt: skip
@begin_end
@click.option(
    "--sections", type=FILE, help="Lines across roads, at which vehicles are counted by direction."
)
@click.option(
    "--counts", "hand_counts", type=FILE,
    help="CSV of counts by hand to put beside: section or lane, direction, begin, end, volume.",
)  # fmt: skip
@click.option("--headways", is_flag=True, help="Add headways and gaps to the lanes.")
@click.option("--cycles", is_flag=True, help="Find the cycles of signals from the traffic.")
@click.option(
    "--signals", type=FILE,
    help="CSV of green times (lane, green_begin, green_end): figures for each of these cycles.",
)  # fmt: skip
@click.option(
    "--service", type=click.Choice(["hcm"]),
    help="Add levels of service from the delay: Highway Capacity Manual.",
)  # fmt: skip
@click.option(
    "--datex", metavar="CC:NAME",
    help="Write DATEX II files, too, published by this country and name: 'DE:City of Example'.",
)  # fmt: skip
@click.option(
    "--sumo-net", type=FILE,
    help="Network of SUMO (.net.xml), whose edges the files for SUMO then name.",
)  # fmt: skip
@language("Of the lanes' names and the titles.")
@csv_locale
def traffic(
    *, folder: Path, output: Path, datex: str | None, language: str, csv_locale: str,
    reporter: Reporter, **options: Any,
) -> Result:  # fmt: skip
    """Count traffic by lane and turn: volumes, speeds, queues; tables, layers, SUMO, DATEX II."""
    if datex is not None:
        products.publisher_of(datex)  # refuses a wrong one before the work
    measured = gr.open_dataset(folder, reporter=reporter)
    made = gr.make_traffic(measured, language=language, reporter=reporter, **options)
    with base.csv_for(csv_locale):
        outputs = made.write(output, datex=datex, language=language, reporter=reporter)
    figures = made.figures()
    if not figures["rows_with_volume"]:
        reporter.warn(_TOO_SHORT)
    if not made.lanes["stop_line"].eq(measures.DRAWN).any():
        reporter.log(_NO_STOP_LINES)
    elif options["service"] is not None and options["interval"] != _SERVICE_INTERVAL:
        reporter.log(Text(_OTHER_LEVELS, options["interval"]))
    return Result(outputs=outputs, summary=figures, timezone=measured.timezone)


@command(
    example="gis-radar compare dataset/ --before 2026-09-07/2026-09-21 "
    "--after 2026-10-05/2026-10-19 --days Mo-Fr -o compared/"
)
@dataset_argument
@click.argument("other", metavar="[DATASET2]", type=FILE, required=False)
@folder_output
@click.option("--before", metavar="T/T", help="The first period, such as 2026-09-07/2026-09-21.")
@click.option("--after", metavar="T/T", help="The second period; of DATASET2, where it is given.")
@click.option("--days", help="Only these days of the week, such as Mo-Fr or Sa,Su.")
@language("Of the page, the lanes' names and the titles.")
@csv_locale
def compare(
    *, folder: Path, other: Path | None, output: Path, before: str | None, after: str | None,
    csv_locale: str, language: str, days: str | None, reporter: Reporter,
) -> Result:  # fmt: skip
    """Compare the traffic of two periods by lane: what changed, and how sure that is."""
    if other is None and (before is None or after is None):
        raise UsageError(
            "a period is missing", hint="name both, before and after, or a second dataset"
        )
    first = gr.open_dataset(folder, reporter=reporter)
    second = None if other is None else gr.open_dataset(other, reporter=reporter)
    all_time = (None, None)
    found = gr.compare(
        first, second, before=all_time if before is None else before,
        after=all_time if after is None else after, days=days, language=language,
    )  # fmt: skip
    for line in found.doubts:
        reporter.warn(line)
    with base.csv_for(csv_locale):
        outputs = found.write(output, language=language, reporter=reporter)
    return Result(outputs=outputs, summary=found.figures(), timezone=first.timezone)


@command(
    example='gis-radar query results/dataset "SELECT tile_id, sum(hit_steps) AS hits '
    'FROM tile_counts GROUP BY tile_id ORDER BY hits DESC LIMIT 10"'
)
@several_sites
@click.argument("sql", metavar="[SELECT]", required=False)
@click.option(
    "--catalogue", type=FILE,
    help="Of a city: write the views of its tables for DuckDB, which opens them from any folder.",
)  # fmt: skip
@click.option("-o", "--output", type=FILE, help="Write the whole answer: .csv or .parquet.")
@click.option(
    "--limit", type=click.IntRange(1, 10**9), default=1000, show_default=True,
    help="How many rows are shown.",
)  # fmt: skip
@click.option(
    "--timeout", "timeout_s", type=DURATION, default="60s", show_default=True,
    help="After how long the question is given up.",
)  # fmt: skip
@click.option(
    "--memory", default="2GB", show_default=True, help="How much memory the question may take."
)
def query(
    *, folder: Path, sql: str | None, catalogue: Path | None, output: Path | None, limit: int,
    reporter: Reporter, **options: Any,
) -> Result:  # fmt: skip
    """Ask a dataset or a city in SQL (DuckDB): one SELECT over its tables; no files, no network."""
    source = _dataset_or_city(folder, reporter)
    if catalogue is not None:
        if sql is not None or isinstance(source, gr.Dataset):
            raise UsageError("--catalogue is of a city, and without a question")
        source.write_catalogue(catalogue)
        return Result(outputs=[catalogue])
    if sql is None:
        raise UsageError("the question is missing", hint='such as "FROM lane_measures LIMIT 10"')
    options |= {"reporter": reporter}
    if output is None:
        rows, total = source.first_rows(sql, limit, **options)
        return Result(outputs=[], summary={"total": total}, rows=rows)
    return Result(outputs=[output], summary={"total": source.write_answer(sql, output, **options)})


@command(
    example="gis-radar profile city/ --street Ostring --by hour --days Mo-Fr --month 2026-10 "
    "--without holidays.csv"
)
@several_sites
@click.option("--street", help="Name of a street; by default all.")
@click.option(
    "--by", type=click.Choice(["hour", "weekday", "month"]), default="hour", show_default=True,
    help="What a row is, by the clocks of the site.",
)  # fmt: skip
@click.option("--days", help="Only these days of the week, such as Mo-Fr or Sa,Su.")
@click.option("--month", help="Only this month, such as 2026-10.")
@begin_end
@click.option(
    "--without", metavar="HOLIDAYS",
    help="Days that do not count: 2026-10-12/2026-10-23,2026-11-01 or a CSV file with a column "
    "date, or begin and end.",
)  # fmt: skip
@click.option("-o", "--output", type=FILE, help="Write the table as .csv.")
@language("Of the directions.")
@csv_locale
def profile(
    *, folder: Path, output: Path | None, csv_locale: str, reporter: Reporter, **options: Any
) -> Result:
    """Return the usual traffic of streets by hour of the day, day of the week, or month."""
    if output is not None and output.suffix.lower() != ".csv":
        raise UsageError("{}: a profile is written as .csv", output)
    found = _dataset_or_city(folder, reporter).profile(**options)
    summary, names = {"total": len(found)}, list(map(str, found))
    if output is not None:
        with base.csv_for(csv_locale), base.atomic_write(output) as part:
            base.write_csv(part, found.round(_DIGITS))
        return Result(outputs=[output], summary=summary)
    values = found.astype(object).where(found.notna(), None).to_numpy().tolist()
    rows = [dict(zip(names, each, strict=True)) for each in values]
    return Result(outputs=[], summary=summary, rows=rows)


@command(example="gis-radar publish results/dataset postgresql://editor@db.example.org/traffic")
@dataset_argument
@click.argument("url", metavar="DATABASE")
@click.option(
    "--schema", default="gis_radar", show_default=True,
    help="Schema that holds the tables: one for each site. Of a city, the one of all sites.",
)  # fmt: skip
@click.option("--reader", metavar="ROLE", help="A role that may read the tables, nothing more.")
def publish(
    *, folder: Path, url: str, schema: str, reader: str | None, reporter: Reporter
) -> Result:  # fmt: skip
    """Publish a dataset, or all of a city's, in PostGIS; only what changed is sent."""
    verb = gr.publish_city if products.is_city(folder) else gr.publish
    done = verb(folder, url, schema=schema, reader=reader, reporter=reporter)
    return Result(outputs=[], summary=done.figures())


@command(example="gis-radar dataset results/dataset")
@dataset_argument
@click.option(
    "--check",
    is_flag=True,
    help="Compare all bytes with the digests of their hours; read the other files.",
)
@click.option(
    "--withdraw", metavar="RECORDING", multiple=True,
    help="Take a recording out, and make its hours again without it; repeatable.",
)  # fmt: skip
@click.option(
    "--withdraw-sensor", "sensor", metavar="SENSOR", help="Take all recordings of a sensor out."
)
@click.option(
    "--withdraw-day", "day", metavar="DATE",
    help="Take all recordings of a day out, such as 2026-10-05; with a sensor, only its own.",
)  # fmt: skip
@click.option(
    "--keep", "keep_s", type=DURATION, metavar="TIME",
    help="Delete the exact tables of hours longer ago, such as 30d; counts and traffic stay.",
)  # fmt: skip
@click.option(
    "--relink", metavar="FOLDER", type=FILE, help="Find recordings that were moved, by content."
)
@click.option(
    "--site", type=FILE, metavar="SITE.toml",
    help="Take names and free speeds of lanes from it, in place of those before; streets stay.",
)  # fmt: skip
@click.option(
    "--match-lanes", "new_map", metavar="NEW", type=FILE,
    help="Match its lanes to those of a new map (a dataset or tiles.gpkg); write the table to -o.",
)  # fmt: skip
@click.option("-o", "--output", type=FILE, help="The table of matched lanes (CSV).")
def dataset(
    *, folder: Path, check: bool, withdraw: tuple[str, ...], sensor: str | None, day: str | None,
    keep_s: float | None, relink: Path | None, site: Path | None, new_map: Path | None,
    output: Path | None, reporter: Reporter,
) -> Result:  # fmt: skip
    """Say what a dataset holds: recordings, hours, rows by table."""
    if (new_map is None) != (output is None):
        raise UsageError("{} and {} go together", "--match-lanes NEW", "-o FILE")
    found, done = gr.open_dataset(folder, reporter=reporter), dict[str, Any]()
    if relink is not None:
        done["recordings_found"] = found.relink(relink, reporter=reporter)
    if withdraw or sensor is not None or day is not None:
        withdrawn = found.withdraw(withdraw, sensor=sensor, day=day, reporter=reporter)
        done["withdrawn"] = [Path(each).name for each in withdrawn]
    if keep_s is not None:
        done["hours_deleted"] = len(found.keep(keep_s / DAY_S, reporter=reporter))
    if site is not None:
        found = found.state_lanes(
            **gr.read_site(site).of_lanes, streets=found.lanes(), reporter=reporter
        )
    if check:
        found.check(reporter)
    if new_map is not None and output is not None:
        done |= _matched(found, new_map, output)
    outputs = [] if output is None else [output]
    return Result(outputs=outputs, summary=done | found.figures(), timezone=found.timezone)


def _matched(old: gr.Dataset, new: Path, output: Path) -> dict[str, int]:
    """Write the matches of a dataset's lanes with those of a new map; return how many changed."""
    table = gr.match_lanes(old, new)
    dataset_room.write_lane_matches(table, output)
    same = table["same"]
    removed, added = (int(table[side].isna().sum()) for side in ("new_lane", "old_lane"))
    changed = table.loc[~same & table["new_lane"].notna(), "old_lane"].nunique()
    return {
        "lanes_the_same": int(same.sum()), "lanes_changed": int(changed), "lanes_gone": removed,
        "lanes_new": added,
    }  # fmt: skip
