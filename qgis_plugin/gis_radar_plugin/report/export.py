"""Export a heat map's folder to PDF and PNG: a project, its atlas, the files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from osgeo import ogr
from qgis.core import (
    Qgis,
    QgsFeature,
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

from ..inputs import write_package
from ..words import tr
from .folder import PDF
from .pages import Page, local_time

_DRAWN = (QgsVectorLayer, QgsRasterLayer)
# Ids of the layers of a page in gis_radar's project, top to bottom; WHOLE or INTERVALS in between.
ABOVE = ("sensors", "uncertainty", "views", "lanes", "stop_lines")
WHOLE, INTERVALS, GROUND = "heatmap", "by_interval", "ground"
TILES = "tiles.gpkg"  # of a site's run, beside the folder of the heat map


def layer_of(project: QgsProject, table: str) -> Any:
    """Return a layer of gis_radar's project, None where it has none of a table."""
    return project.mapLayer(f"gis_radar_{table}")


def refuse_no_sensors(package: Path) -> None:
    """Refuse a file without a layer of sensors, in one sentence."""
    if not QgsVectorLayer(f"{package}|layername=sensors", "", "ogr").isValid():
        raise QgsProcessingException(
            tr("{file} is no file of sensors: it has no layer 'sensors'.").format(file=package)
        )


def lanes_beside(package: Path) -> Path | None:
    """Return the file with lanes and stop lines, where the tiles of the heat map lie beside it."""
    beside = package.parent.parent / TILES
    counts = [_count(path, table) for path, table in ((beside, "tiles"), (package, "heatmap"))]
    return beside if counts[0] == counts[1] != -1 else None


def _count(package: Path, table: str) -> int:
    """Return how many rows a table has, -1 without one; QGIS itself may not know."""
    data = ogr.Open(str(package)) if package.is_file() else None
    layer = data.GetLayerByName(table) if data is not None else None
    return int(layer.GetFeatureCount()) if layer is not None else -1


def layers_of_page(project: QgsProject, below: Sequence[QgsMapLayer], *, whole: bool) -> str:
    """Return what a page shows, top to bottom: names of layers with bars between them."""
    tables = (*ABOVE, WHOLE if whole else INTERVALS, GROUND)
    ours = [layer_of(project, table) for table in tables]
    return "|".join(layer.name() for layer in (*ours, *below) if layer is not None)


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
    """Draw the frames of the places of other pages, with their names at the upper left in sight."""
    root = QgsRuleBasedRenderer.Rule(None)
    frames = QgsRuleBasedRenderer.Rule(QgsFillSymbol.createSimple(_FRAME))
    frames.setFilterExpression(_IS_OTHER)
    root.appendChild(frames)
    layer.setRenderer(QgsRuleBasedRenderer(root))
    names = QgsPalLayerSettings()
    names.isExpression, names.fieldName = True, f'if({_IS_OTHER}, "place", NULL)'
    names.geometryGeneratorEnabled = True
    seen = "coalesce(intersection($geometry, @map_extent), $geometry)"
    names.geometryGenerator = f"make_point(x_min({seen}), y_max({seen}))"
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
