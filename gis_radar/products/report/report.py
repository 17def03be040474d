"""Write the report of a folder of results: key figures, lanes and quality in words and tables."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd

from gis_radar.base import (
    NO_FIGURE,
    QUIET,
    THIN_SPACE,
    Clock,
    Reporter,
    Text,
    UsageError,
    atomic_writes,
    card,
    csv_for,
    direction,
    figure_text,
    folder_to_fill,
    in_language,
    known_language,
    listed,
    percent,
    plural,
    street_label,
    tr,
    zone_of,
)
from gis_radar.dataset import FRAMES
from gis_radar.hdmap import lanes_of
from gis_radar.products import report_files as names
from gis_radar.products.heatmap.heatmap import HeatMap
from gis_radar.products.heatmap.picture import MapPicture
from gis_radar.products.quality.quality import Quality, measure_quality
from gis_radar.products.report.basis import (
    ReportData,
    as_high_as,
    basis_of,
    facts_of,
    own_remarks,
    remarks_of,
    totals_of,
)
from gis_radar.products.report.chart import draw_lanes_over_time
from gis_radar.products.report.content import (
    LANES_CHAPTER,
    QUEUES,
    REPORT_WORDS,
    Chapter,
    Column,
    Content,
    Figure,
    Table,
    Terms,
    text_rows,
    utc,
)
from gis_radar.products.report.lanes import (
    LEAST_FOLLOWED,
    LEAST_SEEN,
    WHY_NOT,
    lane_table,
    sums_of,
    tracks_of,
    write_lane_intervals,
    write_lanes,
)
from gis_radar.products.report.maps import draw_maps, draw_sights, lay_out
from gis_radar.products.report.pages import page_of, write_pdf
from gis_radar.products.report.plan import draw_plan
from gis_radar.products.report.results import Results, read_results, traffic_of
from gis_radar.products.report.sensors import quality_table, sensor_table, trust_table
from gis_radar.products.report.sources import made_by, settings_of, sources_of
from gis_radar.products.report.traffic import traffic_chapters
from gis_radar.products.traffic import write_table

_MOST_LANES = 150  # rows of the table as read; the CSV file holds all
_LEAST_PRINTED = 10  # lanes on paper; more where more are ranked


@dataclass(frozen=True, kw_only=True)
class Report:
    """A written report: its files and figures.

    Parameters
    ----------
    outputs : sequence of Path
        The files: the page, the PDF, and the tables.
    summary : dict
        Key figures.
    """

    outputs: Sequence[Path]
    summary: dict[str, Any]

    def __repr__(self) -> str:
        page = self.outputs[0]
        return f"Report({self.summary['title']!r}, {len(self.outputs)} files: {page}, ...)"

    def _repr_html_(self) -> str:
        files = {"files": ", ".join(path.name for path in self.outputs)}
        return card(f"Report in {self.outputs[0].parent}", self.summary | files)


def write_report(
    folder: str | Path,
    *,
    output: str | Path | None = None,
    title: str | None = None,
    timezone: str | None = None,
    language: str | None = None,
    csv_locale: str = "en",
    dataset: str | Path | None = None,
    ways: bool = True,
    reporter: Reporter = QUIET,
) -> Report:
    """Write a report for people without QGIS: `report.html`, `report.pdf`, and tables as CSV.

    The page opens without a network and asks for nothing; it needs no script but for the slider.
    What the folder of a run would tell, and this does not, is named as not known. The same results
    give the same files.

    Parameters
    ----------
    folder : str or Path
        Results of `gis-radar run` or `gis-radar demo`, or the folder of a heat map.
    output : str or Path, optional
        Folder that the report goes to; by default `folder`.
    title : str, optional
        Title; by default that of the site or heat map, or the name of the folder.
    timezone : str, optional
        Time zone of the report's times, such as Europe/Berlin; by default that of the site, or of
        the heat map's picture.
    language : str, optional
        Language of all text, `en` or `de`; by default the site's, or that of the heat map's
        picture. The tables as CSV are the same in every language.
    csv_locale : str
        `de` writes them as a German spreadsheet opens them: semicolons, decimal commas, and the
        mark of UTF-8.
    dataset : str or Path, optional
        The dataset that the heat map was made of, if it is not `dataset` in `folder`.
    ways : bool
        Whether diagrams of queues show the trajectories of single vehicles to the stop line.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        If the folder holds no heat map or a damaged one, or its dataset is not there.
    UsageError
        If there is no such time zone, language or locale.
    OutputError
        If the report cannot be written.
    """
    folder = Path(folder)
    if title is not None and not title.strip():
        raise UsageError("the title is empty", hint="leave it out, or give the name of the site")
    results = read_results(folder, None if dataset is None else Path(dataset))
    heat = results.heat
    spoken = language or str(results.site.get("language") or heat.labels.language)
    with csv_for(csv_locale), in_language(known_language(spoken)):
        title = title or str(
            results.site.get("title") or heat.labels.title or folder.resolve().name
        )
        data = _gather(results, title, timezone, reporter)
        content = _content(data, reporter, paths=ways)
        outputs = _write(folder if output is None else Path(output), data, content, reporter)
        return Report(outputs=outputs, summary=_summary(data, content))


def _gather(results: Results, title: str, timezone: str | None, reporter: Reporter) -> ReportData:
    """Compute the data of page, PDF and tables."""
    heat = results.heat
    zone = timezone or results.timezone
    sums = sums_of(heat, each=True)
    table = lane_table(heat, sums, tracks_of(results.dataset, lanes_of(heat.tiles)))
    streets = [results.streets.get(int(lane), ("", "")) for lane in table["lane"]]
    table["street"], table["street_part"] = zip(*streets, strict=True) if streets else ((), ())
    traffic = traffic_of(results.dataset, heat)
    if traffic is not None:
        table["name"] = table["lane"].map(traffic.by_lane.set_index("lane")["name"]).fillna("")
    return ReportData(
        results=results,
        title=title,
        clock=_clock(heat, zone),
        quality=_quality(results, zone, reporter),
        lanes=sums,
        table=table,
        traffic=traffic,
    )


def _clock(heat: HeatMap, timezone: str) -> Clock:
    """Return the site's clock: to the second where an interval does not begin at a minute."""
    edges = [each for span in heat.timeline.spans() for each in span]
    fine = any(each.second or each.microsecond for each in edges)
    begin, end = heat.whole.span()
    return Clock(
        zone=zone_of(timezone), first=min(edges[0], begin), last=max(edges[-1], end),
        to_seconds=fine,
    )  # fmt: skip


