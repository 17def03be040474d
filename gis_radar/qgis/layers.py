"""What a project shows: layers with their sources and styles, in groups."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

from gis_radar.heatmap import style as heat_style
from gis_radar.heatmap.layers import BEGIN, END, LONG, WIDE
from gis_radar.poses import style as sensor_style
from gis_radar.poses.layers import SENSORS, UNCERTAINTY, VIEWS


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A layer of a project.

    Parameters
    ----------
    name : str
        As the user reads it.
    path : Path
        The file.
    table : str
        Its layer, empty for a raster.
    geometry : str
        `Point`, `Polygon`, or empty for a raster.
    qml : str
        Its style.
    shown : bool
        Whether it is switched on.
    """

    name: str
    path: Path
    table: str = ""
    geometry: str = ""
    qml: str
    shown: bool = True

    @property
    def provider(self) -> str:
        """What of QGIS reads it."""
        return "ogr" if self.table else "gdal"

    def style(self) -> list[Element]:
        """Return the parts of the style as a project holds them."""
        body = self.qml[self.qml.index("<qgis") :]
        return list(fromstring(body))  # noqa: S314 - our own text


@dataclass(frozen=True, kw_only=True)
class Group:
    """Layers under one heading, top to bottom."""

    name: str
    layers: tuple[Layer, ...]


def sensor_group(path: Path) -> Group:
    """Return the layers of a file of sensors."""
    known = (
        ("Sensors", SENSORS, "Point", sensor_style.sensors_qml()),
        ("Uncertainty (95 %)", UNCERTAINTY, "Polygon", sensor_style.uncertainty_qml()),
        ("Views", VIEWS, "Polygon", sensor_style.views_qml()),
    )
    layers = [
        Layer(name=name, path=path, table=table, geometry=geometry, qml=qml)
        for name, table, geometry, qml in known
    ]
    return Group(name="Sensors", layers=tuple(layers))


def traffic_group(folder: Path, length_s: float) -> Group:
    """Return the layers of a heat map: by interval over the road switched on, the rest at hand.

    Parameters
    ----------
    folder : Path
        Of the heat map.
    length_s : float
        Length of its intervals, seconds.
    """
    package, raster = folder / "heatmap.gpkg", folder / "heatmap.tif"
    animated = Layer(
        name="Occupancy by interval", path=package, table=LONG, geometry="Polygon",
        qml=heat_style.vector_qml(begin=BEGIN, end=END, length_s=length_s),
    )  # fmt: skip
    whole = Layer(
        name="Occupancy, whole time", path=package, table=WIDE, geometry="Polygon",
        qml=heat_style.vector_qml(), shown=False,
    )  # fmt: skip
    layers = [animated, whole]
    if raster.is_file():
        pixels = heat_style.sidecar_qml()
        layers.append(Layer(name="Occupancy, raster", path=raster, qml=pixels, shown=False))
    ground = Layer(
        name="Road, not observed", path=package, table=WIDE, geometry="Polygon",
        qml=heat_style.ground_qml(),
    )  # fmt: skip
    return Group(name=heat_style.LEGEND_TITLE, layers=(*layers, ground))
