"""Algorithms of traffic: from recordings to a dataset, and from that to its layers."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingOutputFolder,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..loading import load
from ..opening import open_dialog
from ..parameters import (
    Choice,
    File,
    Files,
    Folder,
    Given,
    Names,
    Number,
    Output,
    OutputFolder,
    OutputLayer,
    Range,
    Result,
    Switch,
    Text,
)
from ..runner import Answer
from ..words import tr
from . import shared
from .heat_maps import layers_of, load_heatmap


class ConvertRecordings(WorkerAlgorithm):
    """An algorithm that makes a recording of what a radar's driver wrote."""

    NAME = "convertrecordings"
    COMMAND = "convert"
    TITLE = "Convert recordings"
    GROUP = TRAFFIC
    HELP = (
        "Turns what a radar's driver wrote, in any known format, into one recording (Parquet) that "
        "the other algorithms read.\n"
        "Several files of the same sensor are joined in the order of their times."
    )
    KEYWORDS = ("pcap", "rosbag", "parquet", "import")
    PARAMETERS = (
        Files("INPUT", "Files of one radar", "What the radar's driver wrote.", ""),
        Text(
            "SENSOR", "Only this sensor",
            "Where the files have several: its address or topic, such as 10.13.1.113.",
        ),
        Text(
            "COLUMNS", "Columns of a table",
            "Ours and those of the table: x=X,range_rate=-doppler; a minus turns the sign.",
        ),
        Choice("TIME_UNIT", "Unit of the times in a table", choices=("s", "ms", "us", "ns")),
        Choice(
            "CLOCK", "Whose clock counts", "auto takes the sensor's where it is right.",
            choices=("auto", "sensor", "recorder"),
        ),
        Output("OUTPUT", "Recording", kinds="Recordings (*.parquet)"),
    )  # fmt: skip


class CompareClocks(WorkerAlgorithm):
    """An algorithm that finds how far clocks are apart, by the traffic that sensors share."""

    NAME = "clocks"
    COMMAND = "clocks"
    TITLE = "Compare clocks"
    GROUP = TRAFFIC
    HELP = (
        "Finds how far the clocks of several radars are apart, by the vehicles that two of them "
        "see.\n"
        "Give the result to 'Measure traffic', or to a site: times are then corrected."
    )
    KEYWORDS = ("time", "offset", "synchronization")
    PARAMETERS = (
        replace(shared.RECORDINGS, about="Of two or more sensors that see the same traffic."),
        shared.POSES,
        shared.TILES,
        Text("REFERENCE", "Whose clock is right", "The name of a sensor."),
        Output("OUTPUT", "Clocks", kinds="Clocks (*.json)"),
    )  # fmt: skip


