"""Live look: what another program writes shows up, and nothing else is read anew."""

import os
import shutil

import pytest
from conftest import worker
from helpers import layer_called
from qgis.core import QgsProject, QgsRasterLayer, QgsVectorLayer


class Controller:
    """Stands for the temporal controller of a window."""

    def __init__(self, frame):
        self.frame, self.count = frame, 5

    def currentFrameNumber(self):
        return self.frame

    def totalFrameCount(self):
        return self.count

    def setTemporalExtents(self, span):
        self.span, self.count = span, 2

    def setCurrentFrameNumber(self, frame):
        self.frame = frame


@pytest.fixture
def shown(qgis_new_project, provider, site, tmp_path):
    """A running site's heat map, open in QGIS."""
    from gis_radar_plugin.loading import dress

    shutil.copytree(site / "heatmap", tmp_path / "map")
    source = f"{tmp_path}/map/heatmap.gpkg|layername=by_interval"
    for layer in (
        QgsVectorLayer(source, "live", "ogr"),
        QgsRasterLayer(str(tmp_path / "map" / "heatmap.tif"), "pixels"),
    ):
        assert layer.isValid()
        QgsProject.instance().addMapLayer(layer)
        dress(layer)
    return tmp_path / "map"


def again(site, folder, interval):
    """Write the heat map anew, as a running site does."""
    worker("heatmap", site / "dataset", "--interval", interval, "-o", folder)


def test_layers_follow_their_files(shown, site):
    from gis_radar_plugin.live import LiveLook

    controller = Controller(frame=4)  # at the newest interval
    live = LiveLook(controller)
    assert live.look() == []
    assert live.look() == []
    layer, pixels = layer_called("live"), layer_called("pixels")
    assert layer.featureCount() == 5 * 5387
    assert pixels.bandCount() == 6
    again(site, shown, "50s")
    assert sorted(live.look()) == ["live", "pixels"]
    assert layer.featureCount() == 2 * 5387
    assert sum(1 for _ in layer.getFeatures()) == 2 * 5387
    assert pixels.bandCount() == 3
    assert controller.frame == 1  # still at the newest
    assert live.look() == []


def test_a_file_that_is_gone_for_a_moment(shown):
    from gis_radar_plugin.live import LiveLook

    live = LiveLook()
    live.look()
    package = shown / "heatmap.gpkg"
    package.rename(shown / "away")
    assert live.look() == []
    (shown / "away").rename(package)
    os.utime(package)
    assert live.look() == ["live"]


def test_a_file_that_comes_later(qgis_new_project, provider, site, tmp_path):
    """A project may be opened before a site has written its first heat map."""
    from gis_radar_plugin.live import LiveLook

    late = tmp_path / "heatmap.gpkg"
    layer = QgsVectorLayer(f"{late}|layername=by_interval", "late", "ogr")
    QgsProject.instance().addMapLayer(layer)
    live = LiveLook()
    assert live.look() == []
    late.write_bytes(b"half")  # no GeoPackage yet
    live.look()
    assert not layer.isValid()
    shutil.copy(site / "heatmap" / "heatmap.gpkg", late)
    assert live.look() == ["late"]
    assert layer.isValid()
    assert layer.featureCount() == 5 * 5387
    assert live.look() == []


def test_a_layer_that_is_edited_stays(shown):
    from gis_radar_plugin.live import LiveLook

    live = LiveLook()
    live.look()
    layer = layer_called("live")
    assert layer.startEditing()
    os.utime(shown / "heatmap.gpkg")
    assert live.look() == []
    assert layer.rollBack()
    assert live.look() == ["live"]


def test_the_timer(shown, qgis_app):
    from gis_radar_plugin.live import LiveLook

    live = LiveLook()
    assert not live.is_on()
    live.start(1)
    assert live.is_on()
    live.stop()
    assert not live.is_on()
