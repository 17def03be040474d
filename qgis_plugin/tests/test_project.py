"""The project of a run: it opens ready to present, and prints."""

import os
import shutil
import subprocess
import zipfile

import pytest
from conftest import ROOT, WORKER, worker
from helpers import layer_called
from qgis.core import (
    Qgis,
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsDateTimeRange,
    QgsExpression,
    QgsExpressionContext,
    QgsExpressionContextScope,
    QgsExpressionContextUtils,
    QgsFeature,
    QgsFeatureRequest,
    QgsField,
    QgsFields,
    QgsGeometry,
    QgsLayoutExporter,
    QgsLayoutItemLabel,
    QgsLayoutItemLegend,
    QgsLayoutItemMap,
    QgsLayoutItemPicture,
    QgsLayoutItemScaleBar,
    QgsMapLayerModel,
    QgsMapRendererParallelJob,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsPointXY,
    QgsProject,
    QgsRasterLayer,
    QgsRectangle,
    QgsRenderContext,
    QgsVectorLayer,
    QgsVectorLayerTemporalContext,
)
from qgis.PyQt.QtCore import QDateTime, QMetaType, QSize, Qt
from qgis.PyQt.QtGui import QImage
from test_results import STYLE, colours, drawn

LANE_STYLE = ROOT / "gis_radar" / "hdmap" / "lanes.qml"


def test_the_project_of_a_run_opens(qgis_new_project, project):
    shown = QgsProject.instance()
    assert shown.read(str(project))
    layers = {layer.name(): layer for layer in shown.mapLayers().values()}
    assert set(layers) == {
        "Sensors", "Uncertainty (95 %)", "Views", "Lanes", "Stop lines",
        "Occupancy by interval", "Occupancy, whole time", "Occupancy, raster",
        "Road, not observed",
    }  # fmt: skip
    assert all(layer.isValid() for layer in layers.values())
    assert shown.crs().authid() == "EPSG:25832"
    assert shown.title() == "Sample"
    tree = shown.layerTreeRoot()
    assert [group.name() for group in tree.findGroups()] == [
        "Sensors",
        "Road",
        "Occupancy",
    ]
    on = {node.name() for node in tree.findLayers() if node.isVisible()}
    assert on == {
        "Sensors", "Uncertainty (95 %)", "Views", "Lanes", "Stop lines", "Occupancy by interval",
        "Road, not observed",
    }  # fmt: skip
    assert all(node.layer() is not None for node in tree.findLayers())


def test_no_layer_is_left_in_a_list_when_the_project_is_closed(qgis_new_project, project):
    """QGIS drops the first layer whose id begins as the wanted one, and crashes on what is left."""
    shown = QgsProject.instance()
    listed = QgsMapLayerModel(shown)
    assert shown.read(str(project))
    assert listed.rowCount() == len(shown.mapLayers()) > 0
    shown.clear()
    assert listed.rowCount() == 0


