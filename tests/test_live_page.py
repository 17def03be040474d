"""The page of the live map and its services: asked as a program does, and in a real Chromium."""

from __future__ import annotations

import http.cookiejar
import json
import math
import socket
import sys
import time
import urllib.error
import urllib.request
from collections import Counter
from contextlib import closing, contextmanager
from dataclasses import replace
from io import BytesIO
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from axe_core_python.selenium import Axe
from browser import start_chromium, wide
from live_replay import Replay
from live_site import (
    LONGEST_S,
    OF_THE_SAMPLE,
    LiveSite,
    free_port,
    wait_for,
)
from PIL import Image
from pydantic import ValidationError
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from gis_radar.base import GisRadarError, InputError, OutputError, Text, step_begin
from gis_radar.live import (
    Fusion,
    Snapshot,
    WebServer,
    make_app,
    read_live_site,
)
from gis_radar.live.fusion import server_of_page
from gis_radar.live.hours.quarters import TRAFFIC_FIELDS
from gis_radar.live.served.page import (
    HIT_COLOUR,
    VEHICLE_COLOUR,
    difference,
    page_server,
    whole_event,
)
from gis_radar.live.served.snapshot import NO_CLASS
from gis_radar.products.heatmap import style
from gis_radar.site import PageTable

pytestmark = pytest.mark.usefixtures("measured_in_a_thread")
VENDOR = Path(__file__).parents[1] / "gis_radar" / "live" / "web" / "vendor" / "maplibre-gl.mjs"


@contextmanager
def served(live, token=""):
    """Serve a live map on a free port of this machine; give the address."""
    server = WebServer(make_app(live, token), "127.0.0.1:0")
    try:
        yield server.open().rstrip("/")
    finally:
        server.close()


@pytest.fixture(scope="module")
def live(measure_once):
    return Replay(measure_once)


@pytest.fixture(scope="module")
def address(live):
    with served(live) as address:
        yield address


def get(address, **headers):
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers)) as answer:  # noqa: S310
        return answer.read().decode(), dict(answer.headers)


def get_json(address):
    return json.loads(get(address)[0])


def refusal(address, method="GET", **headers):
    asked = urllib.request.Request(address, headers=headers, method=method)  # noqa: S310
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(asked)  # noqa: S310
    caught.value.close()
    return caught.value.code


def stream_of(address):
    """Yield the events of the stream."""
    with urllib.request.urlopen(f"{address}/events") as stream:  # noqa: S310
        for line in stream:
            if line.startswith(b"data: "):
                yield json.loads(line.removeprefix(b"data: "))


def events(address, count):
    """Read some events of the stream."""
    with closing(stream_of(address)) as stream:
        return list(islice(stream, count))


def apply(shown, change):
    """Change a map as the page does it."""
    for name in ("hit", "unobserved"):
        tiles = set(shown[name]) - set(change[name]["off"]) | set(change[name]["on"])
        shown[name] = sorted(tiles)
    for name in ("classes", "lanes", "sensors", "occupancy", "traffic"):
        if not change[name]:
            continue
        shown[name] |= {type(next(iter(shown[name])))(k): v for k, v in change[name].items()}
    return shown | {name: change[name] for name in ("step", "clock", "vehicles")}


def test_differences_add_up_to_the_map(live):
    live.at = live.first + 400
    shown = whole_event(live.place, live.snapshot())
    for ahead in (1, 2, 7, 300):
        live.at += ahead
        live.silent = {"R2"} if ahead == 7 else set()
        whole = whole_event(live.place, live.snapshot())
        change = difference(shown, whole)
        assert len(json.dumps(change)) < len(json.dumps(whole)) / 4
        shown = apply(shown, change)
        assert shown == whole
    assert shown["hit"]


def test_the_stream_begins_with_the_whole_map_and_goes_on_with_changes(live, address):
    live.at = live.first + 500
    first = events(address, 1)[0]
    assert first["whole"]
    assert first["hit"] == live.snapshot().now.tolist()
    with closing(stream_of(address)) as stream:
        assert next(stream)["whole"]
        assert not next(stream).get("whole")
        live.at = live.first + 520
        for change in stream:
            assert not change.get("whole")
            if change["step"] != live.first + 500:
                break
    assert change["step"] == live.first + 520