def _quality(results: Results, timezone: str, reporter: Reporter) -> Quality | None:
    dataset = results.dataset
    records = dataset.records().values()
    if records and all(FRAMES.name in each.dropped for each in records):
        return None
    return measure_quality(dataset, timezone=timezone, reporter=reporter)


def _write(place: Path, data: ReportData, content: Content, reporter: Reporter) -> list[Path]:
    """Write all files, which appear together or not at all."""
    writers = _writers(data, content)
    before = [place / name for name in names.REPORT_FILES] if (place / names.PAGE).is_file() else []
    with folder_to_fill(place), atomic_writes(place / names.PAGE) as (private, places):
        for done, (name, write) in enumerate(writers.items(), start=1):
            write(private / name)
            if (private / name).is_file():
                places[private / name] = place / name
            reporter.progress("writing the report", done, len(writers))
    written = list(places.values())
    for path in before:  # files that only the earlier report had
        if path not in written:
            path.unlink(missing_ok=True)
    if place / names.PDF not in written:
        reporter.warn(
            "{} is not written: WeasyPrint, or Pango, which it calls, is missing (pip "
            "install gis_radar[pdf]); a browser prints {} alike",
            names.PDF,
            names.PAGE,
        )
    return written


def _writers(data: ReportData, content: Content) -> dict[str, Callable[[Path], object]]:
    """Return the writer of each file."""
    clock, heat, quality = data.clock, data.results.heat, data.quality
    writers: dict[str, Callable[[Path], object]] = {
        names.PAGE: lambda path: path.write_text(page_of(content), encoding="utf-8", newline="\n"),
        names.PDF: lambda path: write_pdf(content, path),
        names.LANES_FILE: lambda path: write_lanes(path, data.table, clock, heat.measure),
        names.LANES_BY_INTERVAL: lambda path: write_lane_intervals(path, heat, data.lanes, clock),
    }
    if quality is not None:
        writers[names.QUALITY] = quality.write_rows
    if (traffic := data.traffic) is not None:
        writers[names.TRAFFIC_FILE] = lambda path: write_table(traffic.lanes, path)
        writers[names.TURNS_FILE] = lambda path: write_table(traffic.turns, path)
    return writers