def test_the_project_has_style_and_time(qgis_new_project, project):
    shown = QgsProject.instance()
    assert shown.read(str(project))
    layer = layer_called("Occupancy by interval")
    assert layer.temporalProperties().isActive()
    labels = [level.label for level in STYLE["colour_classes"]("occupancy")]
    assert [step.label() for step in layer.renderer().ranges()] == [*labels, "uncertain"]
    assert isinstance(layer_called("Occupancy, raster"), QgsRasterLayer)
    span = shown.timeSettings().temporalRange()
    assert span.begin().toString(Qt.DateFormat.ISODate) == "2025-06-12T07:30:00Z"
    assert span.end().toString(Qt.DateFormat.ISODate) == "2025-06-12T07:31:40Z"
    assert shown.readNumEntry("TemporalControllerWidget", "/NavigationMode")[0] == 1
    assert layer_called("Sensors").labelsEnabled()
    assert colours(drawn(layer, seconds=20)) & {
        level.colour for level in STYLE["colour_classes"]("occupancy")
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
        "Sensors", "Uncertainty (95 %)", "Views", "Lanes", "Stop lines", "Occupancy, whole time",
        "Road, not observed",
    }  # fmt: skip
    assert chart.extent().contains(690400.0, 5336200.0)
    assert 100.0 < chart.scale() < 5000.0
    nodes = legend.model().rootGroup().findLayers()
    assert [node.name() for node in nodes][:2] == ["Occupancy, whole time", "Road, not observed"]
    assert all(node.layer() is not None for node in nodes)
    assert items[QgsLayoutItemScaleBar].linkedMap() is chart
    assert items[QgsLayoutItemPicture].linkedMap() is chart
    texts = [item.currentText() for item in layout.items() if isinstance(item, QgsLayoutItemLabel)]
    assert "Sample" in texts
    assert "12 June 2025, 09:30:00 to 09:31:40 (Europe/Berlin, UTC+02:00)" in texts
    assert any(text.startswith("Occupancy: the estimated share of time") for text in texts)
    assert "Source: City" in texts
    settings = QgsLayoutExporter.ImageExportSettings()
    settings.dpi = 50
    path = str(tmp_path / "sheet.png")
    done = QgsLayoutExporter(layout).exportToImage(path, settings)
    assert done == QgsLayoutExporter.ExportResult.Success
    found = colours(QImage(path))
    assert len(found & {level.colour for level in STYLE["colour_classes"]("occupancy")}) > 5
    assert STYLE["NOT_OBSERVED"] in found


def test_the_clock_on_the_map_is_the_sites(qgis_new_project, project):
    """Whatever the computer's zone; nothing stands there while only the whole time is shown."""
    shown = QgsProject.instance()
    assert shown.read(str(project))
    label, known = shown.readEntry("TitleLabel", "/Label")
    assert known
    context = QgsExpressionContext()
    context.appendScope(QgsExpressionContextScope())  # which it owns from now on
    for name, clock in (("map_start_time", "07:30:20"), ("map_end_time", "07:30:40")):
        moment = QDateTime.fromString(f"2025-06-12T{clock}Z", Qt.DateFormat.ISODate)
        context.lastScope().setVariable(name, moment)
    written = {}
    for layer in ("gis_radar_by_interval", "gis_radar_heatmap"):
        context.lastScope().setVariable("map_layer_ids", [layer])
        written[layer] = QgsExpression.replaceExpressionText(label, context)
    assert list(written.values()) == [
        "Thu 2025-06-12 09:30:20 - 09:30:40 (Europe/Berlin, UTC+02:00)", "",
    ]  # fmt: skip


def test_no_text_of_a_project_is_evaluated(qgis_new_project, project, tmp_path):
    """A title or a source that looks like an expression is printed as it is."""
    title, source = "Site [% env('PATH') %] [% 1+1 %]", "[%[% 1 %]%] [% [%"
    heatmap = project.parent / "heatmap"
    worker("qgis", heatmap, "--title", title, "--source", source, "-o", tmp_path / "p.qgz")
    shown = QgsProject.instance()
    assert shown.read(str(tmp_path / "p.qgz"))
    assert shown.title() == title
    layout = shown.layoutManager().layoutByName("Report")
    texts = [item.currentText() for item in layout.items() if isinstance(item, QgsLayoutItemLabel)]
    assert title in texts
    assert f"Source: {source}" in texts


def test_the_project_names_no_absolute_path(project):
    with zipfile.ZipFile(project) as archive:
        text = archive.read("site.qgs").decode()
    assert str(project.parent) not in text
    assert "file:" not in text


def frame(seconds, layers):
    """Draw a frame of half a second, so long after the begin of the sample."""
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(layers[0].crs())
    settings.setOutputSize(QSize(500, 400))
    settings.setExtent(QgsRectangle(690330, 5336140, 690480, 5336260))
    begin = QDateTime(2025, 6, 12, 7, 30, 0, 0, Qt.TimeSpec.UTC).addMSecs(round(seconds * 1000))
    settings.setIsTemporal(True)
    settings.setTemporalRange(QgsDateTimeRange(begin, begin.addMSecs(500), True, False))
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    return job.renderedImage()


