"""The print layout of a report: the sheet of gis_radar's project, driven by an atlas of pages."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsLayoutItemMap,
    QgsLayoutObject,
    QgsPrintLayout,
    QgsProject,
    QgsProperty,
    QgsVectorLayer,
)

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
