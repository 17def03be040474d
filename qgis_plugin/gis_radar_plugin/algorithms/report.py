"""Export report: a heat map as sheets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsGeometry,
    QgsLayoutItemMap,
    QgsLayoutObject,
    QgsPrintLayout,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProject,
    QgsProperty,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QDateTime, QTimeZone

from ..base import RESULTS, WorkerAlgorithm, make_folders, one_sentence
from ..parameters import (
    Choice,
    Field,
    File,
    Folder,
    Given,
    Layer,
    Layers,
    Number,
    OutputFolder,
    Result,
    Text,
)
from ..report.export import (
    INTERVALS,
    WHOLE,
    copied,
    export,
    lanes_beside,
    layer_of,
    layers_of_page,
    refuse_no_sensors,
    write_pages,
)
from ..report.folder import PAGES, PDF, PROJECT, move, private_folder, refuse_foreign
from ..report.pages import (
    Page,
    Place,
    junction_places,
    labels_of,
    pages_of,
    places_of,
    recorded_in,
    timezone,
    zone_name,
)
from ..timeline import intervals_of
from ..words import speaks_german, tr

MOST_PAGES = 2000
JUNCTIONS = 0  # what the pages go over


class ExportReport(WorkerAlgorithm):
    """An algorithm that prints sheets over places and intervals, as PDF and PNG."""

    NAME = "exportreport"
    TITLE = "Export report"
    GROUP = RESULTS
    HELP = (
        "Prints a heat map as sheets: map, legend, scale bar, north arrow, title, source and time, "
        "a page for each junction, and if you wish for each interval.\n"
        "Junctions are found where lanes cross; the first pages show the whole map, and where the "
        "others lie. In their place a layer of points or polygons with a name will do, such as "
        "places drawn by hand.\n"
        "The folder gets one PDF, a PNG a page, and a project with the print layout, to change it "
        "by hand. It needs no window, so that qgis_process can run it every night."
    )
    KEYWORDS = ("print", "layout", "atlas", "pdf", "png")

    PARAMETERS = (
        Folder("HEATMAP", "Heat map", "A folder from 'Heat map'."),
        Choice(
            "OVER", "Pages over", "Junctions are found where observed lanes cross.", advanced=False,
            labels=("the whole map and its junctions", "the whole map"),
        ),
        Layer(
            "PLACES", "Places of your own",
            "In place of what is chosen above: points or polygons, a page each.", optional=True,
            source=QgsProcessing.SourceType.TypeVectorAnyGeometry,
        ),
        Field("NAME", "Field with their names", optional=True, of="PLACES"),
        Number(
            "RADIUS", "Room around a place, m", optional=False, advanced=False, default=60.0,
            limits=(1.0,),
        ),
        Choice(
            "WHAT", "Pages", "Each interval makes a page for each place: soon dozens.",
            advanced=False, default=1,
            labels=("whole time and each interval", "whole time", "each interval"),
        ),
        Text("TITLE", "Title", "Without one that of the heat map.", advanced=False),
        Text("SOURCE", "Source", "Without one those of the heat map.", advanced=False),
        Text(
            "TIME_ZONE", "Time zone", "Such as Europe/Berlin; without one that of the heat map.",
            advanced=False,
        ),
        File(
            "SENSORS", "Sensors",
            "The GeoPackage from 'Localize a radar' or of a site's run, shown on top.",
            optional=True, kinds="GeoPackages (*.gpkg)",
        ),
        Layers("BACKGROUND", "Background", "Layers below the heat map, such as a base map.",
               optional=True),
        Number("DPI", "Resolution, dpi", optional=False, default=200.0, limits=(50.0, 1200.0)),
        OutputFolder("OUTPUT", "Report", "A folder."),
        Result("PDF", "Report as PDF", kind=QgsProcessingOutputFile),
    )  # fmt: skip

    def flags(self) -> Any:
        """Run in the main thread, which layouts need."""
        return super().flags() | QgsProcessingAlgorithm.Flag.FlagNoThreading

    def process(self, given: Given) -> dict[str, Any]:
        try:
            dest = self._report(given)
        except QgsProcessingException as error:
            reason = str(error)
        else:
            self.made = [
                (tr("Open the sheets"), dest / PDF), (tr("Open the project"), dest / PROJECT),
                (tr("Show the folder"), dest),
            ]  # fmt: skip
            return {"OUTPUT": str(dest), "PDF": str(dest / PDF)}
        # QGIS never lets go of an exception's traceback, nor of the project in its frames: a
        # project that outlives QGIS makes it crash as it closes. So the exception is a new one.
        raise QgsProcessingException(reason)

    def _report(self, given: Given) -> Path:
        dest, feedback = Path(given.text("OUTPUT")), given.feedback
        zone = timezone(given.text("TIME_ZONE") or zone_name(_package(given)))
        with one_sentence():
            make_folders([str(dest)])
            refuse_foreign(dest)
            # Beside the target first: a report appears whole or not at all.
            with private_folder(dest) as folder:
                project, pages = self._project(given, folder, zone)
                title, _ = title_and_source(given)
                layout = drive_layout(project, pages, title=title, made=_today(zone))
                feedback.pushInfo(tr("{count} pages").format(count=pages.featureCount()))
                files = export(layout, folder, given.number("DPI"), feedback)
                project.write(str(folder / PROJECT))
                project.clear()  # lets go of the files
                del layout
                move(folder, dest)
        feedback.pushInfo("\n".join(str(dest / path.name) for path in files))
        text = tr("The sheets are in {folder}; the report is {pdf}.")
        feedback.pushInfo(text.format(folder=dest, pdf=dest / PDF))
        return dest

    def _project(
        self, given: Given, folder: Path, zone: QTimeZone
    ) -> tuple[QgsProject, QgsVectorLayer]:
        """Return the project that gis_radar writes of the heat map, and the pages in it."""
        package, path = _package(given), str(folder / PROJECT)
        title, source = title_and_source(given)
        words = ["qgis", str(package.parent), "-o", path, "--title", title, "--source", source]
        words += ["--language", "de" if speaks_german() else "en"]
        words += ["--timezone", bytes(zone.id()).decode()]
        for option, file in (("--sensors", _sensors(given)), ("--lanes", lanes_beside(package))):
            words += [option, str(file)] if file is not None else []
        self.work(words, [], given.feedback)
        project = QgsProject()
        if not project.read(path):
            raise QgsProcessingException(tr("{}: cannot be read").format(path))
        project.setTransformContext(given.context.transformContext())
        known = given.parameters, "BACKGROUND", given.context
        below = copied(given.algorithm.parameterAsLayerList(*known) or [])
        for layer in below:
            project.addMapLayer(layer, False)
            project.layerTreeRoot().addLayer(layer)  # at the bottom
        whole, each = layer_of(project, WHOLE), layer_of(project, INTERVALS)
        shown = {one: layers_of_page(project, below, whole=one) for one in (True, False)}
        pages = _pages(given, whole, each)
        layer = write_pages(folder / PAGES, pages, shown, whole.crs(), zone)
        project.addMapLayer(layer)
        project.layerTreeRoot().findLayer(layer.id()).setItemVisibilityChecked(False)
        return project, layer


def title_and_source(given: Given) -> tuple[str, str]:
    """Return title and source: as given, else of the heat map, else general ones."""
    known = labels_of(_package(given))
    title = str(known.get("title") or "") or tr("Traffic on the lanes")
    sources = known.get("sources")
    named = "; ".join(map(str, sources)) if isinstance(sources, list) else ""
    source = named or tr("roadside radar, gis_radar")
    return given.text("TITLE") or title, given.text("SOURCE") or source


def _package(given: Given) -> Path:
    return Path(given.text("HEATMAP")) / "heatmap.gpkg"


def _pages(given: Given, whole: QgsVectorLayer, each: QgsVectorLayer) -> list[Page]:
    places, what = _places(given, whole), given.place("WHAT")
    recorded = recorded_in(_package(given))
    pages = list(
        pages_of(places, intervals_of(each), whole=what != 2, each=what != 1, recorded=recorded)
    )
    if len(pages) > MOST_PAGES:
        text = tr("{count} pages are more than {most}: take fewer places or longer intervals.")
        raise QgsProcessingException(text.format(count=len(pages), most=MOST_PAGES))
    return pages


def _places(given: Given, whole: QgsVectorLayer) -> list[Place]:
    """Return what the pages show: the user's places, or the whole map and what is in it."""
    radius_m = given.number("RADIUS")
    source = given.algorithm.parameterAsSource(given.parameters, "PLACES", given.context)
    if source is not None:
        return places_of(source, given.first("NAME"), radius_m, whole.crs())
    if given.has("PLACES"):
        raise QgsProcessingException(tr("The layer of places cannot be read."))
    junctions = junction_places(whole, radius_m) if given.place("OVER") == JUNCTIONS else []
    frame = QgsGeometry.fromRect(_observed_extent(whole))
    return [Place(tr("Overview"), frame, marks=bool(junctions)), *junctions]


