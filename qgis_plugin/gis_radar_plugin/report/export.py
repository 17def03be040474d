"""Export a heat map's folder to PDF and PNG: a project, its atlas, the files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qgis.core import (
    Qgis,
    QgsFeature,
    QgsFeatureRequest,
    QgsFillSymbol,
    QgsLayoutExporter,
    QgsMapLayer,
    QgsPalLayerSettings,
    QgsPrintLayout,
    QgsProcessingException,
    QgsProject,
    QgsRasterLayer,
    QgsRuleBasedRenderer,
    QgsTextFormat,
    QgsVectorLayer,
    QgsVectorLayerSimpleLabeling,
)
from qgis.PyQt.QtCore import QTimeZone
from qgis.PyQt.QtGui import QColor
from qgis.PyQt.QtXml import QDomDocument

from ..inputs import write_package
from ..loading import as_ground, heatmap_titles, switch_time_on, translate_legend
from ..words import tr
from .folder import PDF
from .pages import Page, local_time

_DRAWN = (QgsVectorLayer, QgsRasterLayer)
# Top to bottom.
SENSOR_TABLES = {"Sensors": "sensors", "Uncertainty (95 %)": "uncertainty", "Views": "views"}
LANE_TABLES = {"Lanes": "lanes", "Stop lines": "stop_lines"}
TILES = "tiles.gpkg"  # of a site's run, beside the folder of the heat map


def heat_layer(package: Path, name: str) -> QgsVectorLayer:
    """Return a layer of a heat map with its style.

    Raises
    ------
    QgsProcessingException
        If it is not there.
    """
    title = heatmap_titles(package.parent).get(name, name)
    layer = _drawn_layer(package, name, title)
    if not layer.isValid():
        raise QgsProcessingException(
            tr("{folder} is no heat map: it has no layer '{layer}'.").format(
                folder=package.parent, layer=name
            )
        )
    translate_legend(layer)
    switch_time_on(layer)
    return layer


def _drawn_layer(package: Path, table: str, title: str) -> QgsVectorLayer:
    """Return a layer with symbols and labels of its file's style, without its forms and actions.

    Those may hold code, and the file may come from elsewhere.
    """
    styled, kinds = QDomDocument(), QgsMapLayer.StyleCategory
    QgsVectorLayer(f"{package}|layername={table}", title, "ogr").exportNamedStyle(styled)
    layer = _bare_layer(package, table, title)
    layer.importNamedStyle(styled, kinds.Symbology | kinds.Labeling)
    return layer


def _bare_layer(package: Path, table: str, title: str) -> QgsVectorLayer:
    options = QgsVectorLayer.LayerOptions()
    options.loadDefaultStyle = False
    return QgsVectorLayer(f"{package}|layername={table}", title, "ogr", options)


def ground_layer(package: Path) -> QgsVectorLayer:
    """Return all tiles in grey."""
    layer = _bare_layer(package, "heatmap", tr("Road, not observed"))
    as_ground(layer)
    return layer


def refuse_no_sensors(package: Path) -> None:
    """Refuse a file without a layer of sensors, in one sentence."""
    if not QgsVectorLayer(f"{package}|layername=sensors", "", "ogr").isValid():
        raise QgsProcessingException(
            tr("{file} is no file of sensors: it has no layer 'sensors'.").format(file=package)
        )


def sensor_layers(package: Path | None) -> list[QgsMapLayer]:
    """Return the layers of a file of sensors, none without one."""
    return _tables(package, SENSOR_TABLES) if package is not None else []


def lane_layers(package: Path) -> list[QgsMapLayer]:
    """Return lanes by number and stop lines, where the tiles of the heat map lie beside it."""
    beside = package.parent.parent / TILES
    counts = [
        _count(QgsVectorLayer(f"{path}|layername={name}", "", "ogr"))
        for path, name in ((beside, "tiles"), (package, "heatmap"))
    ]
    return _tables(beside, LANE_TABLES) if beside.is_file() and counts[0] == counts[1] else []


def _tables(package: Path, names: dict[str, str]) -> list[QgsMapLayer]:
    """Return those of the layers that are there and not empty, by their titles."""
    layers = [_drawn_layer(package, table, tr(name)) for name, table in names.items()]
    return [layer for layer in layers if _count(layer) > 0]


def _count(layer: QgsVectorLayer) -> int:
    """Return how many features a layer has; QGIS itself may not know, and says less than 0."""
    known = int(layer.featureCount()) if layer.isValid() else 0
    if known >= 0:
        return known
    bare = QgsFeatureRequest().setFlags(QgsFeatureRequest.Flag.NoGeometry).setNoAttributes()
    return sum(1 for _ in layer.getFeatures(bare))


def explained(project: QgsProject) -> dict[str, QgsMapLayer]:
    """Return the layers that the legend explains, by the ids of the template, top to bottom."""
    names = {
        "gis_radar_heatmap": [tr("Occupancy, whole time"), tr("Hit share, whole time")],
        "gis_radar_ground": [tr("Road, not observed")],
        **{
            f"gis_radar_{table}": [tr(name)]
            for name, table in {**LANE_TABLES, **SENSOR_TABLES}.items()
        },
    }
    found = {
        key: [layer for name in each for layer in project.mapLayersByName(name)]
        for key, each in names.items()
    }
    return {key: layers[0] for key, layers in found.items() if layers}


def copied(layers: Sequence[QgsMapLayer]) -> list[QgsMapLayer]:
    """Return background layers as a project of its own may hold them, with their style.

    Pages name their layers with bars between them, so each gets a name of its own without bars.
    """
    kept = [layer.clone() for layer in layers if isinstance(layer, _DRAWN)]
    for number, layer in enumerate(kept, start=1):
        layer.setName(f"{layer.name().replace('|', ' ')} ({tr('Background')} {number})")
    return kept


# Of the sheets, on the overview.
_FRAME = {"style": "no", "outline_color": "#1d4ed8", "outline_width": "0.6"}
_IS_OTHER = "\"place\" <> attribute(@atlas_feature, 'place')"
_PAGE = "Polygon?" + "&".join(
    f"field={name}" for name in (
        "place:string", "file:string", "time:string", "note:string", "layers:string",
        "begin:datetime", "end:datetime", "whole:boolean",
    )
)  # fmt: skip


def write_pages(
    path: Path, pages: Sequence[Page], layers: dict[bool, str], crs: Any, zone: QTimeZone
) -> QgsVectorLayer:
    """Write the pages as the layer that the atlas runs over, and open it."""
    written = QgsVectorLayer(_PAGE, "pages", "memory")
    written.setCrs(crs)
    rows = []
    for page in pages:
        row = QgsFeature(written.fields())
        row.setGeometry(page.place.frame)
        time = local_time(page.begin, page.end, zone)
        row.setAttributes([
            page.place.name, page.file_name(), time, tr("whole time"),
            f"{tr('Pages')}|{layers[page.whole]}" if page.place.marks else layers[page.whole],
            page.begin, page.end, page.whole,
        ])  # fmt: skip
        rows.append(row)
    written.dataProvider().addFeatures(rows)
    write_package(written, str(path), "pages")
    layer = QgsVectorLayer(f"{path}|layername=pages", tr("Pages"), "ogr")
    _mark_others(layer)
    return layer


def _mark_others(layer: QgsVectorLayer) -> None:
    """Draw the frames of the places of other pages, with their names in the upper left corner."""
    root = QgsRuleBasedRenderer.Rule(None)
    frames = QgsRuleBasedRenderer.Rule(QgsFillSymbol.createSimple(_FRAME))
    frames.setFilterExpression(_IS_OTHER)
    root.appendChild(frames)
    layer.setRenderer(QgsRuleBasedRenderer(root))
    names = QgsPalLayerSettings()
    names.isExpression, names.fieldName = True, f'if({_IS_OTHER}, "place", NULL)'
    names.geometryGeneratorEnabled = True
    names.geometryGenerator = "make_point(x_min($geometry), y_max($geometry))"
    names.geometryGeneratorType = Qgis.GeometryType.Point
    names.placement = Qgis.LabelPlacement.OverPoint
    names.quadOffset = Qgis.LabelQuadrantPosition.BelowRight
    names.xOffset = 1.0  # mm, off the frame
    look = QgsTextFormat()
    look.setColor(QColor(_FRAME["outline_color"]))
    look.setSize(9.0)
    names.setFormat(look)
    layer.setLabeling(QgsVectorLayerSimpleLabeling(names))
    layer.setLabelsEnabled(True)


def export(layout: QgsPrintLayout, folder: Path, dpi: float, feedback: Any) -> list[Path]:
    """Write the atlas as one PDF and a PNG a page.

    Returns
    -------
    list of Path
        The files, the PDF first.
    """
    atlas = layout.atlas()
    pdf = folder / PDF
    sheets = QgsLayoutExporter.PdfExportSettings()
    sheets.dpi = dpi
    sheets.rasterizeWholeImage = False
    _checked(QgsLayoutExporter.exportToPdf(atlas, str(pdf), sheets, feedback), pdf, feedback)
    pictures = QgsLayoutExporter.ImageExportSettings()
    pictures.dpi = dpi
    base = folder / "page.png"  # only its folder counts: each page has a name of its own
    done = QgsLayoutExporter.exportToImage(atlas, str(base), "png", pictures, feedback)
    _checked(done, base, feedback)
    return [pdf, *sorted(folder.glob("*.png"))]


def _checked(done: tuple[Any, str], path: Path, feedback: Any) -> None:
    result, reason = done
    if feedback.isCanceled() or result == QgsLayoutExporter.ExportResult.Canceled:
        raise QgsProcessingException(tr("Cancelled; nothing was left half-written."))
    if result != QgsLayoutExporter.ExportResult.Success:
        raise QgsProcessingException(f"{path}: {tr('cannot be written')}: {reason or result}")
