"""Read a folder of results: the heat map, its sensors, settings and sources, also as tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio

from gis_radar.base import (
    NO_FIGURE,
    THIN_SPACE,
    InputError,
    Text,
    direction,
    figure_text,
    listed,
    name_of,
    opened_package,
    plural,
    plus_minus,
    read_json,
    restored,
    tr,
    warnings_once,
)
from gis_radar.calibration import Finding, is_record
from gis_radar.dataset import Dataset, open_dataset
from gis_radar.hdmap import LANES_LAYER
from gis_radar.poses import Pose, View, pose_from_dict
from gis_radar.products.heatmap.heatmap import HeatMap, read_heatmap
from gis_radar.products.heatmap.layers import HEATMAP_FILE as PACKAGE
from gis_radar.products.report.content import Column, Table, how_found, text_columns, text_rows

DATASET = "dataset"
_RUN = "run.json"
NOT_KNOWN = "not known here"
_NAME_IT = Text("name the dataset that the heat map was made of")


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The results that a report is made of.

    Parameters
    ----------
    name : str
        Name of the heat map's folder.
    heat : HeatMap
        The heat map.
    dataset : Dataset or None
        The dataset that it was made of; None if it is missing.
    poses : sequence of Pose
        The last pose of each sensor that the heat map shows, by name, where it is in the map's
        coordinate system.
    streets : mapping
        Name of a lane's street, and which of several of that name it is (else empty), by the lane's
        number, where it is known.
    figures : bool
        Whether there are pictures of how poses were found.
    run : mapping
        The `run.json` of `gis-radar run`; empty where the steps were made one by one.
    missing : sequence of str
        Sentences on what is missing.
    """

    name: str
    heat: HeatMap
    dataset: Dataset
    poses: Sequence[Pose]
    streets: Mapping[int, tuple[str, str]]
    figures: bool
    run: Mapping[str, Any]
    missing: Sequence[str]

    @property
    def sensors(self) -> list[str]:
        """The sensors that the heat map shows."""
        return self.dataset.sensors

    @property
    def site(self) -> Mapping[str, Any]:
        """The site file's content, empty where there was none."""
        return dict(self.run.get("site") or {})

    @property
    def timezone(self) -> str:
        """The site's time zone."""
        stated = self.site.get("timezone")
        return str(stated or self.heat.labels.timezone)

    @property
    def stages(self) -> list[dict[str, Any]]:
        """Stages of the run, with figures, warnings and errors."""
        return list(self.run.get("stages") or [])

    @property
    def traffic(self) -> dict[str, int]:
        """Numbers of vehicles, heavy ones and passages; empty where not known."""
        found = [each.get("figures") or {} for each in self.stages if each["name"] == "measure"]
        if not found and self.dataset.has_vehicles:
            heavy = self.dataset.vehicles()["p_heavy"] >= 0.5
            found = [self.dataset.figures() | {"heavy": np.count_nonzero(heavy)}]
        names = ("vehicles", "heavy", "passages")
        return {n: int(each[n]) for each in found for n in names if n in each}

    @property
    def lost(self) -> dict[str, str]:
        """By sensor of the site that the heat map does not show, the reason."""
        return lost_sensors(self.run)

    @property
    def findings(self) -> dict[str, Finding]:
        """By sensor, the finding whether its pose and recordings fit, from dataset or run."""
        records = [self.dataset.manifest.checks]
        records += [(each.get("figures") or {}).get("findings") or {} for each in self.stages]
        return {
            str(name): Finding(sensor=str(name), **found)
            for each in records
            for name, found in each.items()
            if is_record(found)
        }

    @property
    def warnings(self) -> list[str]:
        """The warnings of the run, each once, with the names of the stages that raised it."""
        raised: dict[str, list[str]] = {}
        for each in self.stages:
            stage = tr(str(each["name"]))
            texts = raised.setdefault(stage, [])
            texts += [tr(text) for text in each.get("warnings") or []]
        return warnings_once(raised)

    @property
    def credits(self) -> list[str]:
        """The sources of map and scan, and attributions, each once."""
        parts = [self.site.get("map"), self.site.get("scan")]
        named = [str(part["source"]) for part in parts if part and part.get("source")]
        named += map(str, self.site.get("attribution") or self.heat.labels.sources)
        return list(dict.fromkeys(named))


