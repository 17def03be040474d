"""Layers of QGIS as files for the worker: what is filtered, selected or in memory is exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsFeatureRequest,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeatureSource,
    QgsProcessingFeatureSourceDefinition,
    QgsProcessingUtils,
    QgsProject,
    QgsProviderRegistry,
    QgsVectorFileWriter,
    QgsVectorLayer,
)

from .words import tr


def layer_file(
    algorithm: QgsProcessingAlgorithm,
    parameters: dict[str, Any],
    name: str,
    context: QgsProcessingContext,
    *,
    layer_name: str,
    fields: tuple[str, ...] = (),
    metric: bool = True,
) -> str:
    """Return a GeoPackage with a layer that holds what the user chose.

    Parameters
    ----------
    algorithm, parameters, name, context
        The parameter that names the layer.
    layer_name : str
        Name of the layer where it must be exported; a file whose layer has this name already is
        used as it is.
    fields : tuple of str
        Fields that the layer must have.
    metric : bool
        Whether coordinates in degrees are refused.

    Raises
    ------
    QgsProcessingException
        In one sentence, if the layer cannot be what is needed.
    """
    source = algorithm.parameterAsSource(parameters, name, context)
    if source is None:
        raise QgsProcessingException(tr("The layer for '{name}' is missing.").format(name=name))
    _refuse_wrong(source, fields, metric=metric)
    layer = algorithm.parameterAsVectorLayer(parameters, name, context)
    if layer is not None and not _is_part(parameters.get(name), layer):
        place = _place(layer)
        if place is not None and place[1] in ("", layer_name):
            return place[0]
    return _exported(source, layer_name)


def _refuse_wrong(
    source: QgsProcessingFeatureSource, fields: tuple[str, ...], *, metric: bool
) -> None:
    called = source.sourceName()
    missing = [field for field in fields if source.fields().lookupField(field) < 0]
    if missing:
        text = tr("The layer '{layer}' is not one of tiles: it lacks {fields}.")
        raise QgsProcessingException(text.format(layer=called, fields=", ".join(missing)))
    crs = source.sourceCrs()
    if not crs.isValid():
        text = tr("The layer '{layer}' has no coordinate system: set it first.")
        raise QgsProcessingException(text.format(layer=called))
    if metric and crs.isGeographic():
        text = tr("The layer '{layer}' is in degrees ({crs}): a metric one is needed, such as UTM.")
        raise QgsProcessingException(text.format(layer=called, crs=crs.authid()))
    if source.featureCount() == 0:
        text = tr("The layer '{layer}' holds nothing, or nothing in it is selected.")
        raise QgsProcessingException(text.format(layer=called))


def _is_part(value: Any, layer: QgsVectorLayer) -> bool:
    """Return whether a selection, a filter or unsaved edits make the layer differ from its file."""
    chosen = isinstance(value, QgsProcessingFeatureSourceDefinition) and (
        value.selectedFeaturesOnly or bool(getattr(value, "filterExpression", ""))
    )
    return chosen or bool(layer.subsetString()) or layer.isModified()


def _place(layer: QgsVectorLayer) -> tuple[str, str] | None:
    """Return file and layer name of a layer in a GeoPackage, None for any other."""
    if layer.providerType() != "ogr":
        return None
    parts = QgsProviderRegistry.instance().decodeUri("ogr", layer.source())
    path = str(parts.get("path") or "")
    if Path(path).suffix.lower() != ".gpkg" or not Path(path).is_file():
        return None
    return path, str(parts.get("layerName") or "")


def _exported(source: QgsProcessingFeatureSource, layer_name: str) -> str:
    """Write the features to a GeoPackage of our own, which is closed for the worker."""
    path = str(QgsProcessingUtils.generateTempFilename(f"{layer_name}.gpkg"))
    write_package(source.materialize(QgsFeatureRequest()), path, layer_name)
    return path


def write_package(layer: QgsVectorLayer, path: str, layer_name: str) -> None:
    """Write a layer to a new GeoPackage.

    Raises
    ------
    QgsProcessingException
        If it cannot be written.
    """
    options = QgsVectorFileWriter.SaveVectorOptions()
    options.driverName = "GPKG"
    options.layerName = layer_name
    names = [field.name() for field in layer.fields()]
    options.attributes = [place for place, name in enumerate(names) if name.lower() != "fid"]
    context = QgsProject.instance().transformContext()
    written = QgsVectorFileWriter.writeAsVectorFormatV3(layer, path, context, options)
    if written[0] != QgsVectorFileWriter.WriterError.NoError:
        raise QgsProcessingException(f"{path}: {written[1]}")