def _summary(data: ReportData, content: Content) -> dict[str, Any]:
    """Return the figures as numbers, None where not known; the page has them in words."""
    begin, end = data.results.heat.whole.span()
    return {
        "title": content.title,
        "begin": utc(begin),
        "end": utc(end),
        "timezone": str(data.clock.zone),
        "pictures": len(content.map.frames) + 1,
        "sensors": data.results.sensors,
        **totals_of(data),
        "facts": {fact.name: " ".join(filter(None, [fact.value, fact.rests and f"({fact.rests})"]))
                  for fact in content.facts},
        "basis": [[each.title for each in content.basis.columns], *map(list, content.basis.rows)],
        "found": _english_remarks(data),
        "remarks": list(content.remarks),
    }  # fmt: skip


def _english_remarks(data: ReportData) -> list[Text]:
    """Return the report's remarks in English, as logs keep them; the console translates."""
    with in_language("en"):
        return own_remarks(data)


def _content(data: ReportData, reporter: Reporter, *, paths: bool) -> Content:
    """Return the content of the report: texts, tables and pictures."""
    results, clock = data.results, data.clock
    picture = lay_out(results.heat)
    questions = traffic_chapters(data.traffic, clock, paths=paths) if data.traffic else []
    queues = (part for each in questions if each.name == QUEUES for part in each.parts)
    paths &= any(isinstance(part, Figure) for part in queues)
    begin, end = results.heat.whole.span()
    return Content(
        title=data.title,
        subtitle=clock.long_span(begin, end),
        zone=clock.name,
        until=end,
        intro=tr(REPORT_WORDS[results.heat.measure].intro),
        facts=facts_of(data),
        remarks=remarks_of(data),
        basis=basis_of(data),
        questions=questions,
        shows_paths=paths,
        map=draw_maps(results, picture, clock, reporter),
        chapters=_chapters(data, picture),
        made_by=made_by(),
        measure=results.heat.measure,
    )


def _chapters(data: ReportData, picture: MapPicture) -> list[Chapter]:
    """Return the chapters after the map."""
    results, clock = data.results, data.clock
    lanes = _lanes(data, intervals=len(results.heat.timeline) > 1)
    sensors = sensor_table(results, clock.zone)
    sources = [settings_of(results), sources_of(results)]
    plan = draw_plan(results.heat.tiles, picture, data.table)
    over_time = draw_lanes_over_time(results.heat, data.lanes, data.table, clock)
    return [
        Chapter("trust", tr("Can this be trusted?"), [trust_table(results, clock)]),
        Chapter(LANES_CHAPTER, tr("Lanes"), [plan, lanes]),
        *([Chapter("time", tr("The lanes over time"), over_time)] if over_time else []),
        Chapter("sensors", tr("Sensors"), [sensors, *draw_sights(results)]),
        Chapter("quality", tr("What sensors delivered"), [quality_table(data)]),
        Chapter("settings", tr("Settings and sources"), sources),
        Chapter("words", tr("What the words mean"), [_terms(data)]),
    ]


def _terms(data: ReportData) -> Terms:
    """Return the definitions of the words that the report uses."""
    text = (
        files("gis_radar.products.report").joinpath("definitions.toml").read_text(encoding="utf-8")
    )
    groups = tomllib.loads(text)
    others = {"hits" if data.results.heat.measure == "occupancy" else "occupancy"}
    others |= set() if data.traffic else {"traffic"}
    chosen = [name for name in groups if name not in others]
    pairs = [pair for name in chosen for pair in groups[name].items()]
    return Terms(tuple((tr(term), tr(meaning)) for term, meaning in pairs))


