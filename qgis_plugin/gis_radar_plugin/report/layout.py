"""The print layout of a report: the sheet of gis_radar's projects, driven by an atlas of pages."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from qgis.core import (
    QgsLayoutItemLegend,
    QgsLayoutItemMap,
    QgsLayoutObject,
    QgsMapLayer,
    QgsPrintLayout,
    QgsProject,
    QgsProperty,
    QgsReadWriteContext,
    QgsVectorLayer,
)

from ..resources import shared_document
from ..words import tr

NAME = "Report"
_TITLE_WIDTH = 26  # letters of the legend's title in a line: more would widen the legend


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
    project: QgsProject, pages: QgsVectorLayer, legend: Mapping[str, QgsMapLayer], texts: Texts
) -> QgsPrintLayout:
    """Make the layout with its atlas and put it into the project.

    Parameters
    ----------
    project : QgsProject
        Holds all layers.
    pages : QgsVectorLayer
        A row a page; see :mod:`report.export`.
    legend : mapping of str to QgsMapLayer
        What the legend explains, top to bottom, by the ids of the template.
    texts : Texts
        Title and source.
    """
    layout = QgsPrintLayout(project)
    layout.loadFromTemplate(shared_document("products/qgis/sheet.qpt"), QgsReadWriteContext())
    layout.setName(NAME)
    _drive_map(layout.itemById("map"), pages)
    _fill_legend(layout.itemById("legend"), legend)
    _fill_texts(layout, texts)
    _explain(layout, legend)
    atlas = layout.atlas()
    atlas.setCoverageLayer(pages)
    atlas.setEnabled(True)
    atlas.setHideCoverage(True)
    atlas.setPageNameExpression('"place" || \' \' || "time"')
    atlas.setFilenameExpression('"file"')
    project.layoutManager().addLayout(layout)
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


def _fill_legend(legend: QgsLayoutItemLegend, layers: Mapping[str, QgsMapLayer]) -> None:
    """Put the layers in the place of the template's, with the properties that it has for each."""
    occupied = tr("Occupancy"), tr("share of time with a vehicle")
    title = ": ".join(occupied)
    if _measure(layers) != "occupancy":
        title = tr("Share of the observed time")
    legend.setTitle("|".join(textwrap.wrap(title, _TITLE_WIDTH)))  # its wrap character
    legend.setAutoUpdateModel(False)
    tree = legend.model().rootGroup()
    patterns = {node.layerId(): node.clone() for node in tree.findLayers()}
    tree.clear()
    for key, layer in layers.items():
        node = tree.addLayer(layer)
        for name in patterns[key].customProperties():
            node.setCustomProperty(name, patterns[key].customProperty(name))
        legend.model().refreshLayerLegend(node)


def _fill_texts(layout: QgsPrintLayout, texts: Texts) -> None:
    label: Any = layout.itemById
    label("title").setText(f'{_literal(texts.title)}: [% "place" %]')
    label("time").setText('[% "time" %][% if("whole", \' · \' || "note", \'\') %]')
    label("source").setText(f"{tr('Source')}: {_literal(texts.source)}")
    number = "[% @atlas_featurenumber %] / [% @atlas_totalfeatures %]"
    label("made").setText(f"{texts.made} · {number}")


def _literal(text: str) -> str:
    """Return a text as QGIS prints it: what stands between `[%` and `%]` it would evaluate."""
    return text.replace("[%", "[% '[' || '%' %]")


def _measure(layers: Mapping[str, QgsMapLayer]) -> str:
    """Return which column the layers show: occupancy or hit share."""
    renderers = [getattr(layer, "renderer", lambda: None)() for layer in layers.values()]
    shown = {getattr(each, "classAttribute", str)() for each in renderers}
    return "occupancy" if "occupancy" in shown else "hit_share"


def _explain(layout: QgsPrintLayout, layers: Mapping[str, QgsMapLayer]) -> None:
    """Leave on the sheet what its measure means, and where it ends, in the language of QGIS."""
    for measure in ("occupancy", "hit_share"):
        label: Any = layout.itemById(f"meaning {measure}")
        if measure == _measure(layers):
            label.setText(tr(label.text()))
        else:
            layout.removeLayoutItem(label)