def lost_sensors(run: Mapping[str, Any]) -> dict[str, str]:
    """Return the sensors of a site that the heat maps of its run do not show, and why."""
    shown, stages = run.get("sensors_in_heat_maps") or [], run.get("stages") or []
    errors = {
        str(stage["name"]).partition(" ")[2]: str(stage["error"])
        for stage in reversed(stages)
        if stage.get("error")
    }
    for stage in stages:
        refused = (stage.get("figures") or {}).get("refused") or {}
        errors |= {n: Text(why).without(n) for n, why in refused.items()}
    names = [str(each["name"]) for each in (run.get("site") or {}).get("sensor") or []]
    return {name: errors.get(name, "see run.json") for name in names if shown and name not in shown}


def read_results(folder: Path, dataset: Path | None = None) -> Results:
    """Read the results of `gis-radar run`, or of the steps one by one.

    Parameters
    ----------
    folder : Path
        Holds `heatmap.gpkg`, or a folder with it: `heatmap/`, or the only one that has one.
    dataset : Path, optional
        The dataset that it was made of, where it is not the folder `dataset` in it.

    Raises
    ------
    InputError
        If there is no heat map, or several, or not its dataset, or something is damaged.
    """
    run, place = read_run(folder), _heat_map(folder)
    heat = read_heatmap(place)
    of_map = _dataset(folder, heat, dataset)
    missing = list[str]()
    if not run:
        missing.append("The folder is not that of a run: settings are listed only as far as known.")
    if of_map.has_vehicles:
        of_map, left_out = as_stated(of_map, run.get("site") or {})
        missing += left_out
    return Results(
        name=place.name,
        heat=heat,
        dataset=of_map,
        poses=_poses(of_map),
        streets=_streets(folder),
        figures=any((folder / "sensors").glob("*/localization.png")),
        run=run,
        missing=missing,
    )


def as_stated(dataset: Dataset, site: Mapping[str, Any]) -> tuple[Dataset, list[str]]:
    """Return a dataset with the lanes' names and free speeds of a site, and what was left out."""
    known = set(dataset.layer(LANES_LAYER)["lane"].tolist())
    lanes = site.get("lane") or []
    unknown = [str(each["id"]) for each in lanes if int(each["id"]) not in known]
    lanes = [each for each in lanes if int(each["id"]) in known]
    text = "The site file names lanes that the map has not: {}; they are left out."
    left_out = [Text(text, ", ".join(unknown))] if unknown else []
    return dataset.with_lanes(lanes, (site.get("map") or {}).get("speed_kmh")), [*left_out]


def _heat_map(folder: Path) -> Path:
    if not folder.is_dir():
        raise InputError("{}: no such folder", folder, hint="name the folder of gis-radar run")
    for place in (folder, folder / "heatmap"):
        if (place / PACKAGE).is_file():
            return place
    folders = sorted(path.parent for path in folder.glob(f"*/{PACKAGE}"))
    if len(folders) > 1:
        names = ", ".join(path.name for path in folders)
        raise InputError("{}: holds several heat maps: {}", folder, names, hint="name one of them")
    if not folders:
        raise InputError(
            "{}: holds no heat map", folder, hint="make one with: gis-radar run, gis-radar heatmap"
        )
    return folders[0]


def _dataset(folder: Path, heat: HeatMap, given: Path | None) -> Dataset:
    """Return the dataset that a heat map was made of."""
    place = given or folder / DATASET
    if not place.is_dir():
        raise InputError(
            "{}: no such dataset, of which the heat map was made", place, hint=_NAME_IT
        )
    dataset = open_dataset(place)
    whole = int(heat.whole.begin[0]), int(heat.whole.end[-1]) - 1
    if (
        dataset.manifest.fingerprint != heat.fingerprint
        or not set(heat.sensors) <= set(dataset.sensors)
        or not dataset.records(whole)
    ):
        raise InputError("{}: the heat map was not made of {}", folder, place, hint=_NAME_IT)
    return dataset


