"""What planners see: style, legend, transparency, time, groups, and the project of a run."""

import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import ROOT, SAMPLE, WORKER
from helpers import layer_called
from qgis.core import (
    Qgis,
    QgsDateTimeRange,
    QgsExpression,
    QgsExpressionContext,
    QgsExpressionContextScope,
    QgsFeature,
    QgsFeatureRequest,
    QgsGeometry,
    QgsGraduatedSymbolRenderer,
    QgsLabelingEngineSettings,
    QgsLayerTreeModel,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsProject,
    QgsRectangle,
    QgsVectorLayer,
    QgsVectorLayerTemporalContext,
)
from qgis.PyQt.QtCore import QDateTime, QSize, Qt
from qgis.PyQt.QtGui import QColor

STYLE = runpy.run_path(str(ROOT / "gis_radar" / "products" / "heatmap" / "style.py"))


@pytest.fixture
def heatmap(run, site, tmp_path, copying_worker):
    """The layers of a heat map, loaded by the algorithm."""
    parameters = {
        "DATASET": str(site / "dataset"), "INTERVAL": "20s", "OUTPUT": str(tmp_path / "map"),
    }  # fmt: skip
    results, heard = run("heatmap", parameters, load=True)
    assert heard.errors == []
    return results


def test_the_map_of_a_month_holds_all_sites_of_a_city(run, site, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(site / "dataset", tmp_path / "city" / f"site={name}")
    given = {"DATASET": str(tmp_path / "city"), "MONTH": "2025-06"}
    results, heard = run("monthmap", given | {"OUTPUT": str(tmp_path / "map")}, load=True)
    assert heard.errors == []
    layer = layer_called("Occupancy 2025-06")
    assert layer.uniqueValues(layer.fields().indexOf("site")) == {"a", "b"}
    assert layer.renderer().classAttribute() == "occupancy"
    assert QgsVectorLayer(results["HEATMAP"]).featureCount() == layer.featureCount()


def drawn(layer, *, seconds=None, size=300):
    """Draw a layer on nothing; `seconds` since the first interval's begin is the time shown."""
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setBackgroundColor(QColor(0, 0, 0, 0))
    settings.setFlag(Qgis.MapSettingsFlag.Antialiasing, False)
    settings.setOutputSize(QSize(size, size))
    settings.setDestinationCrs(layer.crs())
    settings.setExtent(layer.extent())
    if seconds is not None:
        begin = QDateTime(2025, 6, 12, 7, 30, 0, 0, Qt.TimeSpec.UTC).addSecs(seconds)
        settings.setIsTemporal(True)
        settings.setTemporalRange(QgsDateTimeRange(begin, begin.addSecs(20), True, False))
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    return job.renderedImage()


def colours(image):
    """Return the colours of an image; what lies over nothing may lose a part in 255."""
    pixels = {image.pixel(x, y) for x in range(image.width()) for y in range(image.height())}
    return {QColor(pixel).name() for pixel in pixels if pixel >> 24 >= 254}


def icon_colours(symbol):
    image = symbol.asImage(QSize(24, 24))
    return {QColor(image.pixel(x, y)).name() for x in range(6, 18) for y in range(6, 18)}


def test_the_style_is_the_one_of_all_maps(heatmap):
    layer = layer_called("Occupancy by interval")
    renderer = layer.renderer()
    assert isinstance(renderer, QgsGraduatedSymbolRenderer)
    assert renderer.classAttribute() == "occupancy"
    shown = [(step.symbol().color().name(), step.label()) for step in renderer.ranges()]
    assert shown[:-1] == [
        (level.colour, level.label) for level in STYLE["colour_classes"]("occupancy")
    ]
    assert shown[-1] == (STYLE["HATCH_DARK"], "uncertain")
    assert shown[0][1] == "0 %, no vehicle"
    plain = {len(icon_colours(step.symbol().clone())) for step in renderer.ranges()[:-1]}
    assert plain == {1}  # the hatch is in the last entry of the legend alone
    assert len(icon_colours(renderer.ranges()[-1].symbol().clone())) > 1
    raster = layer_called("Occupancy, raster")
    items = raster.renderer().shader().rasterShaderFunction().colorRampItemList()
    assert [item.color.name() for item in items] == [
        level.colour for level in STYLE["colour_classes"]("occupancy")
    ]


def test_the_list_of_layers_speaks_german(heatmap, monkeypatch):
    """Its legend was made as the layer was loaded, before the labels were translated."""
    from gis_radar_plugin import loading, words

    layer = layer_called("Occupancy by interval")
    model = QgsLayerTreeModel(QgsProject.instance().layerTreeRoot())

    def labels():
        node = model.rootGroup().findLayer(layer.id())
        said = [part.data(Qt.ItemDataRole.DisplayRole) for part in model.layerLegendNodes(node)]
        return [label for label in said if "%" in label or label.startswith("un")]

    assert "0 %, no vehicle" in labels()
    monkeypatch.setattr(words, "language", lambda: "de")
    loading.dress(layer)
    assert labels()[:3] == ["0 %, kein Fahrzeug", "bis 0,5 %", "0,5 bis 1 %"]
    assert labels()[-1] == "unsicher"


def test_vehicles_are_named_in_german(run, site, tmp_path, monkeypatch):
    from gis_radar_plugin import loading, words

    parameters = {"DATASET": str(site / "dataset"), "OUTPUT": str(tmp_path / "moving.gpkg")}
    run("footprints", parameters, load=True)
    layer = layer_called("Footprints")

    def labels():
        return [category.label() for category in layer.renderer().categories()]

    assert labels()[1] == "light vehicle, standing"
    monkeypatch.setattr(words, "language", lambda: "de")
    loading.dress(layer)
    assert labels()[1] == "leichtes Fahrzeug, steht"


def test_not_visible_is_transparent(heatmap):
    """A tile that no radar sees is drawn with nothing; a busy one has the darkest colour."""
    layer = layer_called("Occupancy, whole time")
    unseen = QgsVectorLayer(layer.source(), "unseen", "ogr")
    unseen.setSubsetString('"visible_s" = 0')
    assert unseen.featureCount() > 100
    image = drawn(unseen)
    assert not any(
        image.pixelColor(x, y).alpha() for x in range(image.width()) for y in range(image.height())
    )
    busy = QgsVectorLayer(layer.source(), "busy", "ogr")
    busy.setSubsetString('"occupancy" > 0.6')
    assert STYLE["colour_classes"]("occupancy")[-1].colour in colours(drawn(busy))


def test_time_is_on_at_once(heatmap):
    layer = layer_called("Occupancy by interval")
    time = layer.temporalProperties()
    assert time.isActive()
    assert time.mode() == Qgis.VectorTemporalMode.FeatureDateTimeInstantFromField
    assert time.startField() == "begin"
    assert (time.fixedDuration(), time.durationUnits()) == (19990, Qgis.TemporalUnit.Milliseconds)
    assert time.limitMode() == Qgis.VectorTemporalLimitMode.IncludeBeginExcludeEnd
    settings = QgsProject.instance().timeSettings()
    span = settings.temporalRange()
    assert span.begin().toString(Qt.DateFormat.ISODate) == "2025-06-12T07:30:00Z"
    assert span.end().toString(Qt.DateFormat.ISODate) == "2025-06-12T07:31:40Z"
    assert (settings.timeStep(), settings.timeStepUnit()) == (20, Qgis.TemporalUnit.Seconds)


def test_steps_of_single_vehicles_stay(heatmap):
    """At the longer steps of a layer that is loaded later, all vehicles of a step would show."""
    from gis_radar_plugin.timeline import show_time

    layer = layer_called("Occupancy by interval")
    vehicles = QgsVectorLayer("Point?field=begin:datetime&field=end:datetime", "v", "memory")
    vehicles.temporalProperties().setFixedDuration(490)
    vehicles.temporalProperties().setDurationUnits(Qgis.TemporalUnit.Milliseconds)
    vehicles.temporalProperties().setIsActive(True)
    project = QgsProject.instance()
    project.addMapLayer(vehicles)
    for kept in (0.5, 20.0):
        project.timeSettings().setTimeStepUnit(Qgis.TemporalUnit.Seconds)
        project.timeSettings().setTimeStep(0.5)
        show_time(layer)
        assert project.timeSettings().timeStep() == kept
        project.removeMapLayers([vehicles.id()] if kept == 0.5 else [])


def begins_shown(layer, after_s, length_s):
    """Tell which intervals a layer shows in a span of time, and how many rows."""
    context = QgsVectorLayerTemporalContext()
    context.setLayer(layer)
    begin = QDateTime(2025, 6, 12, 7, 30, 0, 0, Qt.TimeSpec.UTC).addSecs(after_s)
    span = QgsDateTimeRange(begin, begin.addSecs(length_s), True, False)
    wanted = layer.temporalProperties().createFilterString(context, span)
    found = list(layer.getFeatures(QgsFeatureRequest().setFilterExpression(wanted)))
    return {row["begin"].toUTC().toString("HH:mm:ss") for row in found}, len(found)


@pytest.mark.parametrize("way", ["loaded", "project"])
def test_a_moment_shows_its_interval_alone(heatmap, project, way):
    if way == "project":
        assert QgsProject.instance().read(str(project))
    layer = layer_called("Occupancy by interval")
    rows = layer.featureCount() / 5
    for number, clock in enumerate(("07:30:00", "07:30:20", "07:30:40", "07:31:00", "07:31:20")):
        assert begins_shown(layer, 20 * number, 20) == ({clock}, rows)
    assert begins_shown(layer, 25, 5) == ({"07:30:20"}, rows)  # finer steps than the intervals
    assert begins_shown(layer, 20, 40) == ({"07:30:20", "07:30:40"}, 2 * rows)


def test_two_moments_differ(heatmap):
    layer = layer_called("Occupancy by interval")
    first, second = drawn(layer, seconds=0), drawn(layer, seconds=60)
    assert colours(first) & {level.colour for level in STYLE["colour_classes"]("occupancy")}
    assert first != second


def test_traffic_shows_its_time_and_how_sure_its_volumes_are(run, site, tmp_path):
    """Of the intervals of traffic one is on the map: by the site's clocks, and with its errors."""
    from gis_radar_plugin.clock import Clock

    line = QgsVectorLayer("LineString?crs=EPSG:25832&field=name:string", "line", "memory")
    row = QgsFeature(line.fields())
    row.setGeometry(QgsGeometry.fromWkt("LineString (690396 5336173.5, 690425.3 5336181.1)"))
    row["name"] = "South"
    line.dataProvider().addFeature(row)
    QgsProject.instance().addMapLayer(line)
    given = {"DATASET": str(site / "dataset"), "INTERVAL": "1min", "SECTIONS": line,
             "OUTPUT": str(tmp_path / "traffic")}  # fmt: skip
    results, heard = run("traffic", given, load=True)
    assert heard.errors == []
    # not in the group of the layer that was chosen before, such as the sensors'
    group = QgsProject.instance().layerTreeRoot().findGroup("traffic")
    assert [node.name() for node in group.findLayers()] == [
        "Volumes of sections", "Volumes of turns", "Traffic of lanes"
    ]  # fmt: skip
    # one of the three equal legends is unfolded
    assert [node.isExpanded() for node in group.findLayers()] == [False, False, True]
    layer = layer_called("Volumes of sections")
    settings = QgsMapSettings()
    begin = QDateTime(2025, 6, 12, 7, 31, 0, 0, Qt.TimeSpec.UTC)
    settings.setIsTemporal(True)
    span = QgsDateTimeRange(begin, begin.addSecs(60), True, False)
    canvas = SimpleNamespace(
        mapSettings=lambda: settings, temporalRange=lambda: span, layers=lambda: [layer]
    )
    shown = "Thu 2025-06-12 09:31 – 09:32 (Europe/Berlin, UTC+02:00)"
    assert Clock.text(SimpleNamespace(_canvas=canvas)) == shown
    context = QgsExpressionContext()
    context.appendScope(QgsExpressionContextScope())
    context.setFields(layer.fields())
    for each in layer.getFeatures():
        context.setFeature(each)
        text = QgsExpression(layer.labeling().settings().fieldName).evaluate(context)
        tip = QgsExpression.replaceExpressionText(layer.mapTipTemplate(), context)
        volume, error = (60 * each[name] for name in ("volume", "volume_se"))
        assert text == f"South\n{each['direction']}: {volume:.0f} ± {error:.0f} veh/h"
        assert tip == f"<b>South &rarr; {each['direction']}</b><br>{volume:.0f} ± {error:.0f} veh/h"


def test_a_comparison_is_a_group(run, fake_worker, site, tmp_path):
    fake_worker(
        "from osgeo import ogr\nout = words[words.index('-o') + 1]\n"
        "os.makedirs(out, exist_ok=True)\nogr.UseExceptions()\n"
        "package = ogr.GetDriverByName('GPKG').CreateDataSource(out + '/compare.gpkg')\n"
        "package.CreateLayer('comparison')\ndel package\n"
        "say(event='result', outputs=[], summary={})"
    )
    given = {"DATASET": str(site / "dataset"), "OUTPUT": str(tmp_path / "compared")}
    _, heard = run("compare", given, load=True)
    assert heard.errors == []
    group = QgsProject.instance().layerTreeRoot().findGroup("compared")
    assert [node.name() for node in group.findLayers()] == ["What changed by lane"]


def test_layers_of_a_heat_map_are_a_group(heatmap):
    group = QgsProject.instance().layerTreeRoot().findGroup("map")
    shown = {node.name(): node.itemVisibilityChecked() for node in group.findLayers()}
    assert shown == {
        "Occupancy by interval": True,
        "Occupancy, whole time": False,
        "Occupancy, raster": False,
        "Road, not observed": True,
    }
    assert group.findLayers()[0].name() == "Occupancy by interval"


NO_SHIFT = """
import sys
from pathlib import Path
from qgis.core import *
from qgis.PyQt.QtCore import QDateTime, Qt, QTimeZone
app = QgsApplication([], False)
app.initQgis()
assert QTimeZone.systemTimeZoneId().data().decode() == sys.argv[3]
sys.path.insert(0, sys.argv[1])
from gis_radar_plugin.loading import dress_only
from gis_radar_plugin.timeline import extent_of, intervals_of
from gis_radar_plugin.report.pages import local_time, timezone, zone_name
layer = QgsVectorLayer(sys.argv[2] + "|layername=by_interval", "x", "ogr")
dress_only(layer)
span = extent_of(layer)
begin, end = intervals_of(layer)[1]
context = QgsVectorLayerTemporalContext()
context.setLayer(layer)
wanted = layer.temporalProperties().createFilterString(
    context, QgsDateTimeRange(begin, end, True, False))
count = sum(1 for _ in layer.getFeatures(QgsFeatureRequest().setFilterExpression(wanted)))
print(span.begin().toString(Qt.DateFormat.ISODate), begin.toString(Qt.DateFormat.ISODate), count)
print(local_time(begin, end, timezone(zone_name(Path(sys.argv[2])))))
"""


@pytest.mark.parametrize("zone", ["Asia/Kolkata", "America/New_York"])
def test_no_shift_wherever_the_computer_stands(site, monkeypatch, zone):
    """The data stay in UTC, the controller finds them there, people read the site's time."""
    local = "09:30:20 – 09:30:40 (Europe/Berlin, UTC+02:00)"
    monkeypatch.setenv("TZ", zone)
    package = str(site / "heatmap" / "heatmap.gpkg")
    words = [sys.executable, "-c", NO_SHIFT, str(ROOT / "qgis_plugin"), package, zone]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first == "2025-06-12T07:30:00Z 2025-06-12T07:30:20Z 5387"
    assert second.endswith(local)


def test_the_sensor_comes_with_view_and_ellipse(run, site, tmp_path, fake_worker):
    """Of the pose that a run has found; `test_run` localizes for itself."""
    fake_worker(
        f"import shutil\nif words[0] != 'localize':\n"
        f"    os.execv({WORKER!r}, [{WORKER!r}, *sys.argv[1:]])\n"
        f"found = {str(site / 'sensors' / 'R1')!r}\n"
        "assert words[words.index('--heading') + 1] == '20', words\n"
        "shutil.copy(found + '/pose.json', words[words.index('-o') + 1])\n"
        "shutil.copy(found + '/localization.png', words[words.index('--figure') + 1])\n"
        "say(event='result', outputs=[], summary={'fitness': 0.97})"
    )
    parameters = {
        "RECORDING": str(SAMPLE / "R1.parquet"), "MAP": str(SAMPLE / "junction.osm"),
        "ROAD": str(site / "road.laz"), "GUESS": "690356,5336183 [EPSG:25832]", "HEADING": 20,
        "POSE": str(tmp_path / "R1.json"), "FIGURE": str(tmp_path / "R1.png"),
        "OUTPUT": str(tmp_path / "R1.gpkg"),
    }  # fmt: skip
    results, heard = run("localizeradar", parameters, load=True)
    assert heard.errors == []
    sensor, view = layer_called("Sensor"), layer_called("View")
    ellipse = layer_called("Uncertainty (95 %)")
    row = next(sensor.getFeatures())
    assert row["sensor"] == "R1"
    assert row.geometry().asPoint().distance(690360.113, 5336178.1) < 1.0
    outline = next(view.getFeatures()).geometry()
    assert outline.area() > 10_000
    inside = next(ellipse.getFeatures()).geometry()
    assert inside.contains(row.geometry())
    assert inside.area() < 3.0
    assert sensor.labelsEnabled()
    arrow = sensor.renderer().symbol().symbolLayer(0)
    turned = arrow.dataDefinedProperties().property(arrow.Property.PropertyAngle)
    assert turned.expressionString() == '90 - "yaw"'
    page = Path(results["REPORT"]).read_text(encoding="utf-8")
    assert "R1.png" in page
    assert "fitness" in page


@pytest.mark.parametrize("at", [(0.02, 0.5), (0.98, 0.5), (0.5, 0.02), (0.5, 0.98), (0.98, 0.02)])
def test_a_sensor_near_the_edge_of_a_map_has_its_name(site, qgis_new_project, at):
    sensors = QgsVectorLayer(f"{site}/sensors.gpkg|layername=sensors", "Sensors", "ogr")
    place = next(sensors.getFeatures()).geometry().asPoint()
    west, south = place.x() - 200.0 * at[0], place.y() - 200.0 * at[1]
    settings = QgsMapSettings()
    settings.setLayers([sensors])
    settings.setDestinationCrs(sensors.crs())
    settings.setOutputSize(QSize(600, 600))
    settings.setExtent(QgsRectangle(west, south, west + 200.0, south + 200.0))
    engine = settings.labelingEngineSettings()
    # Half a name is none, as on sheets.
    engine.setFlag(QgsLabelingEngineSettings.UsePartialCandidates, False)
    settings.setLabelingEngineSettings(engine)
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    names = [label.labelText for label in job.takeLabelingResults().allLabels()]
    assert any(name.startswith("R1") for name in names)


def test_the_log_of_a_run_shows_no_hits_beside_occupancy(provider):
    """Nor does it call tracks vehicles; without occupancy hits are all there is."""
    from gis_radar_plugin.base import summary_lines

    figures = {"hits": 7, "tiles_hit": 499, "vehicles": 126}
    assert summary_lines({**figures, "mean occupancy": 0.1}) == [
        "Tracks of vehicles: 126", "mean occupancy: 0.1",
    ]  # fmt: skip
    assert len(summary_lines(figures)) == 3
    assert summary_lines({"sigma_yaw": 0.5, "observable": False}) == [
        "sigma yaw: 0.5", "observable: no",
    ]  # fmt: skip
    assert summary_lines({"all_stop_lines": {}}) == ["all stop lines: none"]
    assert summary_lines({"vehicles_at_stop_lines": None}) == ["vehicles at stop lines: not known"]
