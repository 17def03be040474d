"""Settings in effect and data sources of a report, as far as the folder holds them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gis_radar.base import THIN_SPACE, figure_text, listed, name_of, plural, tr
from gis_radar.products.report.content import Table, text_columns
from gis_radar.products.report.results import NOT_KNOWN, Results


def settings_of(results: Results) -> Table:
    """Return the settings in effect, as far as the folder holds them."""
    rows = [
        [tr("Coordinates"), f"{results.heat.crs.name}, {name_of(results.heat.crs)[:24]}"],
        [tr("Intervals"), _interval_text(results)],
        [tr("Tiles"), _tiles_text(results)],
        *([name, text] for name, text in _filter_rows(results)),
        [tr("Fingerprint of the tiles"), results.heat.fingerprint],
        [tr("Software"), _software_text(results)],
    ]
    columns = text_columns(tr("What"), tr("Setting"))
    return Table(name="settings", caption=tr("Settings"), columns=columns, rows=rows)


def sources_of(results: Results) -> Table:
    """Return the data that the heat map was made of."""
    rows = [
        [name, text]
        for name, part in (
            (tr("Map"), results.site.get("map")),
            (tr("Scan"), results.site.get("scan")),
        )
        if part and (text := _file_text(part))
    ]
    rows += [
        [
            tr("Recording of {sensor}", sensor=each.sensor),
            f"{Path(each.path).name}, " + plural(int(each.rows), "{n} detection", "{n} detections"),
        ]
        for each in _recordings(results)
    ]
    rows += [[tr("Attribution"), str(text)] for text in results.site.get("attribution") or []]
    if not rows:
        text = tr("{name}; what it was made of is not known here", name=results.name)
        rows = [[tr("Heat map"), text]]
    columns = text_columns(tr("What"), tr("Data"))
    return Table(name="sources", caption=tr("Data sources"), columns=columns, rows=rows)


def made_by() -> str:
    """Return the software that makes the report."""
    return f"gis_radar {version('gis_radar')}"


def _file_text(part: Mapping[str, Any]) -> str:
    files = part.get("files") or [part.get("road")] if "files" in part else [part.get("file")]
    named = listed([Path(each).name for each in files if each])
    return f"{named} ({part['source']})" if part.get("source") else named


def _interval_text(results: Results) -> str:
    timeline = results.heat.timeline
    if len(timeline) < 2:
        return tr("none: the whole time only")
    begin, end = timeline.span()
    interval_s = (end - begin).total_seconds()
    text = f"{figure_text(interval_s)} s"
    for unit, length_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if interval_s % length_s == 0:
            text = f"{figure_text(interval_s / length_s)} {unit}"
            break
    return tr("{n} intervals of {length}", n=figure_text(len(timeline)), length=text)


def _tiles_text(results: Results) -> str:
    tiles = results.heat.tiles
    length = float(tiles["length_m"].median())
    return tr(
        "{n} tiles, most {length} m long", n=figure_text(len(tiles)), length=figure_text(length, 2)
    )


def _filter_rows(results: Results) -> Iterator[tuple[str, str]]:
    """Yield which detections count, how long frames are valid, and how clocks were corrected."""
    filters = results.dataset.manifest.settings["filters"]
    yield tr("Detections that count"), _filters_in_words(filters)
    valid = {each.sensor: each.validity_s for each in _recordings(results)}
    for sensor, validity_s in valid.items():
        until = tr("until its next one, at most {time} ms", time=figure_text(1000 * validity_s))
        yield tr("A frame of {sensor} is valid", sensor=sensor), until
    for each in _recordings(results):
        if each.clock_offset or each.clock_drift_ppm:
            clock = f"{figure_text(each.clock_offset, 3)} s, {figure_text(each.clock_drift_ppm, 1)}"
            yield tr("Clock of {sensor} corrected", sensor=each.sensor), f"{clock} ppm"


def _recordings(results: Results) -> list[Any]:
    """Return what the dataset was made from, a row a recording."""
    return list(results.dataset.recordings().itertuples())


def _filters_in_words(filters: Mapping[str, Any]) -> str:
    words = []
    if filters.get("clearance"):
        low, high = (figure_text(float(each), 1) for each in filters["clearance"])
        error = figure_text(float(filters.get("elevation_error_deg") or 0.0), 1)
        text = "{low} to {high} m over the road (elevation error {error}°)"
        words.append(tr(text, low=low, high=high, error=error))
    if filters.get("min_speed") is not None:
        speed = f"{figure_text(float(filters['min_speed']), 1)}{THIN_SPACE}m/s"
        words.append(tr("faster than {speed}", speed=speed))
    if filters.get("min_rcs") is not None:
        rcs = f"{figure_text(float(filters['min_rcs']), 1)}{THIN_SPACE}dBm²"
        words.append(tr("cross section over {rcs}", rcs=rcs))
    return "; ".join(words) or tr("all, standing and moving")


def _software_text(results: Results) -> str:
    known = results.run.get("software") or {}
    if known.get("gis_radar"):
        return f"gis_radar {known['gis_radar']} (code {known.get('code', NOT_KNOWN)})"
    return made_by()
