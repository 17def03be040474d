"""The commands for a whole site: run, report, qgis, sample, demo."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar import city, products
from gis_radar import site as site_room
from gis_radar.base import Reporter, Text, UsageError, atomic_folder, refuse_inputs
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import FILE, csv_locale, folder_output, language, output, template

_SAMPLE_KINDS = (".osm", ".laz", ".parquet", ".json", ".toml", ".md")


@command(example="gis-radar run SITE.toml -o results")
@click.argument("site", metavar="SITE.toml", type=FILE)
@folder_output
@click.option(
    "--jobs",
    type=int,
    help="Stages, or hours of a city, at once; by default as cores and memory allow.",
)
@click.option("--fresh", is_flag=True, help="Do all again, also what an earlier run has done.")
@click.option(
    "--executor", metavar="tcp://HOST:PORT",
    help="Let the workers of a Dask cluster do the work, for a city.",
)  # fmt: skip
@template(
    lambda: site_room.site_template(),  # noqa: PLW0108 - the room loads when it is asked
    "Print a site file to fill in, and do nothing else.",
)
@template(
    lambda: city.city_template(),  # noqa: PLW0108 - as above
    "Print a city file to fill in, and do nothing else.",
    name="--city-template",
)
def run(
    *, site: Path, output: Path, executor: str | None, fresh: bool, jobs: int | None,
    reporter: Reporter,
) -> Result:  # fmt: skip
    """Run all stages for all sensors of a site, or of all sites of a city (CITY.toml).

    It continues where an earlier run ended. Exit code 4: a sensor has no trustworthy pose; 3: its
    data are bad; the heat maps show the others.
    """
    if city.is_city_file(site):
        if fresh:
            raise UsageError(
                "{} is for one site", "--fresh", hint="remove the folder of a site to make it anew"
            )
        city_run = gr.run_city(site, output, jobs=jobs, executor=executor, reporter=reporter)
        return Result(
            outputs=city_run.outputs, summary=city_run.figures(), failure=city_run.failure,
            timezone=city_run.city.timezone,
        )  # fmt: skip
    if executor is not None:
        raise UsageError("{} is for a city", "--executor", hint="name a city file: CITY.toml")
    done = gr.run_site(site, output, jobs=jobs, fresh=fresh, reporter=reporter)
    return Result(
        outputs=done.outputs, summary=done.figures(), failure=done.failure,
        advice=_to_open(done.outputs), timezone=done.site.timezone,
    )  # fmt: skip


def _to_open(outputs: list[Path]) -> str:
    """Return which outputs to open, and with which program."""
    pages = [Text("open {} in a browser", path) for path in outputs if path.suffix == ".html"]
    projects = [Text("open {} in QGIS", path) for path in outputs if path.suffix == ".qgz"]
    return Text("; ").join([*pages, *projects])


@command(example="gis-radar check SITE.toml")
@click.argument("site", metavar="SITE.toml", type=FILE)
def check(*, site: Path, reporter: Reporter) -> Result:
    """Check a site before its run: its file, and whether map, scans and recordings fit together.

    Shows from when to when each sensor recorded, the view that its detections show, and whether its
    pose fits what it recorded. Exit code 4: the pose of a sensor does not fit.
    """
    if city.is_city_file(site):
        raise UsageError(
            "{} is for one site", "gis-radar check", hint="name the file of a site of the city"
        )
    found = gr.check_site(site, reporter=reporter)
    failure = found.failure
    advice = "" if failure else Text("the site can be run: gis-radar run {} -o results", site)
    return Result(
        outputs=[], summary=found.figures(), timezone=found.site.timezone, advice=advice,
        failure=failure,
    )  # fmt: skip


@command(example="gis-radar report results --timezone Europe/Berlin", refuses=False)
@click.argument("folder", metavar="DIR", type=FILE)
@click.option("-o", "--output", type=FILE, help="Where the report goes; by default into DIR.")
@click.option("--title", help="Title; by default the site's title or DIR.")
@click.option(
    "--timezone",
    help="Time zone of its times: Europe/Berlin; by default the site's, or UTC.",
)
@language("Language of the report; by default the site's, or that of the heat map.", default=None)
@csv_locale
@click.option(
    "--dataset", type=FILE, help="Dataset of the heat map, where it is not in DIR.",
)  # fmt: skip
@click.option(
    "--no-ways", "ways", is_flag=True, flag_value=False, default=True,
    help="Leave the paths of single vehicles out of the diagrams of queues.",
)  # fmt: skip
@click.option("--month", help="Of a city, DIR with a dataset a site: one page of a month, 2026-10.")
def report(*, folder: Path, month: str | None, reporter: Reporter, **options: Any) -> Result:
    """Write a report for people without QGIS: HTML, PDF, and tables (CSV).

    DIR holds the results of gis-radar run or demo, or a heat map. With --month it is a city, and
    month.html shows all of its sites and the health of its sensors.
    """
    if month is not None or products.is_city(folder):
        made = gr.write_month_page(folder, month, reporter=reporter, **_of_a_month(options))
    else:
        made = gr.write_report(folder, reporter=reporter, **options)
    return Result(
        outputs=list(made.outputs), summary=made.summary, timezone=made.summary["timezone"]
    )


def _of_a_month(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a month's page; refuse those of a site's report."""
    others = {"csv_locale": ("--csv-locale", "en"), "dataset": ("--dataset", None),
              "ways": ("--no-ways", True)}  # fmt: skip
    for name, (option, usual) in others.items():
        if options.pop(name) != usual:
            raise UsageError("{} is of the report of a site, not of a month", option)
    return options