def shown_at(layer, seconds):
    """Return state and number of the vehicles that QGIS shows in a frame."""
    begin = QDateTime(2025, 6, 12, 7, 30, 0, 0, Qt.TimeSpec.UTC).addMSecs(round(seconds * 1000))
    context = QgsVectorLayerTemporalContext()
    context.setLayer(layer)
    span = QgsDateTimeRange(begin, begin.addMSecs(500), True, False)
    text = layer.temporalProperties().createFilterString(context, span)
    return [(row["vehicle"], row["state"], row["begin"].toUTC()) for row in
            layer.getFeatures(QgsFeatureRequest().setFilterExpression(text))]  # fmt: skip


def test_vehicles_and_occupancy_move_with_the_time(qgis_new_project, site):
    """The project of the demo, whose site file asks for vehicles: a queue builds and dissolves."""
    shown = QgsProject.instance()
    assert shown.read(str(site / "site.qgz"))
    moving, map_of_interval = layer_called("Vehicles"), layer_called("Occupancy by interval")
    assert moving.temporalProperties().isActive()
    times = shown.timeSettings()
    assert (times.timeStep(), times.timeStepUnit()) == (0.5, Qgis.TemporalUnit.Seconds)
    assert times.framesPerSecond() == 2
    standing = []
    for seconds in range(0, 100, 5):
        rows = shown_at(moving, seconds)
        assert len({number for number, _, _ in rows}) == len(rows) > 5  # each once
        assert {begin.time().second() for _, _, begin in rows} == {seconds % 60}
        standing.append(sum(state == "standing" for _, state, _ in rows))
    assert max(standing) >= min(standing) + 8  # red and green
    symbols = moving.renderer().symbols(QgsRenderContext())
    light = {symbols[place].color().name() for place in (0, 1)}
    assert light & colours(frame(40, [moving]))
    same, later = (frame(seconds, [map_of_interval]) for seconds in (39.5, 40))
    assert same == frame(25, [map_of_interval]) != later  # the map changes with its interval


def into(settings, crs, layer):
    """Give a map its coordinate system; return the way there from a layer's."""
    settings.setDestinationCrs(QgsCoordinateReferenceSystem(crs))
    return QgsCoordinateTransform(layer.crs(), settings.destinationCrs(), QgsProject.instance())


def labels_of(settings, layer):
    """Draw a map as the canvas does; return all labels and, of a layer, those that have a place."""
    context = QgsExpressionContext()
    context.appendScope(QgsExpressionContextUtils.mapSettingsScope(settings))
    settings.setExpressionContext(context)
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    found = job.takeLabelingResults()
    return found, [label for label in found.allLabels()
                   if label.layerID == layer.id() and not label.isUnplaced]  # fmt: skip


def shape_on(way, feature):
    """Return where a feature lies on the map."""
    shape = QgsGeometry(feature.geometry())
    shape.transform(way)
    return shape