def test_classes_are_those_of_the_legend(live):
    observed = np.array([0, 1000, 1000, 1000, 1000, 1000])
    hit = np.array([0, 0, 1, 5, 6, 1000])
    snapshot = Snapshot(step=0, now=np.empty(0, np.int64), observed_now=observed > 0,
                        hit=hit, observed=observed)  # fmt: skip
    share, found = hit[1:] / 1000, snapshot.classes()
    assert found[0] == NO_CLASS
    for value, number in zip(share, found[1:], strict=True):
        each = style.colour_classes()[number]
        assert (each.lower < value <= each.upper) or (value == 0.0 == each.upper)


def test_features_are_the_tiles_that_are_observed(live, address):
    live.at = live.first + 700
    snapshot, tiles = live.snapshot(), live.place.tiles
    shown = []
    link = f"{address}/ogc/collections/tiles/items?limit=1000"
    while link:
        page = get_json(link)
        shown += page["features"]
        link = next((each["href"] for each in page["links"] if each["rel"] == "next"), None)
    assert page["numberMatched"] == len(shown) == live.seen.sum()
    share = snapshot.hit_share()
    for each in shown[::97]:
        row, found = each["id"], each["properties"]
        assert found["tile_id"] == tiles["tile_id"][row]
        assert found["hit_now"] == (row in snapshot.now)
        assert found["hit_share_15min"] == pytest.approx(share[row], abs=1e-4)
    one = shapely.from_geojson(json.dumps(shown[0]["geometry"]))
    degrees = live.place.in_degrees(tiles).geometry
    assert one.hausdorff_distance(degrees[shown[0]["id"]]) < 1e-6
    box = ",".join(map(str, one.bounds))
    near = get_json(f"{address}/ogc/collections/tiles/items?bbox={box}")
    oracle = degrees[live.seen].intersects(shapely.box(*one.bounds)).sum()
    assert near["numberMatched"] == pytest.approx(oracle, abs=3)  # rounded to a centimetre
    single = get_json(f"{address}/ogc/collections/tiles/items/{shown[0]['id']}")
    assert single["properties"]["tile_id"] == shown[0]["properties"]["tile_id"]


def test_features_are_chosen_by_a_property(live, address):
    live.at = live.first + 700
    items = f"{address}/ogc/collections/tiles/items?limit=20000"
    now = get_json(f"{items}&hit_now=true")
    assert [each["id"] for each in now["features"]] == live.snapshot().now.tolist()
    first = now["features"][0]["properties"]
    share = json.dumps(first["hit_share_15min"])
    alike = get_json(f"{items}&hit_share_15min={share}&lane={first['lane']}")["features"]
    assert first in [each["properties"] for each in alike]


@pytest.mark.parametrize(
    ("layer", "names"),
    [("tiles", ("lanelet_id", "lane")), ("lanes", ("lane",)), ("intervals", ("lane",))],
)
def test_ids_of_the_map_are_text(live, address, layer, names):
    """They reach 9e18, and a browser's numbers are exact to 9e15."""
    items = f"{address}/ogc/collections/{layer}/items"
    first = get_json(f"{items}?limit=1")["features"][0]["properties"]
    known = {"lane": {*live.place.lanes["lane"]}, "lanelet_id": {*live.place.tiles["lanelet_id"]}}
    for name in names:
        assert first[name] in {str(each) for each in known[name]}
        assert get_json(f"{items}?{name}={first[name]}")["numberMatched"] > 0


def test_the_service_describes_itself(address):
    landing = get_json(f"{address}/ogc")
    assert {"service-desc", "conformance", "data"} <= {each["rel"] for each in landing["links"]}
    for link in landing["links"]:
        get(link["href"])
    listed = get_json(f"{address}/ogc/collections")["collections"]
    assert [each["id"] for each in listed] == ["tiles", "vehicles", "lanes", "intervals", "sensors"]
    for each in listed:
        assert get_json(next(k["href"] for k in each["links"] if k["rel"] == "items"))["features"]


@pytest.mark.parametrize(
    ("asked", "number"),
    [("..", 28), ("2025-06-12T07:31:00Z", 28), ("2025-06-12T06:00:00Z", 0),
     ("../2025-06-12T06:00:00Z", 0), ("2025-06-12T07:31:00Z/..", 28),
     ("2025-06-13T07:31:00Z/..", 0)],
)  # fmt: skip
def test_intervals_are_chosen_by_time(address, asked, number):
    found = get_json(f"{address}/ogc/collections/intervals/items?datetime={asked}")
    assert found["numberMatched"] == number


