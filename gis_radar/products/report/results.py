"""Read what a report is of: the heat map, its sensors, settings and sources; and its traffic."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np

from gis_radar.base import (
    STEPS_PER_SECOND,
    Clock,
    InputError,
    Text,
    interval_steps,
    read_json,
    restored,
    tr,
    warnings_once,
)
from gis_radar.calibration import Finding, is_record
from gis_radar.dataset import (
    Dataset,
    LaneTraffic,
    NoVehiclesError,
    open_dataset,
    suited_interval,
)
from gis_radar.measures import LaneNetwork
from gis_radar.poses import Pose, pose_from_dict
from gis_radar.products.heatmap.heatmap import HeatMap, read_heatmap
from gis_radar.products.heatmap.layers import HEATMAP_FILE as PACKAGE

DATASET = "dataset"
_RUN = "run.json"
NOT_KNOWN = "not known here"
_SENSOR_LEFT_OUT = "{} is left out: {}"  # template of a warning of the stage `measure`
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
    """

    name: str
    heat: HeatMap
    dataset: Dataset
    poses: Sequence[Pose]
    streets: Mapping[int, tuple[str, str]]
    figures: bool
    run: Mapping[str, Any]

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
    def in_part(self) -> set[str]:
        """The sensors of which the heat map shows only what the run did not refuse."""
        refused = ((each.get("figures") or {}).get("refused") or {} for each in self.stages)
        return {name for names in refused for name in names} & {*self.sensors}

    @property
    def warnings(self) -> list[str]:
        """The warnings of the run, each once, with the names of the stages that raised it.

        That a sensor is left out is no further one: `lost` has it.
        """
        raised: dict[str, list[str]] = {}
        lost = self.lost
        for each in self.stages:
            stage = tr(str(each["name"]))
            texts = raised.setdefault(stage, [])
            for text in each.get("warnings") or []:
                is_left_out = getattr(text, "template", "") == _SENSOR_LEFT_OUT
                if not (is_left_out and text.values[0] in lost):
                    texts.append(tr(text))
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
    return Results(
        name=place.name,
        heat=heat,
        dataset=of_map,
        poses=_poses(of_map),
        streets=_streets(of_map),
        figures=any((folder / "sensors").glob("*/localization.png")),
        run=run,
    )


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


def _streets(dataset: Dataset) -> dict[int, tuple[str, str]]:
    """Return the streets of lanes by their numbers."""
    try:
        named = dataset.lanes().dropna(subset=["street"])
    except NoVehiclesError:
        return {}  # measured without a map
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


class ReportedTraffic(NamedTuple):
    """Traffic in a report.

    Parameters
    ----------
    dataset : Dataset
        The dataset that it is from.
    begin, end : datetime
        Time of the report.
    interval : str
        Length of the intervals.
    lanes, turns : GeoDataFrame
        By interval, from :meth:`gis_radar.Dataset.traffic` and :meth:`gis_radar.Dataset.turns`.
    by_lane, by_turn : GeoDataFrame
        The same over all intervals.
    network : LaneNetwork
        Network of the site.
    """

    dataset: Dataset
    begin: datetime
    end: datetime
    interval: str
    lanes: gpd.GeoDataFrame
    turns: gpd.GeoDataFrame
    by_lane: gpd.GeoDataFrame
    by_turn: gpd.GeoDataFrame
    network: LaneNetwork

    @property
    def length_s(self) -> float:
        """Length of an interval, seconds."""
        return float(interval_steps(self.interval)) / STEPS_PER_SECOND

    @property
    def hours(self) -> float:
        """Total length of the intervals, hours."""
        return len(set(self.lanes["begin"])) * self.length_s / 3600.0

    def clock(self, clock: Clock) -> Clock:
        """Return a clock for the intervals, which may begin before the first recording."""
        begin, end = self.lanes["begin"].min(), self.lanes["end"].max()
        return replace(
            clock, first=min(clock.first, begin.to_pydatetime()),
            last=max(clock.last, end.to_pydatetime()), to_seconds=False,
        )  # fmt: skip


def traffic_of(dataset: Dataset, heat: HeatMap) -> ReportedTraffic | None:
    """Return the traffic in the time of a heat map; None where none is known.

    Parameters
    ----------
    dataset : Dataset
        The dataset of the heat map.
    heat : HeatMap
        The heat map, whose time counts.
    """
    if not dataset.has_vehicles or heat.measure != "occupancy":
        return None
    begin, end = heat.whole.span()
    interval, first = suited_interval(dataset, begin, end)
    lanes, by_lane = (
        dataset.traffic(interval, begin=first, end=end, whole=each) for each in (False, True)
    )
    if lanes.empty:
        return None
    turns, by_turn = (
        dataset.turns(interval, begin=first, end=end, whole=each) for each in (False, True)
    )
    return ReportedTraffic(
        dataset=dataset, begin=begin, end=end, interval=interval, lanes=lanes, turns=turns,
        by_lane=by_lane, by_turn=by_turn, network=LaneTraffic.of(dataset).network,
    )  # fmt: skip