@command(example="gis-radar qgis map/ --sensors sensors.gpkg -o site.qgz")
@click.argument("heatmap", metavar="HEATMAP", type=FILE)
@click.option("--sensors", type=FILE, help="From gis-radar sensors.")
@click.option("--sight", type=FILE, help="From gis-radar sight.")
@click.option("--lanes", type=FILE, help="From gis-radar tiles: its lanes and stop lines.")
@click.option(
    "--footprints", type=FILE, help="From gis-radar footprints: the project plays vehicles."
)
@click.option("--title", help="Of the project; by default that of the heat map.")
@click.option("--timezone", help="Of the time on its layout; by default that of the heat map.")
@click.option("--source", help="Where the data come from; by default as the heat map says.")
@language("Of its layers, legends and layout; by default that of the heat map.", default=None)
@output
def qgis(*, output: Path, reporter: Reporter, **options: Any) -> Result:
    """Write a QGIS project that shows a heat map ready to present, with a print layout."""
    gr.write_qgis_project(output, **options)
    reporter.progress("writing the project", 1, 1)
    return Result(outputs=[output])


@command(example="gis-radar sample -o sample")
@folder_output
def sample(*, output: Path, reporter: Reporter) -> Result:
    """Copy the files of the sample junction to a folder, to try everything on."""
    source = gr.sample_folder()
    files = sorted(path for path in source.iterdir() if path.suffix in _SAMPLE_KINDS)
    refuse_inputs(output, *files)
    owned = tuple(path.name for path in files)
    with atomic_folder(output, owned=owned, reporter=reporter) as fresh:
        for done, path in enumerate(files, start=1):
            shutil.copyfile(path, fresh / path.name)
            reporter.progress("copying the sample", done, len(files))
    return Result(outputs=[output / path.name for path in files])


@command(example="gis-radar demo -o demo")
@click.option(
    "-o", "--output", metavar="DIR", type=FILE, default=Path("gis_radar_demo"), show_default=True,
    help="Folder for the results.",
)  # fmt: skip
def demo(*, output: Path, reporter: Reporter) -> Result:
    """Run all stages on the sample junction."""
    outputs, summary = gr.run_demo(output, reporter=reporter)
    zone = gr.read_site(gr.sample_folder() / "SITE.toml").timezone
    return Result(outputs=outputs, summary=summary, advice=_to_open(outputs), timezone=zone)