@pytest.mark.parametrize(
    ("query", "code"),
    [("tiles/items?bbox=1,2,x,4", 400), ("tiles/items?bbox=1,2", 400), ("tiles/items?limit=0", 400),
     ("tiles/items?limit=-1", 400), ("tiles/items?geometry=1", 400), ("tiles/items?nothing=1", 400),
     ("intervals/items?datetime=never", 400), ("else/items", 404), ("tiles/items/99999999", 404),
     ("tiles/items?bbox=nan,nan,nan,nan", 400)],
)  # fmt: skip
def test_questions_that_are_not_understood_are_refused(address, query, code):
    assert refusal(f"{address}/ogc/collections/{query}") == code


@pytest.mark.parametrize("path", ["tiles/items?limit=0", "else", "tiles/items/x"])
def test_refusals_of_the_service_are_json(address, path):
    """An exception of OGC 17-069r4, 7.5.2: `code` and `description`."""
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(f"{address}/ogc/collections/{path}")  # noqa: S310
    assert caught.value.headers["content-type"] == "application/json"
    said = json.load(caught.value)
    assert said["code"] == str(caught.value.code)
    assert said["description"]
    caught.value.close()


def test_whom_the_service_does_not_know_it_refuses_in_json(live):
    with served(live, token="s3cret") as address:  # noqa: S106 - of this test only
        for method, code in (("GET", 401), ("POST", 405)):
            asked = urllib.request.Request(f"{address}/ogc", method=method)  # noqa: S310
            with pytest.raises(urllib.error.HTTPError) as caught:
                urllib.request.urlopen(asked)  # noqa: S310
            assert json.load(caught.value)["code"] == str(code)
            assert caught.value.headers.get("www-authenticate") == {401: "Bearer"}.get(code)
            caught.value.close()


def test_only_who_has_the_token_reads(live):
    with served(live, token="s3cret") as address:  # noqa: S106 - of this test only
        for path in ("/", "/events", "/state.json", "/ogc", "/metrics", "/web/page.js"):
            assert refusal(address + path) == 401
            for wrong in ("other", "s3cre", "s3crex", "s3cret2"):
                assert refusal(address + path, Authorization=f"Bearer {wrong}") == 401
        assert (
            "gis_radar_frames_total" in get(address + "/metrics", Authorization="Bearer s3cret")[0]
        )
        jar = http.cookiejar.CookieJar()
        browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
        with browser.open(f"{address}/?token=s3cret&lang=de") as answer:
            assert answer.url == f"{address}/?lang=de"
            assert '<html lang="de">' in answer.read().decode()
        (kept,) = jar
        assert kept.has_nonstandard_attr("HttpOnly")
        assert kept.get_nonstandard_attr("SameSite") == "strict"
        with browser.open(f"{address}/state.json") as answer:
            assert json.load(answer)["whole"]


def test_others_cannot_write_nor_ask_in_the_name_of_this_machine(address):
    assert refusal(address, method="POST") == 405
    for path in ("/", "/events"):
        assert refusal(address + path, method="DELETE") == 405
    assert refusal(address, Host="evil.example") == 400
    _, headers = get(address)
    assert "default-src 'none'" in headers["content-security-policy"]
    assert refusal(f"{address}/web/../page.py") == 404


def test_a_page_that_is_open_to_all_is_refused():
    with pytest.raises(ValidationError, match=r"open to everyone who reaches 0\.0\.0\.0"):
        PageTable(address="0.0.0.0:80")
    PageTable(address="0.0.0.0:80", behind_proxy=True)
    PageTable(address="[::1]:80")


def test_a_page_without_its_packages_names_them(monkeypatch):
    monkeypatch.delitem(sys.modules, "gis_radar.live.served.page")
    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    asked = SimpleNamespace(live=SimpleNamespace(page="127.0.0.1:80"))
    with pytest.raises(GisRadarError, match="starlette is not installed") as refused:
        server_of_page(None, asked)
    assert refused.value.hint == "pip install gis_radar[live]"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    if not VENDOR.exists():
        pytest.skip("no MapLibre here: see tools/get_maplibre.sh")
    browser = start_chromium(tmp_path_factory.mktemp("chromium"), draws_maps=True)
    yield browser
    browser.quit()