def _lanes(data: ReportData, *, intervals: bool) -> Table:
    """Return the table of the lanes with a share, from the rows of `lane_table`."""
    table, measure = data.table, data.results.heat.measure
    known, words = table[table["share"].notna()], REPORT_WORDS[measure]
    shown, ranks = known.head(_MOST_LANES), measure == "occupancy"
    columns = lane_columns(data.clock, measure)
    columns = columns if intervals else columns[:-1]
    notes = [_ranking(table)] if ranks else []
    if unseen := len(table) - len(known):
        notes.append(plural(unseen, words.unseen_one, words.unseen_many))
    if len(known) > len(shown):
        text = tr("Here are {part} of {all} lanes.", part=len(shown), all=figure_text(len(known)))
        notes.append(text)
    if ranks:
        notes.append(tr("± is the standard error."))
        if intervals:
            text = "A highest interval is named where it lies over the mean by more than its error."
            notes.append(tr(text))
    notes.append(tr("Where lanes cross, their tiles overlap, and a vehicle there counts on each."))
    csv_files = [(names.LANES_FILE, tr("all lanes"))]
    if intervals:
        csv_files.append((names.LANES_BY_INTERVAL, tr("each lane in each interval")))
    return Table(
        name="lanes",
        caption=tr("Lanes by occupancy") if ranks else tr("Lanes in the order of numbers"),
        columns=columns,
        rows=text_rows((row for _, row in shown.iterrows()), columns),
        note=" ".join(notes),
        files=csv_files,
        printed=max(int((shown["rank"] > 0).sum()), _LEAST_PRINTED) if ranks else None,
    )


def _ranking(table: pd.DataFrame) -> str:
    """Return in a sentence which lanes are ranked, and whether the first is the highest."""
    ranked = table[table["rank"] > 0]
    if ranked.empty:
        return tr("No lane is known well enough to be ranked.")
    lane, near = int(ranked["lane"].iloc[0]), as_high_as(table)
    rule = tr(
        "Ranked are lanes with {tracks} tracks or more and {share} of their length visible or "
        "more, whose standard error is at most half their occupancy; the others say why not.",
        tracks=LEAST_FOLLOWED, share=percent(LEAST_SEEN, 0),
    )  # fmt: skip
    if not near:
        return rule
    several = "Lane {lane} comes first, but lanes {others} may be as high: within the errors."
    single = "Lane {lane} comes first, but lane {others} may be as high: within the errors."
    first = tr(single if len(near) == 1 else several, lane=lane, others=listed(near))
    return f"{rule} {first}"


def lane_columns(clock: Clock, measure: str) -> list[Column]:
    """Return the columns of the table of lanes; the last is of the highest interval.

    Parameters
    ----------
    clock : Clock
        Clock of the intervals.
    measure : str
        Measure of the map; for hit share, columns that need vehicles are left out.

    Returns
    -------
    list of Column
        Columns with titles in the current language.
    """
    words = REPORT_WORDS[measure]

    def rank(row: pd.Series) -> str:
        return str(row["rank"]) if row["rank"] else tr(WHY_NOT[row["why"]])

    def interval(row: pd.Series) -> str:
        apart = row["busiest_share"] - row["share"]
        if pd.isna(row["busiest_begin"]) or not apart > (row["busiest_share_se"] or 0.0):
            return NO_FIGURE
        span = clock.span(*(row[name].to_pydatetime() for name in ("busiest_begin", "busiest_end")))
        return f"{span}: {percent(row['busiest_share'], 0, error=row['busiest_share_se'])}"

    def spot(row: pd.Series) -> str:
        place = f"{figure_text(row['busiest_spot_m'])}{THIN_SPACE}m"
        share = percent(row["busiest_spot"], 0, error=row["busiest_spot_se"])
        text = tr("{share} at {place}", share=share, place=place)
        return text.replace(f" {place}", f"{THIN_SPACE}{place}")  # so that no line breaks before it

    def leads_to(row: pd.Series) -> str:
        street = street_label(row["street"], row["street_part"])
        return ", ".join(filter(None, [street, direction(row["east_m"], row["north_m"])]))

    columns = [
        Column(tr("Lane"), "", lambda row: str(row["lane"])),
        Column(tr("Rank"), "", rank, False),
        Column(tr("Leads to"), tr("at its end"), leads_to, False),
        Column(tr(words.share), tr(words.base),
               lambda row: percent(row["share"], error=row["share_se"])),
        Column(tr("Tracks"), "",
               lambda row: figure_text(row["tracks"]) if row["tracks"] >= 0 else NO_FIGURE),
        Column(tr("Length"), "m", lambda row: figure_text(row["length_m"])),
        Column(tr(words.seen), tr("of length"),
               lambda row: percent(row["base_m"] / row["length_m"], 0)),
        Column(tr("Highest tile"), tr("and its place"), spot),
        Column(tr("20 % or more"), "m", lambda row: figure_text(row["busy_m"], 1)),
        Column(tr("Highest interval"), clock.name if clock else "", interval, False),
    ]  # fmt: skip
    of_vehicles = {tr("Rank"), tr("Tracks")}
    return [each for each in columns if measure == "occupancy" or each.title not in of_vehicles]