def _streets(folder: Path) -> dict[int, tuple[str, str]]:
    """Return the streets of lanes by their numbers, as far as the run's tiles know them."""
    path = folder / "tiles.gpkg"
    if not path.is_file():
        return {}
    try:
        with opened_package(path, what="a GeoPackage of tiles") as place:
            table = pyogrio.read_dataframe(place, layer=LANES_LAYER, read_geometry=False)
    except InputError:
        return {}  # `gr.write_tiles` without lanes
    named = table.dropna(subset=["street"])
    parts = named["street_part"].fillna("")
    names = zip(named["street"].astype(str), parts.astype(str), strict=True)
    return dict(zip(named["lane"].astype(int), names, strict=True))


def _poses(dataset: Dataset) -> list[Pose]:
    """Return the last pose of each sensor."""
    what = Text("{}: a pose", dataset.folder)
    poses = [
        pose_from_dict(json.loads(each), what=what) for each in dataset.last_poses()["document"]
    ]
    return sorted(poses, key=lambda pose: pose.sensor)


def read_run(folder: Path) -> dict[str, Any]:
    """Read the `run.json` of `gis-radar run`; empty where there is none."""
    path = folder / _RUN
    if not path.is_file():
        return {}
    document = read_json(path, what="the record of a run", hint=Text("run the site again"))
    if not isinstance(document, dict):
        raise InputError("{}: damaged: it is no table of settings", path, hint="run the site again")
    return restored(document)


def sensor_table(results: Results) -> Table:
    """Return the table of the sensors' poses, with their errors and how they were found.

    Parameters
    ----------
    results : Results
        The results.
    """
    columns = _sensor_columns()
    rows = text_rows(results.poses, columns)
    rows += [
        [name, *[NO_FIGURE] * 6, tr("no result: {why}", why=tr(reason))]
        for name, reason in results.lost.items()
    ]
    note = tr(
        "± is one standard deviation. Bearings count clockwise from grid north; pitch over 0 "
        "looks down. Width is the opening angle."
    )
    if results.figures:
        note += " " + tr("Pictures of how they were found: sensors/NAME/localization.png.")
    if not rows:
        note = tr("No pose is known here.")
    return Table(
        name="sensors", caption=tr("Sensors, and where they stand"), columns=columns, rows=rows,
        note=note,
    )  # fmt: skip


def _sensor_columns() -> list[Column]:
    """Return the columns of the table of sensors."""

    def angles(pose: Pose) -> str:
        both = [_with_sigma(pose, name, 1).replace(" ", THIN_SPACE) for name in ("pitch", "roll")]
        return ", ".join(both)

    def sees(pose: Pose) -> str:
        view = pose.view or View()
        return f"{figure_text(view.max_range_m)} m, {figure_text(view.azimuth_deg)}°"

    return [
        Column(tr("Sensor"), "", lambda pose: str(pose.sensor), False),
        Column(tr("Easting"), "m", lambda pose: _with_sigma(pose, "easting", 2)),
        Column(tr("Northing"), "m", lambda pose: _with_sigma(pose, "northing", 2)),
        Column(tr("Height"), "m", lambda pose: _with_sigma(pose, "height", 2)),
        Column(tr("Looks to"), tr("from grid north"), _looks_to),
        Column(tr("Pitch, roll"), tr("degrees"), angles),
        Column(tr("Sees"), tr("range, width"), sees),
        Column(tr("How its pose was found"), "", lambda pose: how_found(pose.evidence), False),
    ]


def _with_sigma(
    pose: Pose, name: str, digits: int, value: float | None = None, unit: str = ""
) -> str:
    """Return a number of a pose, or another value for it, with its standard deviation."""
    shown = figure_text(getattr(pose, name) if value is None else value, digits) + unit
    known = pose.parsed_evidence().sigma.get(name)
    return shown if known is None else f"{shown} {plus_minus(known, 2, unit)}"


def _looks_to(pose: Pose) -> str:
    ahead = pose.R_map_sensor[:2, 0]
    bearing = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
    return f"{direction(*ahead)}, {_with_sigma(pose, 'yaw', 1, bearing, '°')}"


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