def colours_of(element):
    """Count the pixels of each colour of a picture of an element."""
    image = Image.open(BytesIO(element.screenshot_as_png)).convert("RGB")
    colours = image.getcolors(image.width * image.height)
    return Counter({"#" + bytes(each).hex(): count for count, each in colours})


def test_a_page_without_its_library_says_so(live, address, chromium):
    live.at = live.first + 1200
    chromium.execute_cdp_cmd("Network.enable", {})
    chromium.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["*maplibre-gl.mjs"]})
    try:
        chromium.get(f"{address}/?lang=en")
        trouble = chromium.find_element(By.ID, "trouble")
        wait_for(lambda: "MapLibre, could not be loaded" in trouble.text)
        for name in ("map", "side"):
            assert not chromium.find_element(By.ID, name).is_displayed()
    finally:
        chromium.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
        chromium.get_log("browser")


@pytest.mark.parametrize(("width", "language"), [(1280, "en"), (390, "de")])
def test_the_page_in_a_browser(live, address, chromium, width, language):
    live.at, live.silent = live.first + 1200, {"R2"}
    late = Text("frames come {:+,.0f} ms after their time at the least", 1234.0)
    live.alarms = {"R1": {"clock": late}}
    wide(chromium, width)
    chromium.get_log("browser")
    chromium.get(f"{address}/?lang={language}")
    WebDriverWait(chromium, LONGEST_S).until(
        lambda page: page.execute_script("return document.body.dataset.drawn")
    )
    assert chromium.find_element(By.TAG_NAME, "html").get_attribute("lang") == language
    clock = chromium.find_element(By.ID, "clock").text
    assert clock == f"{step_begin(live.at).astimezone(live.place.zone):%H:%M:%S}"
    picture = chromium.find_element(By.ID, "map")
    wait_for(lambda: colours_of(picture)[VEHICLE_COLOUR] > 5)  # drawn after the tiles
    colours = colours_of(picture)
    assert colours[HIT_COLOUR] > 20
    assert colours[style.NOT_OBSERVED] > 200
    assert sum(colours[each.colour] for each in style.colour_classes()[1:]) > 200
    rows = chromium.find_elements(By.CSS_SELECTOR, "#sensor-rows tr")
    assert [row.text.split()[0] for row in rows] == ["R1", "R2"]
    assert (
        rows[1].find_element(By.CLASS_NAME, "bad").text
        == {"en": "offline", "de": "nicht verbunden"}[language]
    )
    assert (
        rows[0].find_element(By.CLASS_NAME, "bad").text
        == {
            "en": "its clock is off: frames come +1,234 ms after their time at the least",
            "de": "seine Uhr geht falsch: "
            "Messzyklen kommen mindestens +1\u202f234 ms nach ihrer Zeit an",
        }[language]
    )
    shares = [
        row.find_elements(By.TAG_NAME, "td")[0].text.split()[0]
        for row in chromium.find_elements(By.CSS_SELECTOR, "#lane-rows tr")
    ]
    values = [float(each.replace(",", ".")) for each in shares if each[0].isdigit()]
    assert values == sorted(values, reverse=True)
    assert values[0] == pytest.approx(
        100 * np.nanmax(live.snapshot().by_lane(live.place)), abs=0.06
    )
    page_width = chromium.execute_script("return document.documentElement.scrollWidth")
    assert page_width <= width
    violations = Axe().run(chromium)["violations"]
    assert [each["id"] for each in violations] == []
    assert [each for each in chromium.get_log("browser") if each["level"] == "SEVERE"] == []


def test_nothing_is_lost_on_a_phone_or_without_colours(live, address, chromium):
    live.at, live.silent = live.first + 1200, {"R2"}
    wide(chromium, 390)
    chromium.get(f"{address}/?lang=de")
    wait_for(lambda: chromium.find_elements(By.CSS_SELECTOR, "#lane-rows tr"))
    beyond = (
        "return [...document.querySelectorAll('.wide')].map(e => e.scrollWidth - e.clientWidth)"
    )
    assert max(chromium.execute_script(beyond)) <= 0
    picture = chromium.find_element(By.ID, "map")
    wait_for(lambda: colours_of(picture)["#9c1c1c"] > 20)  # a fault is a ring with
    assert colours_of(picture)["#ffffff"] > 20  # white in it, and so are the rims of vehicles
    legend = chromium.find_element(By.CLASS_NAME, "legend").text.splitlines()
    assert legend[-3:] == ["nicht beobachtet", "Sensor", "Sensor mit Störung"]


