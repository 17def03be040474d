"""Algorithms of a site: its tiles, its road, where its radars stand and what they see."""

from __future__ import annotations

import html
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingException,
    QgsProcessingOutputHtml,
    QgsProcessingUtils,
)

from ..base import SITE, WorkerAlgorithm, readable
from ..loading import load
from ..parameters import (
    Bearing,
    Choice,
    Field,
    Files,
    Given,
    Layer,
    Number,
    Output,
    OutputLayer,
    Point,
    Result,
    Text,
)
from ..runner import Answer
from ..words import tr
from . import shared


class SplitLanelets(WorkerAlgorithm):
    """An algorithm that makes a layer of tiles, and one of problems, of a Lanelet2 map."""

    NAME = "splitlanelets"
    COMMAND = "tiles"
    TITLE = "Split lanelets into tiles"
    GROUP = SITE
    HELP = (
        "Splits the lanes of a Lanelet2 map into tiles of half a metre, the unit of statistics.\n"
        "The layer 'problems' of the same file lists what was mended or left out of the map.\n"
        "With a scanned road (from 'Mask road from airborne scan') the tiles have a height."
    )
    KEYWORDS = ("hd map", "osm", "lanes")
    PARAMETERS = (
        replace(shared.MAP, flag="", about="The HD map as an OSM file."),
        replace(
            shared.ROAD, optional=True,
            about="Gives the tiles' heights; needed to filter by height over the road.",
        ),
        Number("LENGTH", "Length of a tile, m", optional=False, default=0.5, limits=(0.05, 100.0)),
        shared.CRS,
        Text(
            "SUBTYPE", "Lanelets of subtype",
            "Such as road,highway; without it all but those for pedestrians and bicycles.",
        ),
        shared.ORIGIN,
        Layer(
            "STREETS", "Streets", "Lines with names, for lanes that the map does not name.",
            optional=True, advanced=True, source=QgsProcessing.SourceType.TypeVectorLine,
            layer="streets", metric=False,
        ),
        Field(
            "STREET_FIELD", "Field with their names", optional=True, advanced=True, of="STREETS"
        ),
        OutputLayer("OUTPUT", "Tiles", "GeoPackage with the layers 'tiles' and 'problems'."),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        mended = answer.summary.get("repaired", 0) + answer.summary.get("left_out", 0)
        if mended and given.is_loaded("OUTPUT"):
            problems = f"{given.outputs['OUTPUT']}|layername=problems"
            load(given.context, problems, tr("Problems of the map"), visible=False)
        return {"TILES": answer.summary.get("tiles", 0)}


@dataclass(frozen=True)
class Roads(Layer):
    """Polygons of roads, in place of a map; in degrees only where they are moved into a system."""

    def words(self, given: Given) -> list[str]:
        if given.has("MAP") == given.has(self.name):
            raise QgsProcessingException(
                tr("Choose either a Lanelet2 map or a layer of road polygons.")
            )
        if given.has("MAP"):
            return []
        path = self.file(given, metric=not shared.CRS.words(given))
        return [*self._option(path), "--layer", self.layer]


class MaskRoad(WorkerAlgorithm):
    """An algorithm that cuts the road's surface out of an airborne scan."""

    NAME = "maskroad"
    COMMAND = "mask"
    TITLE = "Mask road from airborne scan"
    GROUP = SITE
    HELP = (
        "Keeps the road of an airborne laser scan (LAS, LAZ, COPC): one point each half metre, at "
        "the height of its surface.\n"
        "What is road is given by a Lanelet2 map, or by a layer of polygons, which may be "
        "filtered, selected or in memory.\n"
        "The result is a LAZ file, which the other algorithms read."
    )
    KEYWORDS = ("lidar", "laz", "point cloud")
    PARAMETERS = (
        Files("SCANS", "Airborne scans", "One or more LAS or LAZ files of the site.", ""),
        replace(shared.MAP, about="The HD map; or choose road polygons below.", optional=True),
        Roads(
            "ROADS", "Road polygons", "A layer of polygons, in place of the map.", "--map",
            optional=True, layer="roads",
        ),
        shared.SCAN_CRS,
        shared.CRS,
        shared.ORIGIN,
        Choice(
            "ENGINE", "Who reads the scans", "auto takes PDAL where there is one.",
            choices=("auto", "pdal", "laspy"),
        ),
        Output("OUTPUT", "Road", "The road's surface as LAZ.", kinds="Point clouds (*.laz)"),
    )  # fmt: skip


class LocalizeRadar(WorkerAlgorithm):
    """An algorithm that finds a sensor's pose from a recording and a click."""

    NAME = "localizeradar"
    COMMAND = "localize"
    TITLE = "Localize a radar"
    GROUP = SITE
    HELP = (
        "Finds where a radar stands and looks, from 100 s of traffic: click where it stands, "
        "within 15 m.\n"
        "The result is a pose file and a layer: an arrow where the radar looks, its view, and the "
        "ellipse in which it stands with 95 % probability. The figure shows the traces of the "
        "vehicles over lanes and scan: they must lie on the lanes.\n"
        "Where the scene fits two places, or holds too little traffic, the reason is given instead "
        "of an answer."
    )
    KEYWORDS = ("pose", "calibration", "georeference")
    PARAMETERS = (
        shared.RECORDING,
        Point(
            "GUESS", "Where the radar stands",
            "Click it on the map (the button with three dots), within 15 m.",
        ),
        shared.MAP,
        shared.ROAD,
        replace(
            shared.SCANS,
            about="Whole and not masked, to check the pose: what stands around the radar is "
            "compared with their trees and walls.",
        ),
        Bearing(
            "COMPASS", "Compass bearing",
            "Where the radar looks, if known: degrees clockwise from true north, or a word "
            "such as north-east. Without it the direction is searched.",
            advanced=False,
        ),
        Number(
            "HEADING", "Heading from grid east, deg",
            "The same, anticlockwise from grid east; give one of the two.",
        ),
        Choice(
            "METHOD", "Method", choices=("lane", "icp"),
            labels=("lanes and Doppler", "ICP of the paper"),
        ),
        shared.ORIGIN,
        shared.SCAN_CRS,
        Output("POSE", "Pose", kinds="Poses (*.json)"),
        Output("FIGURE", "Figure", flag="--figure", kinds="Pictures (*.png)"),
        OutputLayer("OUTPUT", "Sensor", flag=None),
        Result("REPORT", "How it was found", kind=QgsProcessingOutputHtml),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        dest = given.outputs["OUTPUT"]
        self.work(["sensors", given.outputs["POSE"], "-o", dest], [dest], given.feedback)
        if given.is_loaded("OUTPUT"):
            for layer, name in (("views", tr("View")), ("uncertainty", tr("Uncertainty (95 %)"))):
                load(given.context, f"{dest}|layername={layer}", name)
        return {"REPORT": write_page(given.outputs["FIGURE"], answer.summary)}


def write_page(figure: str, summary: dict[str, Any]) -> str:
    """Write figure and numbers as a page for QGIS's results viewer; return where."""
    rows = "".join(
        f"<tr><td>{html.escape(tr(name.replace('_', ' ')))}</td>"
        f"<td>{html.escape(readable(value))}</td></tr>"
        for name, value in summary.items()
    )
    path = Path(QgsProcessingUtils.generateTempFilename("localization.html"))
    path.write_text(
        f'<html><meta charset="utf-8"><body><table>{rows}</table>'
        f'<img src="{Path(figure).as_uri()}" width="900"></body></html>',
        encoding="utf-8",
    )
    return str(path)


class FollowPose(WorkerAlgorithm):
    """An algorithm that corrects a sensor's pose every 5 s, and notices when it was moved."""

    NAME = "trackpose"
    COMMAND = "track"
    TITLE = "Follow a pose"
    GROUP = SITE
    HELP = (
        "Follows where a radar stands and looks through a recording: a corrected pose every 5 s, "
        "and a remark where it was knocked or moved.\n"
        "The result is a pose track (CSV), which the other algorithms take wherever they take a "
        "pose."
    )
    KEYWORDS = ("pose", "drift", "alignment")
    PARAMETERS = (
        shared.RECORDING,
        replace(shared.POSE, about="Where it stands at the beginning."),
        shared.MAP,
        shared.ROAD,
        shared.ORIGIN,
        Output("OUTPUT", "Pose track", kinds="Pose tracks (*.csv)"),
        Output(
            "FIGURE", "Figure", "The pose over time, with its error.", "--figure", optional=True,
            kinds="Pictures (*.png)",
        ),
    )  # fmt: skip


class FindSight(WorkerAlgorithm):
    """An algorithm that finds which tiles sensors see, and which something hides."""

    NAME = "sight"
    COMMAND = "sight"
    TITLE = "What sensors see"
    GROUP = SITE
    HELP = (
        "Finds which tiles radars see from where they stand, and which are hidden by what stands "
        "in an airborne scan: houses, walls, trees."
    )
    KEYWORDS = ("visibility", "line of sight", "viewshed")
    PARAMETERS = (
        replace(shared.POSES, about="Of each sensor: pose files (JSON) or pose tracks (CSV)."),
        replace(shared.TILES, about="From 'Split lanelets into tiles', with heights."),
        shared.SCANS,
        shared.SCAN_CRS,
        OutputLayer("OUTPUT", "Sight", "GeoPackage, a row a sensor and tile."),
    )  # fmt: skip