def spaced(lane):
    """Return its label: two numbers beside each other must not read as one."""
    return f"\u2002{lane['lane']}\u2002"


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:3857"])  # the layer's, and that of web tiles
def test_every_lane_shows_its_number_and_no_two_collide(qgis_new_project, project, crs):
    shown = QgsProject.instance()
    assert shown.read(str(project))
    layer = layer_called("Lanes")
    assert layer.fields().field("turn").alias() == "Turns"
    assert "street" in layer.mapTipTemplate()
    for scale in (1.0, 0.4):
        settings = QgsMapSettings()
        settings.setLayers([node.layer() for node in shown.layerTreeRoot().findLayers()
                            if node.isVisible() and "interval" not in node.name()])  # fmt: skip
        way = into(settings, crs, layer)
        settings.setOutputSize(QSize(1400, 1200))
        box = way.transformBoundingBox(layer.extent())
        box.scale(1.05 * scale)
        settings.setExtent(box)
        _, labels = labels_of(settings, layer)
        seen = QgsGeometry.fromRect(settings.visibleExtent())
        there = {spaced(each) for each in layer.getFeatures()
                 if shape_on(way, each).intersects(seen)}  # fmt: skip
        assert {label.labelText for label in labels} == there
        shapes = [label.labelGeometry for label in labels]
        pairs = ((a, b) for k, a in enumerate(shapes) for b in shapes[k + 1 :])
        assert not any(a.intersects(b) and a.intersection(b).area() > 0.001 for a, b in pairs)


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:3857"])
def test_numbers_of_many_short_lanes_side_by_side_do_not_collide(qgis_new_project, crs):
    """At 1:3000, where a lane is narrower than its number is high: lines lead to their lanes."""
    layer = QgsVectorLayer("LineString?crs=EPSG:25832&field=lane:integer", "Lanes", "memory")
    rows = []
    for arm in range(12):
        row = QgsFeature(layer.fields())
        west, north = 500_000.0 + 30.0 * (arm // 4), 5_400_000.0 + 3.5 * (arm % 4)
        row.setGeometry(QgsGeometry.fromWkt(f"LINESTRING({west} {north}, {west + 9.0} {north})"))
        row["lane"] = 1040 + 7 * arm
        rows.append(row)
    assert layer.dataProvider().addFeatures(rows)
    layer.updateExtents()
    assert layer.loadNamedStyle(str(LANE_STYLE))[1]
    settings = QgsMapSettings()
    settings.setLayers([layer])
    way = into(settings, crs, layer)
    settings.setOutputSize(QSize(600, 600))
    half = 3000.0 * 300 * 0.0254 / settings.outputDpi()
    middle = layer.extent().center()
    settings.setExtent(
        way.transformBoundingBox(QgsRectangle.fromCenterAndSize(middle, 2 * half, 2 * half))
    )
    found, labels = labels_of(settings, layer)
    stretched = 1.0 if crs == "EPSG:25832" else 1.52  # 1 / cos(48.75 degrees)
    assert settings.scale() == pytest.approx(3000 * stretched, rel=0.05)
    assert {label.labelText for label in labels} == {spaced(row) for row in rows}
    shapes = [label.labelGeometry for label in labels]
    assert not any(a.intersects(b) for k, a in enumerate(shapes) for b in shapes[k + 1 :])
    lines = found.calloutsWithinRectangle(settings.visibleExtent())
    assert len(lines) > 3
    ends = [QgsGeometry.fromPointXY(QgsPointXY(line.destination())) for line in lines]
    assert all(any(end.distance(shape_on(way, row)) < 0.5 for row in rows) for end in ends)


def test_a_project_that_was_saved_in_qgis_stays(qgis_new_project, site, tmp_path):
    """The next run leaves it, and puts its own beside it; a third run renews only that."""
    folder = shutil.copytree(site, tmp_path / "run")
    opened = QgsProject.instance()
    assert opened.read(str(folder / "site.qgz"))
    opened.setTitle("mine")
    assert opened.write()
    opened.clear()
    mine = (folder / "site.qgz").read_bytes()
    again = (
        "import sys\nfrom gis_radar.products import write_site_project\n"
        "for _ in range(2):\n    print(write_site_project(sys.argv[1])[-1].name)"
    )
    around = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    done = subprocess.run([WORKER, "-c", again, str(folder)], check=True, capture_output=True,
                          text=True, cwd=ROOT, env=around)  # fmt: skip
    assert done.stdout.split() == ["site_2.qgz", "site_2.qgz"]
    assert (folder / "site.qgz").read_bytes() == mine
    assert opened.read(str(folder / "site_2.qgz"))
    assert opened.title() != "mine"


@pytest.mark.parametrize("layer", ["Lanes", "Occupancy, whole time"])
def test_names_in_map_tips_are_no_html(qgis_new_project, project, layer):
    """Streets and lanes are called as their file has it, and QGIS takes a tip for HTML."""
    assert QgsProject.instance().read(str(project))
    name, fields = "<img src=x onerror=alert(1)> & Söhne", QgsFields()
    for field in ("lane", "street", "street_part", "direction", "turn"):
        fields.append(QgsField(field, QMetaType.Type.QString))
    row = QgsFeature(fields)
    row.setAttributes([name] * fields.count())
    context = QgsExpressionContext()
    context.setFeature(row)
    tip = QgsExpression.replaceExpressionText(layer_called(layer).mapTipTemplate(), context)
    assert name.replace("&", "&amp;").replace("<", "&lt;") in tip
    assert "<img" not in tip
