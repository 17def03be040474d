"""Export report: a heat map as sheets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsGeometry,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeatureSource,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterField,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
    QgsProject,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QDateTime, QTimeZone

from ..base import RESULTS, Algorithm, one_sentence
from ..claims import claimed
from ..loading import INTERVALS
from ..report.export import (
    PAGES,
    PDF,
    PROJECT,
    copied,
    explained,
    export,
    ground_layer,
    heat_layer,
    lane_layers,
    refuse_no_sensors,
    sensor_layers,
    write_pages,
)
from ..report.folder import earlier, move, private_folder
from ..report.layout import Texts, make_layout
from ..report.pages import (
    Page,
    Place,
    junction_places,
    pages_of,
    places_of,
    recorded_in,
    timezone,
    zone_name,
)
from ..timeline import intervals_of
from ..words import speaks_german, tr

MOST_PAGES = 2000
JUNCTIONS, SENSORS = 0, 1  # what the pages go over


class ExportReport(Algorithm):
    """An algorithm that prints sheets over places and intervals, as PDF and PNG."""

    NAME = "exportreport"
    TITLE = "Export report"
    GROUP = RESULTS
    HELP = (
        "Prints a heat map as sheets: map, legend, scale bar, north arrow, title, source and time, "
        "one page for each junction or sensor and each interval.\n"
        "Junctions are found where lanes cross; the first pages show the whole map. In their place "
        "a layer of points or polygons with a name will do, such as places drawn by hand.\n"
        "The folder gets one PDF, a PNG a page, and a project with the print layout, to change it "
        "by hand. It needs no window, so that qgis_process can run it every night."
    )
    KEYWORDS = ("print", "layout", "atlas", "pdf", "png")

    def flags(self) -> Any:
        """Keep to the main thread, as layouts need."""
        return super().flags() | QgsProcessingAlgorithm.Flag.FlagNoThreading

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self._add_pages()
        self._add_texts()
        self._add_layers()
        self.add(QgsProcessingParameterFolderDestination("OUTPUT", tr("Report")), about="A folder.")
        self.addOutput(QgsProcessingOutputFile("PDF", tr("Report as PDF")))

    def _add_pages(self) -> None:
        anything = QgsProcessing.SourceType.TypeVectorAnyGeometry
        number = QgsProcessingParameterNumber.Type.Double
        folder = QgsProcessingParameterFile.Behavior.Folder
        self.add(
            QgsProcessingParameterFile("HEATMAP", tr("Heat map"), folder),
            about="A folder from 'Heat map'.",
        )
        self.add(
            QgsProcessingParameterEnum(
                "OVER", tr("Pages over"),
                [tr("the whole map and its junctions"), tr("the whole map and the sensors"),
                 tr("the whole map")],
                defaultValue=0,
            ),
            about="Junctions are found where observed lanes cross.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterFeatureSource(
                "PLACES", tr("Places of your own"), [anything], optional=True
            ),
            about="In place of what is chosen above: points or polygons, a page each.",
        )
        self.add(
            QgsProcessingParameterField(
                "NAME", tr("Field with their names"), parentLayerParameterName="PLACES",
                optional=True,
            )
        )  # fmt: skip
        self.add(
            QgsProcessingParameterNumber("RADIUS", tr("Room around a place, m"), number, 60.0,
                                         minValue=1.0)
        )  # fmt: skip
        self.add(
            QgsProcessingParameterEnum(
                "WHAT", tr("Pages"),
                [tr("whole time and each interval"), tr("whole time"), tr("each interval")],
                defaultValue=1,
            ),
            about="Each interval makes a page for each place: soon dozens.",
        )  # fmt: skip

    def _add_texts(self) -> None:
        self.add(QgsProcessingParameterString("TITLE", tr("Title"), tr("Traffic on the lanes")))
        self.add(
            QgsProcessingParameterString("SOURCE", tr("Source"), tr("roadside radar, gis_radar"))
        )
        self.add(
            QgsProcessingParameterString("TIME_ZONE", tr("Time zone"), optional=True),
            about="Such as Europe/Berlin; without one that of the heat map.",
        )

    def _add_layers(self) -> None:
        number = QgsProcessingParameterNumber.Type.Double
        self.add(
            QgsProcessingParameterFile(
                "SENSORS", tr("Sensors"), extension="gpkg", optional=True
            ),
            about="The GeoPackage from 'Localize a radar' or of a site's run, shown on top.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterMultipleLayers("BACKGROUND", tr("Background"), optional=True),
            about="Layers below the heat map, such as a base map.",
        )
        self.add(
            QgsProcessingParameterNumber("DPI", tr("Resolution, dpi"), number, 200.0,
                                         minValue=50.0, maxValue=1200.0),
            advanced=True,
        )  # fmt: skip

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        try:
            return self._report(parameters, context, feedback)
        except QgsProcessingException as error:
            reason = str(error)
        # QGIS never lets go of an exception's traceback, nor of the project in its frames: a
        # project that outlives QGIS makes it crash as it closes. So the exception is a new one.
        raise QgsProcessingException(reason)

    def _report(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = Path(self.parameterAsString(parameters, "OUTPUT", context))
        package = Path(self.parameterAsFile(parameters, "HEATMAP", context)) / "heatmap.gpkg"
        named = self.parameterAsString(parameters, "TIME_ZONE", context).strip()
        zone = timezone(named or zone_name(package))
        with one_sentence(), claimed([str(dest)]):
            self._refuse_foreign(dest)
            # Beside the target first: a report appears whole or not at all.
            with private_folder(dest) as folder:
                project, pages = self._project(parameters, context, folder, zone)
                texts = Texts(
                    title=self.parameterAsString(parameters, "TITLE", context),
                    source=self.parameterAsString(parameters, "SOURCE", context),
                    made=_today(zone),
                )
                legend = explained(project)
                layout = make_layout(project, pages, legend, texts)
                dpi = self.parameterAsDouble(parameters, "DPI", context)
                feedback.pushInfo(tr("{count} pages").format(count=pages.featureCount()))
                files = export(layout, folder, dpi, feedback)
                project.write(str(folder / PROJECT))
                names = [path.name for path in files]
                project.clear()  # lets go of the files
                del layout
                move(folder, dest)
        feedback.pushInfo("\n".join(str(dest / name) for name in names))
        text = tr("The sheets are in {folder}; the report is {pdf}.")
        feedback.pushInfo(text.format(folder=dest, pdf=dest / PDF))
        self.made = [
            (tr("Open the sheets"), dest / PDF),
            *[(tr("Open the project"), path) for path in sorted(dest.glob("*.qgz"))[:1]],
            (tr("Show the folder"), dest),
        ]
        return {"OUTPUT": str(dest), "PDF": str(dest / PDF)}

    def _project(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        folder: Path,
        zone: QTimeZone,
    ) -> tuple[QgsProject, QgsVectorLayer]:
        """Return a project with all layers, and the layer of pages."""
        package = Path(self.parameterAsFile(parameters, "HEATMAP", context)) / "heatmap.gpkg"
        whole, each = heat_layer(package, "heatmap"), heat_layer(package, INTERVALS)
        above = sensor_layers(self._sensors(parameters, context)) + lane_layers(package)
        below = copied(self.parameterAsLayerList(parameters, "BACKGROUND", context) or [])
        project = QgsProject()
        project.setCrs(whole.crs())
        project.setTransformContext(context.transformContext())
        ground = ground_layer(package)
        for layer in (*above, each, whole, ground, *below):
            project.addMapLayer(layer)
        shown = {
            one: "|".join(
                layer.name() for layer in (*above, whole if one else each, ground, *below)
            )
            for one in (True, False)
        }
        pages = self._pages(parameters, context, package, whole, each)
        layer = write_pages(folder / PAGES, pages, shown, whole.crs(), zone)
        project.addMapLayer(layer)
        project.layerTreeRoot().findLayer(layer.id()).setItemVisibilityChecked(False)
        return project, layer

    def _pages(
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        package: Path,
        whole: QgsVectorLayer,
        each: QgsVectorLayer,
    ) -> list[Page]:
        places = self._places(parameters, context, whole)
        what = self.parameterAsEnum(parameters, "WHAT", context)
        spans, recorded = intervals_of(each), recorded_in(package)
        pages = list(pages_of(places, spans, whole=what != 2, each=what != 1, recorded=recorded))
        if len(pages) > MOST_PAGES:
            text = tr("{count} pages are more than {most}: take fewer places or longer intervals.")
            raise QgsProcessingException(text.format(count=len(pages), most=MOST_PAGES))
        return pages

    def _places(
        self, parameters: dict[str, Any], context: QgsProcessingContext, whole: QgsVectorLayer
    ) -> list[Place]:
        """Return what the pages show: the user's places, or the whole map and what is in it."""
        radius = self.parameterAsDouble(parameters, "RADIUS", context)
        source = self.parameterAsSource(parameters, "PLACES", context)
        if source is not None:
            names = self.parameterAsStrings(parameters, "NAME", context)
            return places_of(source, names[0] if names else "", radius, whole.crs())
        if parameters.get("PLACES") not in (None, ""):
            raise QgsProcessingException(tr("The layer of places cannot be read."))
        overview = Place(tr("Overview"), QgsGeometry.fromRect(_observed_extent(whole)))
        over = self.parameterAsEnum(parameters, "OVER", context)
        if over == JUNCTIONS:
            return [overview, *junction_places(whole, radius)]
        if over == SENSORS:
            package = self._sensors(parameters, context)
            if package is None:
                raise QgsProcessingException(tr("There are no sensors: name their file."))
            points = QgsVectorLayer(f"{package}|layername=sensors", tr("Sensors"), "ogr")
            source = QgsProcessingFeatureSource(points, context)
            return [overview, *places_of(source, "", radius, whole.crs())]
        return [overview]

    def _sensors(self, parameters: dict[str, Any], context: QgsProcessingContext) -> Path | None:
        """Return the file of sensors: the one named, or a run's own beside the heat map."""
        named = self.parameterAsFile(parameters, "SENSORS", context)
        if named:
            refuse_no_sensors(Path(named))
            return Path(named)
        heat = Path(self.parameterAsFile(parameters, "HEATMAP", context))
        beside = heat.parent / "sensors.gpkg"
        return beside if beside.is_file() else None

    @staticmethod
    def _refuse_foreign(folder: Path) -> None:
        """Refuse a folder that holds other things than an earlier report."""
        if not folder.is_dir():
            return
        other = {path.name for path in folder.iterdir()} - earlier(folder)
        if other:
            text = tr("{folder}: holds '{name}', which is not part of a report: name a new folder.")
            raise QgsProcessingException(text.format(folder=folder, name=min(other)))


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
