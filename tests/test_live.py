"""The live system with a real broker: what it measures is what the batch does, whatever breaks."""

import math
import time
from dataclasses import replace

import geopandas as gpd
import pytest
from live_programs import (
    HeldEdge,
    Lines,
    assert_all_recorded,
    assert_equal_to_batch,
)
from live_site import SAMPLE, Background, LiveSite, needs_mosquitto, wait_for

import gis_radar as gr
from gis_radar.live import BrokerAddress, Edge, Fusion, Link, read_edge_file, read_live_site

NAMES = ("R1", "R2")
pytestmark = [needs_mosquitto, pytest.mark.usefixtures("ready_workers")]


@pytest.fixture
def site(tmp_path, once):
    """Give a live site whose broker runs."""
    made = LiveSite(tmp_path, once)
    made.broker.start()
    yield made
    made.broker.kill()


def test_what_fusion_measures_equals_the_batch(site):
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    edges = [Edge(read_edge_file(site.edge(name))) for name in NAMES]
    work = [Background(each.run) for each in edges]
    for each in work:
        each.join()
        each.end()
    middle.end()
    assert [edge.frames for edge in edges] == [600, 598]
    assert_all_recorded(site, NAMES)
    assert_equal_to_batch(site, NAMES)


def test_the_dataset_has_the_streets_of_the_site_file(tmp_path, once):
    """As the page has them; the tiles need have none."""
    roads = gr.read_map(SAMPLE / "junction.osm")
    line = roads.lanes().set_index("lane").geometry.loc[[83]]
    street = gpd.GeoDataFrame({"name": ["Weststraße"]}, geometry=list(line), crs=line.crs)
    street.to_file(tmp_path / "streets.gpkg")
    made = LiveSite(tmp_path, once, of_site='streets = "streets.gpkg"')
    made.broker.start()
    try:
        middle = Background(Fusion(read_live_site(made.file)).run)
        edge = Background(Edge(read_edge_file(made.edge("R1"))).run)
        edge.join()
        edge.end()
        middle.end()
    finally:
        made.broker.kill()
    of_map = roads.lanes(streets=tmp_path / "streets.gpkg")
    lanes = gr.open_dataset(tmp_path / "live" / "dataset").lanes()
    streets, wanted = (each.set_index("lane")["street"].dropna() for each in (lanes, of_map))
    assert wanted[83] == "Weststraße"
    assert streets.to_dict() == wanted.to_dict()


class KilledError(Exception):
    """Ends fusion in the midst of its work."""


@pytest.mark.usefixtures("measured_in_a_thread")
def test_a_broker_that_is_killed_and_a_fusion_that_begins_anew_lose_nothing(site):
    """Everything breaks in the midst of a replay; fusion is left without a word, as if killed."""
    middle = Fusion(read_live_site(site.file))
    first = Background(middle.run)
    edge = HeldEdge(read_edge_file(site.edge("R1")))
    edge.until = 200
    work = Background(edge.run)
    wait_for(lambda: middle.sensors["R1"].health.counts["frames"] > 60)
    site.broker.kill()
    edge.until = 400
    wait_for(lambda: edge.frames == 400)  # it goes on, on disk

    def killed(_timeout_s):
        raise KilledError

    middle.link.take = killed  # what it has taken and not committed is gone
    first.join()
    with pytest.raises(KilledError):
        first.end()
    site.broker.start()
    again = Fusion(read_live_site(site.file))
    second = Background(again.run)
    edge.until = math.inf
    work.join()
    work.end()
    second.end()
    assert again.sensors["R1"].health.counts["frames"] > 100
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])


def test_nobody_gets_past_the_broker(site):
    """A wrong password is refused, and a sensor's neither reads nor writes what is another's."""
    said = Lines()
    address = BrokerAddress.of(f"mqtt://127.0.0.1:{site.port}", user="R1", password="wrong")  # noqa: S106
    stranger = Link(address, name="stranger", reporter=said)
    stranger.open()
    wait_for(lambda: said.told("refuses the link"))
    stranger.close()
    password = (site.folder / "broker" / "password_of_R1").read_text().strip()
    known = BrokerAddress.of(f"mqtt://127.0.0.1:{site.port}", user="R1", password=password)
    everything = ("v1/#", "v1/junction/R2/detections", "v1/junction/R1/ack")
    one = Link(known, name="junction-R1", topics=everything, reporter=said)
    one.open()
    wait_for(lambda: one.connected)
    one.publish("v1/junction/R2/detections", b"foreign")
    wait_for(lambda: said.told("does not take a message"))
    one.publish("v1/junction/R1/detections", b"own")
    assert one.take(0.5) is None  # its own frames, and R2's, are not its to read
    twin = Link(known, name="junction-R1", reporter=said)
    twin.open()
    wait_for(lambda: said.told("the same name"))
    for each in (one, twin):
        each.close()


def test_a_sensor_that_takes_the_name_of_fusion_ends_nobodys_link(site):
    links = {}
    for user, name in {"fusion": "junction-fusion", "R1": "junction-R1"}.items():
        known = replace(read_live_site(site.file).address(), user=user,
                        password=site.password(user))  # fmt: skip
        links[user] = Link(known, name=name, topics=(f"v1/junction/{user}/ack",))
    thief = Link(known, name="junction-fusion")  # of R1
    links["fusion"].open()
    wait_for(lambda: links["fusion"].connected)
    thief.open()
    wait_for(lambda: thief.connected)
    time.sleep(3.0)
    assert thief.connected
    assert links["fusion"].connected
    assert links["fusion"].connections == 1
    for each in (thief, links["fusion"]):
        each.close()
