"""The sheet: map, legend, scale bar, north arrow, title, source and time, as a print layout."""

from __future__ import annotations

import base64
from dataclasses import dataclass

from qgis.core import (
    QgsLayoutItem,
    QgsLayoutItemLabel,
    QgsLayoutItemLegend,
    QgsLayoutItemMap,
    QgsLayoutItemPicture,
    QgsLayoutItemScaleBar,
    QgsLayoutMeasurement,
    QgsLayoutObject,
    QgsLayoutPoint,
    QgsLayoutSize,
    QgsLegendRenderer,
    QgsLegendStyle,
    QgsMapLayerLegendUtils,
    QgsMarkerSymbol,
    QgsPrintLayout,
    QgsProject,
    QgsProperty,
    QgsSimpleMarkerSymbolLayer,
    QgsTextFormat,
    QgsUnitTypes,
    QgsVectorLayer,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import Qt
from qgis.PyQt.QtGui import QColor, QFont

from ..base import ICONS
from ..words import tr

NAME = "Report"
MARGIN_MM, WIDTH_MM, HEIGHT_MM = 10.0, 297.0, 210.0
SIDE_MM, HEAD_MM, FOOT_MM = 58.0, 20.0, 8.0
INK, SOFT = "#111827", "#4b5563"
# A segment of 1, 2 or 5 times a power of ten, at most 22 mm long.
_ROUND_SEGMENT = """
with_variable('most', map_get(item_variables('map'), 'map_scale') * 0.022,
  with_variable('power', 10 ^ floor(log10(@most)),
    @power * if(@most / @power >= 5, 5, if(@most / @power >= 2, 2, 1))))
"""


@dataclass(frozen=True)
class Texts:
    """What is printed beside the map.

    Parameters
    ----------
    title, source : str
        Heading, and where the data come from.
    made : str
        When the sheet was made.
    """

    title: str
    source: str
    made: str


def make_layout(
    project: QgsProject, pages: QgsVectorLayer, legend: list[QgsVectorLayer], texts: Texts
) -> QgsPrintLayout:
    """Make the layout with its atlas and put it into the project.

    Parameters
    ----------
    project : QgsProject
        Holds all layers.
    pages : QgsVectorLayer
        A row a page; see :mod:`report.export`.
    legend : list of QgsVectorLayer
        What the legend explains, top to bottom.
    texts : Texts
        Title and source.
    """
    layout = QgsPrintLayout(project)
    layout.initializeDefaults()  # one page, A4 landscape
    layout.setName(NAME)
    chart = _add_map(layout, pages)
    _add_head(layout, texts)
    _add_side(layout, chart, legend)
    _add_foot(layout, texts)
    atlas = layout.atlas()
    atlas.setCoverageLayer(pages)
    atlas.setEnabled(True)
    atlas.setHideCoverage(True)
    atlas.setPageNameExpression('"place" || \' \' || "time"')
    atlas.setFilenameExpression('"file"')
    project.layoutManager().addLayout(layout)
    return layout


def _add_map(layout: QgsPrintLayout, pages: QgsVectorLayer) -> QgsLayoutItemMap:
    chart = QgsLayoutItemMap(layout)
    chart.setId("map")
    width = WIDTH_MM - 2 * MARGIN_MM - SIDE_MM - 4
    height = HEIGHT_MM - 2 * MARGIN_MM - HEAD_MM - FOOT_MM
    _put(layout, chart, MARGIN_MM, MARGIN_MM + HEAD_MM, width, height)
    chart.zoomToExtent(pages.extent())  # a map without an extent would change its shape
    chart.setFrameEnabled(True)
    chart.setFrameStrokeColor(QColor(SOFT))
    chart.setFrameStrokeWidth(QgsLayoutMeasurement(0.2))
    chart.setBackgroundColor(QColor("#ffffff"))
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
    return chart


def _add_head(layout: QgsPrintLayout, texts: Texts) -> None:
    width = WIDTH_MM - 2 * MARGIN_MM
    title = f'{texts.title}: [% "place" %]'
    _put(layout, _label(layout, title, 18, bold=True), MARGIN_MM, MARGIN_MM - 1, width, 9)
    time = _label(layout, '[% "time" %][% if("whole", \' · \' || "note", \'\') %]', 12)
    _put(layout, time, MARGIN_MM, MARGIN_MM + 9, width, 7)


def _add_side(
    layout: QgsPrintLayout, chart: QgsLayoutItemMap, layers: list[QgsVectorLayer]
) -> None:
    left = WIDTH_MM - MARGIN_MM - SIDE_MM
    top = MARGIN_MM + HEAD_MM
    north = QgsLayoutItemPicture(layout)
    drawing = base64.b64encode((ICONS / "north.svg").read_bytes()).decode()
    north.setPicturePath(f"base64:{drawing}")
    north.setLinkedMap(chart)
    north.setNorthMode(QgsLayoutItemPicture.NorthMode.GridNorth)
    _put(layout, north, left, top, 16, 16)
    _put(layout, _scale_bar(layout, chart), left, top + 19, SIDE_MM, 12)
    legend = QgsLayoutItemLegend(layout)
    legend.setTitle(tr("Share of the observed time"))
    legend.setWrapString("|")
    legend.setAutoUpdateModel(False)
    tree = legend.model().rootGroup()
    tree.clear()
    for layer in layers:
        node = tree.addLayer(layer)
        if layer is layers[0]:  # the title says it already
            QgsLegendRenderer.setNodeLegendStyle(node, QgsLegendStyle.Style.Hidden)
        if layer.geometryType() == QgsWkbTypes.GeometryType.PointGeometry:
            QgsMapLayerLegendUtils.setLegendNodeCustomSymbol(node, 0, _lying_sensor())
            legend.model().refreshLayerLegend(node)
    for kind, size in (
        (QgsLegendStyle.Style.Title, 10), (QgsLegendStyle.Style.Subgroup, 9),
        (QgsLegendStyle.Style.SymbolLabel, 9),
    ):  # fmt: skip
        legend.rstyle(kind).setTextFormat(_format(size))
    legend.setResizeToContents(True)
    legend.setBackgroundEnabled(False)
    legend.setTitle(_wrapped(legend.title()))
    _put(layout, legend, left - 2, top + 34, SIDE_MM, 80)


def _lying_sensor() -> QgsMarkerSymbol:
    """Return a sensor as a legend shows it: it looks along the line, which takes less room."""
    arrow = {"name": "arrow", "size": "4.4", "angle": "90", "color": "29,78,216,255",
             "outline_style": "no", "offset": "0,-1"}  # fmt: skip
    dot = {"name": "circle", "size": "2.4", "color": INK, "outline_style": "no", "offset": "-2,0"}
    symbol = QgsMarkerSymbol.createSimple(arrow)
    symbol.appendSymbolLayer(QgsSimpleMarkerSymbolLayer.create(dot))
    return symbol


def _wrapped(text: str, width: int = 26) -> str:
    """Break a text into lines at the legend's wrap character."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "|".join(lines)


def _scale_bar(layout: QgsPrintLayout, chart: QgsLayoutItemMap) -> QgsLayoutItemScaleBar:
    bar = QgsLayoutItemScaleBar(layout)
    bar.setStyle("Single Box")
    bar.setLinkedMap(chart)
    bar.setUnits(QgsUnitTypes.DistanceUnit.DistanceMeters)
    bar.setUnitLabel("m")
    bar.setNumberOfSegments(2)
    bar.setNumberOfSegmentsLeft(0)
    given = bar.dataDefinedProperties()
    kind = QgsLayoutObject.DataDefinedProperty.ScalebarSegmentWidth
    given.setProperty(kind, QgsProperty.fromExpression(_ROUND_SEGMENT))
    bar.setDataDefinedProperties(given)
    bar.setHeight(2.2)
    bar.setTextFormat(_format(9))
    return bar


def _add_foot(layout: QgsPrintLayout, texts: Texts) -> None:
    top = HEIGHT_MM - MARGIN_MM - FOOT_MM + 3
    width = WIDTH_MM - 2 * MARGIN_MM
    source = _label(layout, f"{tr('Source')}: {texts.source}", 8)
    _put(layout, source, MARGIN_MM, top, width - 75, 8)
    number = f"{texts.made} · [% @atlas_featurenumber %] / [% @atlas_totalfeatures %]"
    right = _label(layout, number, 8)
    right.setHAlign(Qt.AlignmentFlag.AlignRight)
    _put(layout, right, MARGIN_MM + width - 75, top, 75, 8)


def _label(
    layout: QgsPrintLayout, text: str, size: int, *, bold: bool = False
) -> QgsLayoutItemLabel:
    label = QgsLayoutItemLabel(layout)
    label.setText(text)
    label.setTextFormat(_format(size, bold=bold))
    return label


def _format(size: int, *, bold: bool = False) -> QgsTextFormat:
    font = QFont("Open Sans")
    font.setStyleHint(QFont.StyleHint.SansSerif)
    font.setBold(bold)
    shape = QgsTextFormat()
    shape.setFont(font)
    shape.setSize(size)
    shape.setColor(QColor(INK))
    return shape


def _put(
    layout: QgsPrintLayout, item: QgsLayoutItem, x: float, y: float, width: float, height: float
) -> None:
    unit = QgsUnitTypes.LayoutUnit.LayoutMillimeters
    item.attemptMove(QgsLayoutPoint(x, y, unit))
    item.attemptResize(QgsLayoutSize(width, height, unit))
    layout.addLayoutItem(item)