def picture_of_tiles(page, measure):
    """Choose what the map shows; count its colours once it stands still."""
    page.find_element(By.CSS_SELECTOR, f"input[value={measure}]").click()
    seen = [Counter()]

    def stands_still():
        time.sleep(0.3)
        seen.append(colours_of(page.find_element(By.ID, "map")))
        return seen[-1] == seen[-2]

    wait_for(stands_still)
    return seen[-1]


def test_zoomed_out_the_map_and_its_legend_are_of_lanes(live, address, chromium):
    live.at, live.silent = live.first + 1200, set()
    wide(chromium, 1280)
    chromium.get(f"{address}/?lang=de")
    wait_for(lambda: chromium.execute_script("return document.body.dataset.drawn"))
    side = chromium.find_element(By.ID, "side")
    chromium.find_element(By.CSS_SELECTOR, "input[value=now]").click()

    def is_far():
        chromium.find_element(By.CLASS_NAME, "maplibregl-ctrl-zoom-out").click()
        time.sleep(0.4)
        return side.get_attribute("data-measure") != "now"

    wait_for(is_far)
    pictures = {each: picture_of_tiles(chromium, each) for each in ("lately", "occupancy", "now")}
    ten = style.colour_classes()[5]  # of all lanes
    assert ten.lower < 0.1 <= ten.upper
    assert pictures["occupancy"][ten.colour] > 20
    assert max(pictures[each][ten.colour] for each in ("lately", "now")) < 10
    told = side.text.splitlines()
    assert told[4] == "Jetzt"
    assert "0 %, nie getroffen" in told
    assert "jetzt nicht getroffen" not in told


def test_a_little_traffic_does_not_read_as_none(live):
    snapshot = live.snapshot()
    snapshot.quarter.lanes["occupancy"] = 0.0003
    assert {each[0] for each in whole_event(live.place, snapshot)["traffic"].values()} == {1}
    snapshot.quarter.lanes["occupancy"] = 0.0
    assert {each[0] for each in whole_event(live.place, snapshot)["traffic"].values()} == {0}


def test_before_the_first_quarter_the_page_says_why_all_is_grey(
    live, address, chromium, monkeypatch
):
    live.at, live.silent = live.first + 1200, set()
    with monkeypatch.context() as patch:
        patch.setattr(live, "quarter", lambda _: None)
        chromium.get(f"{address}/?lang=de")
        wait_for(lambda: chromium.execute_script("return document.body.dataset.drawn"))
        side = chromium.find_element(By.ID, "side")
        assert "Noch ist keine Viertelstunde gemessen." not in side.text
        chromium.find_element(By.CSS_SELECTOR, "input[value=occupancy]").click()
        wait_for(lambda: "Noch ist keine Viertelstunde gemessen." in side.text)  # after drawing
        cells = chromium.find_elements(By.CSS_SELECTOR, "#sensor-rows tr:first-child td")
        assert [each.text for each in cells[1:3]] == ["20,0", "0,04"]
    wait_for(lambda: "Noch ist keine Viertelstunde gemessen." not in side.text)


