"""The provider: gis_radar in the toolbox."""

from __future__ import annotations

from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithms import ALGORITHMS
from .base import ICONS
from .opening import PROVIDER


class GisRadarProvider(QgsProcessingProvider):  # type: ignore[misc]
    """All algorithms of gis_radar."""

    def id(self) -> str:
        return PROVIDER

    def name(self) -> str:
        return "gis_radar"

    def longName(self) -> str:  # noqa: N802
        return "gis_radar: radar to traffic maps"

    def icon(self) -> QIcon:
        return QIcon(self.svgIconPath())

    def svgIconPath(self) -> str:  # noqa: N802
        return str(ICONS / "gis_radar.svg")

    def loadAlgorithms(self) -> None:  # noqa: N802
        for algorithm in ALGORITHMS:
            self.addAlgorithm(algorithm())

    def supportedOutputVectorLayerExtensions(self) -> list[str]:  # noqa: N802
        return ["gpkg"]

    def defaultVectorFileExtension(self, _has_geometry: bool = True) -> str:  # noqa: N802, FBT001, FBT002
        return "gpkg"

    def supportsNonFileBasedOutput(self) -> bool:  # noqa: N802
        return False