def _sensors(given: Given) -> Path | None:
    """Return the file of sensors: the one named, or a run's own beside the heat map."""
    if named := given.text("SENSORS"):
        refuse_no_sensors(Path(named))
        return Path(named)
    beside = Path(given.text("HEATMAP")).parent / "sensors.gpkg"
    return beside if beside.is_file() else None


def _observed_extent(layer: QgsVectorLayer) -> Any:
    """Return the box around the tiles that were observed, or around all where none was."""
    part = layer.clone()
    part.setSubsetString('"observed_s" > 0')
    part.updateExtents(True)
    extent = part.extent()
    return layer.extent() if extent.isEmpty() else extent


def _today(zone: QTimeZone) -> str:
    now = QDateTime.currentDateTimeUtc().toTimeZone(zone)
    day = "dd.MM.yyyy" if speaks_german() else "yyyy-MM-dd"
    return str(now.toString(day))


NAME = "Report"


def drive_layout(
    project: QgsProject, pages: QgsVectorLayer, *, title: str, made: str
) -> QgsPrintLayout:
    """Let the layout of gis_radar's project go over pages; return it.

    Parameters
    ----------
    project : QgsProject
        Holds all layers, and the layout.
    pages : QgsVectorLayer
        A row a page; see :mod:`report.export`.
    title, made : str
        Heading of all pages, and when they were made.
    """
    (layout,) = project.layoutManager().printLayouts()
    layout.setName(NAME)
    _drive_map(layout.itemById("map"), pages)
    label: Any = layout.itemById
    label("title").setText(f'{_literal(title)}: [% "place" %]')
    label("time").setText('[% "time" %][% if("whole", \' · \' || "note", \'\') %]')
    number = "[% @atlas_featurenumber %] / [% @atlas_totalfeatures %]"
    label("made").setText(f"{made} · {number}")
    atlas = layout.atlas()
    atlas.setCoverageLayer(pages)
    atlas.setEnabled(True)
    atlas.setHideCoverage(True)
    atlas.setPageNameExpression('"place" || \' \' || "time"')
    atlas.setFilenameExpression('"file"')
    return layout


def _drive_map(chart: QgsLayoutItemMap, pages: QgsVectorLayer) -> None:
    """Let extent, time and layers of the map follow from the row of a page."""
    chart.setKeepLayerSet(False)
    chart.setLayers([])
    chart.zoomToExtent(pages.extent())
    chart.setAtlasDriven(True)
    chart.setAtlasScalingMode(QgsLayoutItemMap.AtlasScalingMode.Auto)
    chart.setAtlasMargin(0.04)
    chart.setIsTemporal(True)
    given = chart.dataDefinedProperties()
    kinds = QgsLayoutObject.DataDefinedProperty
    given.setProperty(kinds.StartDateTime, QgsProperty.fromField("begin"))
    given.setProperty(kinds.EndDateTime, QgsProperty.fromField("end"))
    given.setProperty(kinds.MapLayers, QgsProperty.fromField("layers"))
    chart.setDataDefinedProperties(given)


def _literal(text: str) -> str:
    """Return a text that QGIS prints as it is, instead of evaluating what is in `[%` and `%]`."""
    return text.replace("[%", "[% '[' || '%' %]")
