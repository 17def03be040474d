"""The time of results in the temporal controller: UTC, stepped by their interval."""

from __future__ import annotations

from qgis.core import (
    Qgis,
    QgsDateTimeRange,
    QgsFeatureRequest,
    QgsInterval,
    QgsMapLayer,
    QgsProject,
    QgsTemporalNavigationObject,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QDateTime, Qt


def as_utc(moment: QDateTime) -> QDateTime:
    """Return a time without a zone as the same time in UTC.

    GeoPackages hold UTC, but QGIS returns the limits of a layer without a zone.
    """
    return QDateTime(moment.date(), moment.time(), Qt.TimeSpec.UTC)


def _with_times(layer: QgsVectorLayer) -> QgsVectorLayer:
    """Return the table that holds each interval once: the one beside a view, or the layer itself.

    To find the limits of a column of a view, QGIS reads all its rows.
    """
    source, _, name = layer.source().partition("|layername=")
    if name == "by_interval":
        table = QgsVectorLayer(f"{source}|layername=intervals", "intervals", "ogr")
        if table.isValid() and table.fields().lookupField("begin") >= 0:
            return table
    return layer


def extent_of(layer: QgsVectorLayer) -> QgsDateTimeRange:
    """Return the time from the first begin to the last end, UTC."""
    layer = _with_times(layer)
    fields = layer.fields()
    begin = layer.minimumValue(fields.lookupField("begin"))
    end = layer.maximumValue(fields.lookupField("end"))
    if not isinstance(begin, QDateTime) or not isinstance(end, QDateTime):
        return QgsDateTimeRange()
    return QgsDateTimeRange(as_utc(begin), as_utc(end), True, False)


def step_of(layer: QgsVectorLayer) -> QgsInterval:
    """Return the length of the first interval."""
    request = QgsFeatureRequest().setLimit(1).setFlags(QgsFeatureRequest.Flag.NoGeometry)
    for row in layer.getFeatures(request):
        return QgsInterval(max(0.05, row["begin"].msecsTo(row["end"]) / 1000.0))
    return QgsInterval(0)


def intervals_of(layer: QgsVectorLayer) -> list[tuple[QDateTime, QDateTime]]:
    """Return begin and end of each interval, in order, UTC."""
    layer = _with_times(layer)
    fields = layer.fields()
    begins = sorted(layer.uniqueValues(fields.lookupField("begin")))
    ends = sorted(layer.uniqueValues(fields.lookupField("end")))
    return [(as_utc(begin), as_utc(end)) for begin, end in zip(begins, ends)]


def show_time(layer: QgsVectorLayer) -> None:
    """Set the project's time to the layer's, and the temporal controller where there is one."""
    extent, step = extent_of(layer), step_of(layer)
    if extent.begin().isNull():
        return
    project = QgsProject.instance()
    if step.seconds() >= 1.0 and any(map(_is_of_vehicles, project.mapLayers().values())):
        return  # at longer steps each would be drawn at several places
    settings = project.timeSettings()
    settings.setTemporalRange(extent)
    seconds = step.seconds()
    unit, length = Qgis.TemporalUnit.Seconds, seconds
    if seconds >= 60 and seconds % 60 == 0:
        unit, length = Qgis.TemporalUnit.Minutes, seconds / 60
    settings.setTimeStepUnit(unit)
    settings.setTimeStep(length)
    _drive(extent, QgsInterval(length, unit))


def _is_of_vehicles(layer: QgsMapLayer) -> bool:
    """Return whether a layer plays single vehicles, by steps under a second."""
    time = layer.temporalProperties()
    if not isinstance(layer, QgsVectorLayer) or not time.isActive():
        return False
    return bool(0.0 < QgsInterval(time.fixedDuration(), time.durationUnits()).seconds() < 1.0)


def _drive(extent: QgsDateTimeRange, step: QgsInterval) -> None:
    from qgis.utils import iface  # noqa: PLC0415 - None where QGIS has no window, set late

    controller = iface.mapCanvas().temporalController() if iface is not None else None
    if controller is None:
        return
    controller.setNavigationMode(QgsTemporalNavigationObject.NavigationMode.Animated)
    controller.setTemporalExtents(extent)
    controller.setFrameDuration(step)
    controller.setCurrentFrameNumber(0)