class MeasureTraffic(WorkerAlgorithm):
    """An algorithm that measures hits and vehicles, and adds them to a dataset."""

    NAME = "measure"
    COMMAND = "measure"
    TITLE = "Measure traffic"
    GROUP = TRAFFIC
    HELP = (
        "Follows the vehicles that radars see along the lanes, all radars together, and finds "
        "which tiles they occupied for how long: occupancy. Hits are counted beside it; what "
        "several radars see at once counts once.\n"
        "Each recording belongs to a pose file: they are paired by name (R1.parquet and R1.json, "
        "or the sensor's name in the pose), and where no name fits by their order.\n"
        "The result is a dataset, a folder by the hour, for 'Heat map' and 'Data quality'. Further "
        "recordings of the same site are added to it; the hours that they touch are made again.\n"
        "It holds tracks of single vehicles: a working file. Hand on figures over minutes."
    )
    KEYWORDS = ("fusion", "sensors", "hits", "vehicles", "tracks", "occupancy")
    PARAMETERS = (
        replace(shared.RECORDINGS, about="Of one or more sensors (Parquet or CSV)."),
        shared.POSES,
        shared.TILES,
        replace(shared.MAP, about="The map that the tiles were made from."),
        shared.SCANS,
        shared.SCAN_CRS,
        Switch(
            "HITS_ONLY", "Hits only",
            "Leaves out the vehicles: the maps then show the hit share, not occupancy.",
        ),
        Names(
            "ACCEPT", "Sensors to accept anyway",
            "Goes on although pose and recording of these sensors do not fit: their names, with a "
            "comma between them.",
        ),
        Range(
            "CLEARANCE", "Height of hits over the road, m",
            "-0.5 to 4.5 keeps vehicles, without the tree crowns over the kerb. "
            "The tiles need heights for it.",
            optional=True, advanced=True,
        ),
        Number(
            "MIN_SPEED", "Least speed of hits, m/s",
            "Least absolute range rate; without it what stands counts too.",
        ),
        Number("MIN_RCS", "Least radar cross section of hits, dBm2"),
        Number(
            "ELEVATION_ERROR", "Elevation error of the radars, deg",
            "One standard deviation, 0.5 without it: widens the heights that count with range.",
        ),
        Number("MAX_RANGE", "Range of poses without a view, m"),
        Number("AZIMUTH", "Azimuth of poses without a view, deg"),
        Number("ELEVATION", "Elevation of poses without a view, deg"),
        Text(
            "CYCLE", "Cycles of slow radars",
            "Only for radars under 10 Hz: R3=150ms, with a comma between more.",
        ),
        Text(
            "CLOCKS", "Clocks",
            "Corrects clocks that are off: a file from 'Compare clocks'.",
        ),
        replace(shared.TIMEZONE, about="The site's, such as Europe/Berlin; UTC without."),
        Number("JOBS", "Processes at once", "As cores and memory allow, without it."),
        OutputFolder(
            "OUTPUT", "Dataset", "A folder; one that holds a dataset of the same tiles is added to."
        ),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        self.made = [(tr("Show the folder"), Path(given.outputs["OUTPUT"]))]
        return {}


class ShowVehicles(WorkerAlgorithm):
    """An algorithm that makes a layer of the footprints of vehicles, half second by half second."""

    NAME = "footprints"
    COMMAND = "footprints"
    TITLE = "Vehicles that move on the map"
    GROUP = TRAFFIC
    HELP = (
        "Makes a layer of single vehicles as rectangles of their length and width, which the "
        "temporal controller moves half second by half second: blue are light ones, green heavy "
        "ones, hollow are those that stand, pale those whose place is inferred.\n"
        "It shows tracks of single vehicles: a working file for checks, not to be published. "
        "Hand on figures over minutes."
    )
    KEYWORDS = ("tracks", "animation", "temporal")
    PARAMETERS = (
        shared.DATASET,
        OutputLayer("OUTPUT", "Footprints", "GeoPackage, a row a vehicle and half second."),
    )


class ShowDetections(WorkerAlgorithm):
    """An algorithm that puts the detections of a recording into the map."""

    NAME = "detections"
    COMMAND = "project"
    TITLE = "Detections on the map"
    GROUP = TRAFFIC
    HELP = (
        "Puts each detection of a recording into the map, as points with their measures: a "
        "GeoPackage for QGIS, a point cloud (LAZ) or a table (Parquet) for other programs.\n"
        "A layer of a long recording is large: an hour has millions of points."
    )
    KEYWORDS = ("points", "hits", "projection")
    PARAMETERS = (
        shared.RECORDING,
        shared.POSE,
        Output(
            "OUTPUT", "Detections",
            kinds="GeoPackages (*.gpkg);;Point clouds (*.laz);;Tables (*.parquet)",
        ),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        if given.outputs["OUTPUT"].lower().endswith(".gpkg"):
            load(given.context, given.outputs["OUTPUT"], tr("Detections"))
        return {}


class CheckQuality(WorkerAlgorithm):
    """An algorithm that lists what a dataset rests on, by sensor and hour."""

    NAME = "quality"
    COMMAND = "quality"
    TITLE = "Data quality"
    GROUP = TRAFFIC
    HELP = (
        "Lists what a dataset rests on, a row a sensor and hour: frames, detections, "
        "clocks, poses, and a verdict.\n"
        "What is odd is said in the log, too."
    )
    KEYWORDS = ("health", "gaps", "check")
    PARAMETERS = (
        shared.DATASET,
        replace(
            shared.TIMEZONE, about="Whose hours the rows are, such as Europe/Berlin; UTC without."
        ),
        shared.CSV_LOCALE,
        Output("OUTPUT", "Data quality", kinds="Tables (*.csv *.parquet)"),
    )  # fmt: skip


class KeepDataset(WorkerAlgorithm):
    """An algorithm that says what a dataset holds, and changes its recordings."""

    NAME = "dataset"
    COMMAND = "dataset"
    TITLE = "What a dataset holds"
    GROUP = TRAFFIC
    HELP = (
        "Shows what a dataset holds: sensors, hours, tracks, passages.\n"
        "It finds recordings again that were moved, and withdraws one that does not belong there; "
        "the hours that this touches are made again."
    )
    KEYWORDS = ("withdraw", "relink", "check")
    CHANGES = ("DATASET",)
    PARAMETERS = (
        shared.DATASET,
        Folder(
            "RELINK", "Folder of moved recordings",
            "Recordings that are not where they were are looked for in it.", optional=True,
        ),
        File(
            "WITHDRAW", "Recording to withdraw",
            "The dataset is then as if it had never been measured.", optional=True, advanced=True,
            kinds="Recordings (*.parquet *.csv)",
        ),
        Text("WITHDRAW_SENSOR", "Sensor to withdraw", "All of its recordings."),
        Text("WITHDRAW_DAY", "Day to withdraw", "By the site's clocks, such as 2026-10-05."),
        Switch("CHECK", "Check all files", "Whether each file is as it was written."),
        Result("OUTPUT", "Dataset", kind=QgsProcessingOutputFolder),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        return {"OUTPUT": given.text("DATASET")}


class RunSite(WorkerAlgorithm):
    """An algorithm that makes all results of a site file."""

    NAME = "runsite"
    COMMAND = "run"
    TITLE = "Run a site file"
    GROUP = TRAFFIC
    HELP = (
        "Goes the whole way for all sensors of a site, as its site file (TOML) sets out: road, "
        "tiles, poses, dataset, heat map.\n"
        "The folder also holds a QGIS project that is ready to present."
    )
    KEYWORDS = ("batch", "nightly", "project")
    PARAMETERS = (
        File("SITE", "Site file", flag="", kinds="Site files (*.toml)"),
        Number("JOBS", "Stages at once", "As cores and memory allow, without it."),
        Switch("FRESH", "Do all again", "Also what an earlier run has done."),
        shared.LOAD,
        OutputFolder("OUTPUT", "Results"),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        folder = Path(given.outputs["OUTPUT"])
        if given.is_on("LOAD"):
            title = site_of(folder).get("title")
            load_site(given.context, folder, title or Path(given.text("SITE")).stem)
        projects = sorted(folder.glob("site*.qgz"))
        for path in projects:
            given.feedback.pushInfo(f"{tr('Project that is ready to present:')} {path}")
        self.made = [
            (tr("Open the report"), folder / "report.html"),
            *[(tr("Open the project"), path) for path in projects[-1:]],
            (tr("Make sheets..."), partial(make_sheets, folder)),
            (tr("Show the folder"), folder),
        ]
        return layers_of(folder / "heatmap")


def site_of(folder: Path) -> dict[str, Any]:
    """Return the site of a run as its site file has it, empty where the run does not say."""
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        return dict(record["site"])
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def make_sheets(folder: Path) -> Any:
    """Open the algorithm that prints sheets, filled in for the site of a run."""
    site = site_of(folder)
    sources = [(site.get("map") or {}).get("source"), *(site.get("attribution") or [])]
    texts = {"TITLE": site.get("title"), "SOURCE": "; ".join(filter(None, sources))}
    given = {"HEATMAP": str(folder / "heatmap"), "OUTPUT": str(folder / "sheets")}
    known = {name: text for name, text in texts.items() if text}
    return open_dialog("exportreport", given | known)


def load_site(context: QgsProcessingContext, folder: Path, group: str) -> None:
    """Have QGIS load what a run left in its folder."""
    sensors, footprints = folder / "sensors.gpkg", folder / "footprints.gpkg"
    if sensors.is_file():
        for order, (layer, name) in enumerate(
            (("uncertainty", tr("Uncertainty (95 %)")), ("views", tr("Views")),
             ("sensors", tr("Sensors"))), start=10,
        ):  # fmt: skip
            load(context, f"{sensors}|layername={layer}", name, group=group, order=order)
    if footprints.is_file():
        source = f"{footprints}|layername=footprints"
        load(context, source, tr("Vehicles"), group=group, order=5)
    if (folder / "heatmap" / "heatmap.gpkg").is_file():
        # Vehicles move in shorter steps than the map.
        sets_time = not footprints.is_file()
        load_heatmap(context, folder / "heatmap", group, sets_time=sets_time)