def test_the_page_shows_occupancy_and_tells_vehicles(live, address, chromium):
    live.at, live.silent = live.first + 1200, set()
    wide(chromium, 1280)
    chromium.get(f"{address}/?lang=en")
    WebDriverWait(chromium, LONGEST_S).until(
        lambda page: page.execute_script("return document.body.dataset.drawn")
    )
    count = len(live.snapshot().vehicles)
    told = chromium.find_element(By.ID, "summary").text
    assert told.startswith(f"{count} vehicles now, 1 of them heavy")
    live.silent = {"R2"}
    wait_for(lambda: "offline" in chromium.find_element(By.ID, "sensor-rows").text)
    assert "R2: offline" in chromium.find_element(By.ID, "summary").text  # with the table
    live.silent = set()
    first = chromium.find_element(By.CSS_SELECTOR, "#lane-rows tr").find_elements(By.TAG_NAME, "td")
    assert first[1].text == "10.0 %"
    rows = {
        row.get_attribute("title"): [each.text for each in row.find_elements(By.TAG_NAME, "td")][2:]
        for row in chromium.find_elements(By.CSS_SELECTOR, "#lane-rows tr")
    }
    numbers = [str(each) for each in live.place.lane_numbers]
    assert [rows[each] for each in numbers[:4]] == [
        ["\N{EN DASH}"] * 3, ["≥ 1", "36", "23"], ["≥ 2", "36", "\N{EN DASH}"], ["3", "36", "23"],
    ]  # fmt: skip
    classes = [each.colour for each in style.colour_classes()]
    painted = picture_of_tiles(chromium, "occupancy")
    assert painted[HIT_COLOUR] == 0
    assert sum(painted[each] for each in classes[1:]) > 200
    side = chromium.find_element(By.CLASS_NAME, "side").text.splitlines()
    words = (
        "share of time with a vehicle while a tile was visible, last measured quarter of an hour"
    )
    assert side[4:6] == ["Occupancy", words]
    assert "0 %, no vehicle" in side
    assert not {"Share of the observed time", "0 %, never hit", "hit now"} & set(side)
    painted = picture_of_tiles(chromium, "now")
    assert painted[classes[0]] > 200
    assert sum(painted[each] for each in classes[1:]) == 0
    side = chromium.find_element(By.CLASS_NAME, "side").text.splitlines()
    assert [side[4], *side[6:10]] == [
        "Now", "hit now", "not hit now", "not observed", "vehicle now"
    ]  # fmt: skip
    assert [each for each in chromium.get_log("browser") if each["level"] == "SEVERE"] == []


def test_vehicles_of_now_are_features(live, address):
    live.at = live.first + 700
    now = live.snapshot().vehicles
    found = get_json(f"{address}/ogc/collections/vehicles/items")
    assert found["numberMatched"] == len(now) > 0
    assert {each["properties"]["heavy"] for each in found["features"]} == {False, True}
    lanes = get_json(f"{address}/ogc/collections/lanes/items")["features"]
    traffic = {name: lanes[3]["properties"][f"{name}_15min"] for name in TRAFFIC_FIELDS}
    assert traffic == {
        "visible_share": 1.0, "counted": 3, "volume": 3.0, "volume_se": 0.5, "speed_kmh": 36.0,
        "occupancy": 0.1, "queue_max_m": 23.4,
    }  # fmt: skip


def test_lanes_have_the_names_that_people_use_and_their_own(live, address):
    english, german = (
        [each["name"] for each in get_json(f"{address}/site.json?lang={each}")["lanes"]]
        for each in ("en", "de")
    )
    features = get_json(f"{address}/ogc/collections/lanes/items")["features"]
    known = {each["properties"]["lane"]: each["properties"]["name"] for each in features}
    assert [known[str(number)] for number in live.place.lane_numbers] == english
    assert len(set(english)) == len(english)
    assert "lane 1" in english[0]
    assert "Fahrstreifen 1" in german[0]
    first, *_ = live.place.lane_numbers
    stated = live.place.lanes["lane"].map({first: "To the harbour"})
    named = replace(live.place, lanes=live.place.lanes.assign(name=stated))
    assert named.lane_names() == ["To the harbour", *english[1:]]


def test_a_lane_that_the_site_file_names_and_the_map_has_not_is_refused(tmp_path, once):
    page = f'[live.page]\naddress = "127.0.0.1:{free_port()}"'
    lane = '[[lane]]\nid = 5\nname = "To the harbour"'
    site = LiveSite(tmp_path, once, of_site=lane, of_live=f"{OF_THE_SAMPLE}\n{page}")
    with pytest.raises(InputError, match=r"SITE\.toml: has no lane 5"):
        Fusion(read_live_site(site.file))


def test_what_is_not_observed_has_no_share(live):
    live.at = live.first + 100
    event = whole_event(live.place, live.snapshot())
    unseen = np.flatnonzero(~live.seen).tolist()
    assert event["unobserved"] == unseen
    assert {event["classes"][tile] for tile in unseen} == {NO_CLASS}
    share = live.snapshot().by_lane(live.place)
    assert [each is None for each in event["lanes"].values()] == [math.isnan(x) for x in share]


def test_an_address_that_is_taken_is_one_line(tmp_path, once, live):
    site = LiveSite(tmp_path, once)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        table = PageTable(address=f"127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(OutputError, match=r"127\.0\.0\.1:\d+: cannot be served"):
            page_server(live, read_live_site(site.file), table, live.place.tiles)
