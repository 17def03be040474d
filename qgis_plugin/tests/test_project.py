"""The project of a run: it opens ready to present, and prints."""

import zipfile

from helpers import layer_called
from qgis.core import (
    QgsLayoutExporter,
    QgsLayoutItemLabel,
    QgsLayoutItemLegend,
    QgsLayoutItemMap,
    QgsLayoutItemPicture,
    QgsLayoutItemScaleBar,
    QgsProject,
    QgsRasterLayer,
)
from qgis.PyQt.QtCore import Qt
from qgis.PyQt.QtGui import QImage
from test_results import STYLE, colours, drawn


def test_the_project_of_a_run_opens(qgis_new_project, project):
    shown = QgsProject.instance()
    assert shown.read(str(project))
    layers = {layer.name(): layer for layer in shown.mapLayers().values()}
    assert set(layers) == {
        "Sensors", "Uncertainty (95 %)", "Views",
        "Coverage by interval", "Coverage, whole time", "Coverage, raster",
        "Road, not observed",
    }  # fmt: skip
    assert all(layer.isValid() for layer in layers.values())
    assert shown.crs().authid() == "EPSG:25832"
    assert shown.title() == "Sample"
    tree = shown.layerTreeRoot()
    assert [group.name() for group in tree.findGroups()] == [
        "Sensors",
        "Share of the visible time",
    ]
    on = {node.name() for node in tree.findLayers() if node.isVisible()}
    assert on == {
        "Sensors", "Uncertainty (95 %)", "Views", "Coverage by interval", "Road, not observed",
    }  # fmt: skip
    assert all(node.layer() is not None for node in tree.findLayers())


def test_the_project_has_style_and_time(qgis_new_project, project):
    shown = QgsProject.instance()
    assert shown.read(str(project))
    layer = layer_called("Coverage by interval")
    assert layer.temporalProperties().isActive()
    assert [step.label() for step in layer.renderer().ranges()] == [
        level.label for level in STYLE["colour_classes"]("coverage")
    ]
    assert isinstance(layer_called("Coverage, raster"), QgsRasterLayer)
    span = shown.timeSettings().temporalRange()
    assert span.begin().toString(Qt.DateFormat.ISODate) == "2025-06-12T07:30:00Z"
    assert span.end().toString(Qt.DateFormat.ISODate) == "2025-06-12T07:31:40Z"
    assert shown.readNumEntry("TemporalControllerWidget", "/NavigationMode")[0] == 1
    assert layer_called("Sensors").labelsEnabled()
    assert colours(drawn(layer, seconds=20)) & {
        level.colour for level in STYLE["colour_classes"]("coverage")
    }
    extent = shown.viewSettings().defaultViewExtent()
    assert extent.contains(690400.0, 5336200.0)


def test_the_project_prints_at_once(qgis_new_project, project, tmp_path):
    """A planner opens the layout and exports: everything of a sheet is on it."""
    shown = QgsProject.instance()
    assert shown.read(str(project))
    layout = shown.layoutManager().layoutByName("Report")
    items = {type(item): item for item in layout.items()}
    chart, legend = items[QgsLayoutItemMap], items[QgsLayoutItemLegend]
    assert {layer.name() for layer in chart.layers()} == {
        "Sensors", "Uncertainty (95 %)", "Views", "Coverage, whole time", "Road, not observed",
    }  # fmt: skip
    assert chart.extent().contains(690400.0, 5336200.0)
    assert 100.0 < chart.scale() < 5000.0
    nodes = legend.model().rootGroup().findLayers()
    assert [node.name() for node in nodes][:2] == ["Coverage, whole time", "Road, not observed"]
    assert all(node.layer() is not None for node in nodes)
    assert items[QgsLayoutItemScaleBar].linkedMap() is chart
    assert items[QgsLayoutItemPicture].linkedMap() is chart
    texts = [item.currentText() for item in layout.items() if isinstance(item, QgsLayoutItemLabel)]
    assert "Sample" in texts
    assert "2025-06-12 09:30:00 \u2013 09:31:40 (Europe/Berlin)" in texts
    assert "Source: City" in texts
    settings = QgsLayoutExporter.ImageExportSettings()
    settings.dpi = 50
    path = str(tmp_path / "sheet.png")
    done = QgsLayoutExporter(layout).exportToImage(path, settings)
    assert done == QgsLayoutExporter.ExportResult.Success
    found = colours(QImage(path))
    assert len(found & {level.colour for level in STYLE["colour_classes"]("coverage")}) > 5
    assert STYLE["NOT_OBSERVED"] in found


def test_the_project_names_no_absolute_path(project):
    with zipfile.ZipFile(project) as archive:
        text = archive.read("site.qgs").decode()
    assert str(project.parent) not in text
    assert "file:" not in text
