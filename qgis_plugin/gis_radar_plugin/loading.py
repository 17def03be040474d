"""Load results into the project, with style, legend, time and group."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsCategorizedSymbolRenderer,
    QgsGraduatedSymbolRenderer,
    QgsMapLayer,
    QgsProcessingContext,
    QgsProcessingLayerPostProcessorInterface,
    QgsProject,
    QgsRasterLayer,
    QgsVectorLayer,
)
from qgis.PyQt.QtXml import QDomDocument

from .timeline import show_time
from .words import shared, speaks_german, tr

INTERVALS = "by_interval"
Finish = Callable[[QgsMapLayer], None]


def shows_occupancy(folder: Path) -> bool:
    """Return whether a heat map shows occupancy; without vehicles it shows the hit share."""
    return (folder / "heatmap.tif").is_file()


def heatmap_titles(folder: Path) -> dict[str, str]:
    """Return what the layers of a heat map are called, by table, and its raster as `raster`."""
    if shows_occupancy(folder):
        return {
            "heatmap": tr("Occupancy, whole time"),
            INTERVALS: tr("Occupancy by interval"),
            "raster": tr("Occupancy, raster"),
        }
    return {
        "heatmap": tr("Hit share, whole time"),
        INTERVALS: tr("Hit share by interval"),
        "raster": tr("Hit share, raster"),
    }


class Finisher(QgsProcessingLayerPostProcessorInterface):  # type: ignore[misc]
    """A post-processor that finishes a layer once it is in the project."""

    # QGIS does not own post-processors: one without a reference is never called.
    kept: ClassVar[list[Finisher]] = []

    def __init__(self, finish: Finish, *, visible: bool, legend: bool = True) -> None:
        super().__init__()
        self._finish = finish
        self._visible = visible
        self._legend = legend
        Finisher.kept.append(self)
        del Finisher.kept[:-200]

    def postProcessLayer(  # noqa: N802
        self, layer: QgsMapLayer, context: QgsProcessingContext, _feedback: Any
    ) -> None:
        self._finish(layer)
        project = context.project() or QgsProject.instance()
        node = project.layerTreeRoot().findLayer(layer.id())
        if node is not None:
            node.setItemVisibilityChecked(self._visible)
            node.setExpanded(self._visible and self._legend)


def load(
    context: QgsProcessingContext,
    source: str,
    name: str,
    *,
    group: str = "",
    finish: Finish | None = None,
    visible: bool = True,
    legend: bool = True,
    order: int = 0,
) -> None:
    """Have QGIS load a result when the algorithm has ended.

    Parameters
    ----------
    context : QgsProcessingContext
        Of the run; without a project in it nothing is loaded.
    source : str
        What to load.
    name, group : str
        Of the layer, and of the group that it goes into.
    finish : callable, optional
        Gets the layer once it is in the project; without it, :func:`dress`.
    visible : bool
        Whether it is switched on.
    legend : bool
        Whether its legend is unfolded.
    order : int
        Layers of one run with a higher order are above.
    """
    project = context.project()
    if project is None:
        return
    details = QgsProcessingContext.LayerDetails(name, project, name)
    details.groupName = group
    details.layerSortKey = order
    details.forceName = True
    details.setPostProcessor(Finisher(finish or dress, visible=visible, legend=legend))
    context.addLayerToLoadOnCompletion(source, details)


def finish_output(
    context: QgsProcessingContext, dest: str, finish: Finish | None = None, *, visible: bool = True
) -> bool:
    """Finish a layer that QGIS loads by itself; return whether it does."""
    if not context.willLoadLayerOnCompletion(dest):
        return False
    details = context.layerToLoadOnCompletionDetails(dest)
    details.setPostProcessor(Finisher(finish or dress, visible=visible))
    return True


def dress(layer: QgsMapLayer) -> None:
    """Show a layer as planners see it: its file's style, legend in their words, time on.

    Processing loads layers without the style that their file holds.
    """
    dress_only(layer)
    if isinstance(layer, QgsVectorLayer) and layer.temporalProperties().isActive():
        show_time(layer)


def dress_only(layer: QgsMapLayer) -> None:
    """Show a layer as :func:`dress` does, but leave the project's time as it is."""
    layer.reload()
    layer.loadDefaultStyle()
    if isinstance(layer, QgsVectorLayer):
        translate_legend(layer)
        _translate_columns(layer)
    elif isinstance(layer, QgsRasterLayer):
        _translate_raster(layer)
    layer.legendChanged.emit()  # the list of layers shows the labels as they were before
    layer.triggerRepaint()


def as_ground(layer: QgsVectorLayer) -> None:
    """Show all tiles in one grey, below a heat map: it remains where nothing was observed."""
    # Not loadNamedStyle: that prefers the style in the layer's GeoPackage.
    symbology = QgsMapLayer.StyleCategory.Symbology
    layer.loadDefaultStyle()  # for the titles of its columns
    document = QDomDocument()
    document.setContent(shared("products/heatmap/ground.qml").read_text(encoding="utf-8"))
    layer.importNamedStyle(document, symbology)
    _translate_columns(layer)
    layer.triggerRepaint()


def translate_legend(layer: QgsVectorLayer) -> None:
    """Put the classes' labels in the user's language."""
    renderer = layer.renderer()
    if isinstance(renderer, QgsCategorizedSymbolRenderer):
        for place, category in enumerate(renderer.categories()):
            renderer.updateCategoryLabel(place, tr(category.label()))
        layer.emitStyleChanged()
    if not isinstance(renderer, QgsGraduatedSymbolRenderer):
        return
    for place, step in enumerate(renderer.ranges()):
        renderer.updateRangeLabel(place, legend_words(step.label()))
    layer.emitStyleChanged()


def _translate_columns(layer: QgsVectorLayer) -> None:
    """Put the columns' titles in the user's language; those of intervals end in a time."""
    for place, field in enumerate(layer.fields()):
        title, _, time = field.alias().rpartition(" ")
        known = f"{tr(title)} {time}" if time.endswith("Z") else tr(field.alias())
        layer.setFieldAlias(place, known.strip())


def _translate_raster(layer: QgsRasterLayer) -> None:
    shader = getattr(layer.renderer(), "shader", lambda: None)()
    ramp = shader.rasterShaderFunction() if shader is not None else None
    if ramp is None or not hasattr(ramp, "colorRampItemList"):
        return
    items = ramp.colorRampItemList()
    for item in items:
        item.label = legend_words(item.label)
    ramp.setColorRampItemList(items)


def legend_words(label: str) -> str:
    """Return a class's label in the user's language: `2 to 5 %` has words in it, too."""
    for words in ("never hit", "no vehicle", "uncertain", "up to", " to "):
        label = label.replace(words, tr(words))
    return label.replace(".", ",") if speaks_german() else label
