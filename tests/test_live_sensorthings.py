"""The push of lane measures, against a server that checks what the standard requires.

OGC 18-088, tables of the sensing entities: which properties are mandatory, and which relations.
"""

import json
import re
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from live_programs import Lines
from live_site import LONGEST_S, SAMPLE, LiveSite, wait_for

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.live import Fusion, Place, QuarterMeasures, read_live_site
from gis_radar.live.served.lane_push import LanePush
from gis_radar.live.served.sensorthings import (
    LaneMeasure,
    LaneServer,
    ServerError,
    Service,
)
from gis_radar.site import SensorThingsTable

MANDATORY = {
    "Things": {"name", "description"},
    "Locations": {"name", "description", "encodingType", "location"},
    "Datastreams": {"name", "description", "observationType", "unitOfMeasurement"},
    "Sensors": {"name", "description", "encodingType", "metadata"},
    "ObservedProperties": {"name", "definition", "description"},
    "Observations": {"phenomenonTime", "resultTime", "result"},
}
PERIOD = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z(/\d{4}-\d\d-\d\dT[\d:.]+Z)?")


class Server(ThreadingHTTPServer):
    """A SensorThings service, as much as a push needs; `odd` keeps what breaks a rule."""

    daemon_threads = True

    def __init__(self):
        self.entities = {name: [] for name in MANDATORY}
        self.odd, self.asked, self.fails, self.drops = [], [], 0, 0
        self.raw, self.moved = {}, None  # bytes that a method is answered; code and address
        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_address[1]}/v1.1"

    def check(self, what, found):
        if not found:
            self.odd.append(what)

    def add(self, kind, record):
        missing = MANDATORY[kind] - {key for key, value in record.items() if value is not None}
        self.check(f"{kind} without {sorted(missing)}", not missing)
        if kind == "Things":
            for each in record.pop("Locations", []):
                self.check("encoding", each["encodingType"] == "application/geo+json")
                self.check("longitude first", 5 < each["location"]["coordinates"][0][0] < 16)
                self.add("Locations", each)
        if kind == "Datastreams":
            unit = record["unitOfMeasurement"]
            self.check("unit", {"name", "symbol", "definition"} <= set(unit))
            for name, entities in (
                ("Thing", "Things"),
                ("Sensor", "Sensors"),
                ("ObservedProperty", "ObservedProperties"),
            ):
                ids = [each["@iot.id"] for each in self.entities[entities]]
                self.check(f"no {name}", record[name]["@iot.id"] in ids)
        if kind == "Observations":
            for name in ("phenomenonTime", "resultTime"):
                self.check(f"{name}: {record[name]}", PERIOD.fullmatch(record[name]))
            self.check("an instant", "/" not in record["resultTime"])
            self.check("result", 0.0 <= record["result"] <= 100.0)
            ids = [each["@iot.id"] for each in self.entities["Datastreams"]]
            self.check("stream", record["Datastream"]["@iot.id"] in ids)
        self.entities[kind].append(record | {"@iot.id": len(self.entities[kind]) + 1})

    def results(self):
        streams = {each["@iot.id"]: each["name"] for each in self.entities["Datastreams"]}
        return sorted(
            (streams[each["Datastream"]["@iot.id"]], each["phenomenonTime"], each["result"])
            for each in self.entities["Observations"]
        )


class Handler(BaseHTTPRequestHandler):
    """Answers as the standard says."""

    def do_GET(self):
        parts = urlsplit(self.path)
        query = parse_qs(parts.query)
        self.server.asked.append(("GET", unquote(self.path), self.headers.get("Authorization")))
        path = parts.path.removeprefix("/v1.1/")
        if of_stream := re.fullmatch(r"Datastreams\((\d+)\)/Observations", path):
            rows = [each for each in self.server.entities["Observations"]
                    if each["Datastream"]["@iot.id"] == int(of_stream[1])]  # fmt: skip
            rows.sort(key=lambda each: each["phenomenonTime"], reverse=True)
        else:
            name = re.fullmatch(r"name eq '(.*)'", query["$filter"][0])[1].replace("''", "'")
            rows = [each for each in self.server.entities[path] if each["name"] == name]
        self.answer(200, {"value": rows[: int(query["$top"][0])]})

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        path = self.path.removeprefix("/v1.1/")
        self.server.asked.append(("POST", path, self.headers.get("Authorization")))
        if self.server.fails:
            self.server.fails -= 1
            return self.answer(503, {})
        if path == "CreateObservations":
            links = []
            for array in body:
                self.server.check("count", array["dataArray@iot.count"] == len(array["dataArray"]))
                for values in array["dataArray"]:
                    row = dict(zip(array["components"], values, strict=True))
                    self.server.add("Observations", row | {"Datastream": array["Datastream"]})
                    links.append("link")
            if self.server.drops:  # taken, and the answer is lost
                self.server.drops -= 1
                self.connection.close()
                return None
            return self.answer(201, links)
        self.server.add(path, body)
        return self.answer(201, None)

    def answer(self, code, record):
        if self.command in self.server.raw:
            self.wfile.write(self.server.raw[self.command])
            self.close_connection = True
            return
        if self.server.moved:
            code, place = self.server.moved
            self.send_response(code)
            self.send_header("Location", place + self.path.removeprefix("/v1.1"))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        text = b"" if record is None else json.dumps(record).encode()
        self.send_response(code)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture
def server():
    made = Server()
    yield made
    made.shutdown()
    made.server_close()


@pytest.fixture(scope="module")
def place():
    roads = gr.read_map(SAMPLE / "junction.osm")
    return Place(
        title="O'Hara's junction", zone=ZoneInfo("UTC"), tiles=gr.make_tiles(roads),
        lanes=roads.lanes(),
    )  # fmt: skip


def table(server, **more):
    return SensorThingsTable.model_validate({"address": server.address} | more)


def push_of(server, place, folder, said=None, **more):
    return LanePush(
        table(server, **more), place, site="junction", path=folder / "waiting.json",
        retry_s=0.05, reporter=said or Lines(),
    )  # fmt: skip


def until_sent(push):
    end = time.monotonic() + LONGEST_S
    while push.waiting:
        push.poll()
        assert time.monotonic() < end
        time.sleep(0.01)


def count(push, place, first, quarters):
    """Let half of the time every tile be hit, all observed, in quarters without vehicles."""
    lanes = pd.DataFrame({"lane": place.lane_numbers, "hit_s": 450.0, "observed_s": 900.0})
    ends = (first + QUARTER * k - 1 for k in range(1, quarters + 1))
    push.take([QuarterMeasures(until_step=k, visible=[], occupied=[], lanes=lanes) for k in ends])


QUARTER = 18_000
BEGIN = 1_944_444 * QUARTER


def test_lanes_and_their_intervals_arrive_as_the_standard_asks(server, place, tmp_path):
    push = push_of(server, place, tmp_path)
    count(push, place, BEGIN, 2)
    lanes = len(place.lane_numbers)
    assert push.waiting == 2 * lanes
    until_sent(push)
    assert server.odd == []
    sizes = {name: len(rows) for name, rows in server.entities.items()}
    assert sizes == {"Things": lanes, "Locations": lanes, "Datastreams": lanes, "Sensors": 1,
                     "ObservedProperties": 1, "Observations": 2 * lanes}  # fmt: skip
    first = server.entities["Observations"][0]
    assert first["phenomenonTime"] == "2025-06-15T15:00:00Z/2025-06-15T15:15:00Z"
    assert (first["result"], first["parameters"]) == (50.0, {"observed_s": 900.0})
    assert [path for _, path, _ in server.asked].count("CreateObservations") == 1
    again = push_of(server, place, tmp_path)  # a new start finds all there
    count(again, place, BEGIN + 2 * QUARTER, 1)
    until_sent(again)
    assert len(server.entities["Things"]) == lanes
    assert len(server.entities["Observations"]) == 3 * lanes


def test_after_a_clock_that_was_days_ahead_nothing_is_sent_again_and_again(server, place, tmp_path):
    push = push_of(server, place, tmp_path)
    count(push, place, BEGIN + 1_000 * QUARTER, 96)
    until_sent(push)
    again = push_of(server, place, tmp_path)
    for waiting in (len(place.lane_numbers), 0):
        count(again, place, BEGIN, 1)
        assert again.waiting == waiting
        until_sent(again)
    assert len(server.entities["Observations"]) == 97 * len(place.lane_numbers)


def quarter_of(place, until_step, **columns):
    """A measured quarter with the same traffic on all lanes."""
    traffic = {"visible_share": 0.9, "volume": 7.0, "volume_se": 1.5, "speed_kmh": 31.25,
               "occupancy": 0.125, "queue_max_m": np.nan, "hit_s": 90.0,
               "observed_s": 900.0} | columns  # fmt: skip
    lanes = pd.DataFrame({"lane": place.lane_numbers}).assign(**traffic)
    return QuarterMeasures(until_step=until_step, visible=[], occupied=[], lanes=lanes)


def test_the_measures_of_each_quarter_arrive_once_with_their_errors(server, place, tmp_path):
    until, lanes = BEGIN + QUARTER - 1, len(place.lane_numbers)
    quarters = [quarter_of(place, until)]
    push = push_of(server, place, tmp_path)
    push.take(quarters)
    until_sent(push)
    push.take([*quarters, quarter_of(place, until + QUARTER, volume=np.nan, queue_max_m=20.0)])
    until_sent(push)
    again = push_of(server, place, tmp_path)  # a new start reads the day again
    again.take([quarter_of(place, until, volume=8.0)])
    until_sent(again)
    assert server.odd == []
    lane = f"junction/lane/{place.lane_numbers[0]}"
    first, second = ((f"2025-06-15T15:{begin}:00Z/2025-06-15T15:{end}:00Z")
                     for begin, end in (("00", "15"), ("15", "30")))  # fmt: skip
    assert [each for each in server.results() if each[0].startswith(f"{lane}/")] == [
        (f"{lane}/hits", first, 10.0), (f"{lane}/hits", second, 10.0),
        (f"{lane}/occupancy", first, 12.5), (f"{lane}/occupancy", second, 12.5),
        (f"{lane}/queue_max_m", second, 20.0),
        (f"{lane}/speed_kmh", first, 31.25), (f"{lane}/speed_kmh", second, 31.25),
        (f"{lane}/volume", first, 7.0),
    ]  # fmt: skip
    sizes = {name: len(rows) for name, rows in server.entities.items()}
    assert sizes == {"Things": lanes, "Locations": lanes, "Datastreams": 5 * lanes, "Sensors": 1,
                     "ObservedProperties": 5, "Observations": 8 * lanes}  # fmt: skip
    beside = [each["parameters"] for each in server.entities["Observations"]]
    assert {"volume_se": 1.5} in beside
    assert {"visible_share": 0.9} in beside


def test_a_server_that_fails_gets_all_of_it_later_and_nothing_twice(server, place, tmp_path):
    said = Lines()
    server.fails, server.drops = 2, 1
    push = push_of(server, place, tmp_path, said)
    count(push, place, BEGIN, 1)
    kept = json.loads((tmp_path / "waiting.json").read_text())
    assert len(kept["waiting"]) == len(place.lane_numbers)
    until_sent(push)
    results = server.results()
    assert len(results) == len({each[:2] for each in results}) == len(place.lane_numbers)
    assert sum("answers 503" in line for line in said.lines) >= 1
    assert said.lines[-1] == "the server of lane measures takes them again"
    assert json.loads((tmp_path / "waiting.json").read_text())["waiting"] == []


def test_what_waited_when_fusion_was_killed_is_sent_after_a_new_start(server, place, tmp_path):
    rows = [LaneMeasure(place.lane_numbers[0], "hits", BEGIN, BEGIN + 1200, 12.5, 60.0)]
    (tmp_path / "waiting.json").write_text(json.dumps({"quarters": [], "waiting": rows}))
    push = push_of(server, place, tmp_path)
    until_sent(push)
    assert [each[2] for each in server.results()] == [12.5]


@pytest.mark.parametrize(
    "damaged",
    [
        "[[1, 2]]",
        "{",
        "5",
        '{"quarters": [], "waiting": [[1, "hits", 2, 3, "a", 5]]}',
        '{"quarters": [], "waiting": [[1, "else", 2, 3, 4.0, 5.0]]}',
        '{"waiting": []}',
    ],
)
def test_a_damaged_file_is_put_aside(server, place, tmp_path, damaged):
    said, file = Lines(), tmp_path / "waiting.json"
    file.write_text(damaged)
    assert push_of(server, place, tmp_path, said).waiting == 0
    (aside,) = tmp_path.glob("waiting.json.*")
    assert aside.read_text() == damaged
    assert said.lines == [f"{file}: it is damaged, and put aside as {aside.name}"]


@pytest.mark.parametrize(
    ("keys", "header"),
    [({"token_file": "abc"}, "Bearer abc"),
     ({"user": "u", "password_file": "p"}, "Basic dTpw"), ({}, None)],
)  # fmt: skip
def test_log_ins_are_sent(server, tmp_path, keys, header, monkeypatch):
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # not for this machine
    given = {}
    for key, text in keys.items():
        given[key] = text
        if key.endswith("_file"):
            (tmp_path / key).write_text(f"{text}\n")
            given[key] = str(tmp_path / key)
    Service.of(table(server, **given)).find("Sensors", "x'y")
    assert server.asked == [("GET", "/v1.1/Sensors?$filter=name eq 'x''y'&$top=1&$select=@iot.id",
                             header)]  # fmt: skip


def test_a_site_pushes_only_where_its_file_says_so(tmp_path, once, server):
    """Where it does, what waits in its folder is read: here a damaged file."""
    more = f'[live.sensorthings]\naddress = "{server.address}"'
    for name, of_live, read in (("one", "", 0), ("two", more, 1)):
        (tmp_path / name / "live").mkdir(parents=True)
        (tmp_path / name / "live" / "sensorthings.json").write_text("{")
        site, said = LiveSite(tmp_path / name, once, of_live=of_live), Lines()
        Fusion(read_live_site(site.file), reporter=said).close()
        assert len(said.lines) == said.told("it is damaged") == read
    site.file.write_text(site.file.read_text().replace(server.address, "ftp://x"))
    with pytest.raises(InputError, match="expected an http or https address"):
        read_live_site(site.file)


OK = b"HTTP/1.0 200 OK\r\n\r\n"


@pytest.mark.parametrize(
    ("method", "answer"),
    [("GET", b"HTTP/1.0 200 OK\r\nContent-Length: 99\r\n\r\n{"), ("GET", b"nonsense\r\n\r\n"),
     ("GET", OK + b'{"value": [5]}'), ("GET", OK + b'{"value": 5}'), ("GET", OK + b"[" * 10**5),
     ("GET", OK + b'{"value": [{"@iot.id": {}}]}'), ("POST", OK + b"5")],
)  # fmt: skip
def test_what_is_no_answer_of_such_a_server_is_an_error_of_it(server, place, method, answer):
    rows = [LaneMeasure(place.lane_numbers[0], "hits", BEGIN, BEGIN + 1200, 1.0, 60.0)]
    lanes, begun = (LaneServer(Service.of(table(server)), place, "junction") for _ in range(2))
    lanes.push(rows)
    server.raw[method] = answer
    with pytest.raises(ServerError, match=server.address):
        (begun if method == "GET" else lanes).push(rows)
    if method == "GET" and b"iot.id" not in answer:  # for times an id is nothing
        with pytest.raises(ServerError, match=server.address):
            lanes.push(rows, again=True)


def test_whatever_the_push_meets_fusion_goes_on_and_says_it_once(server, place, tmp_path):
    said, end = Lines(), time.monotonic() + 1.0  # four tries
    push = push_of(server, place, tmp_path, said)
    count(push, place, QUARTER * 10**14, 1)  # of no year
    wait_for(lambda: push.poll() or (said.lines and time.monotonic() > end))
    assert len(said.lines) == 1
    assert said.told("lane measures cannot be pushed: ")
    assert push.waiting == len(place.lane_numbers)


def test_measures_of_lanes_that_the_map_no_longer_has_do_not_hold_up_others(
    server, place, tmp_path
):
    rows = [LaneMeasure(max(place.lane_numbers) + 1, "hits", BEGIN, BEGIN + 1200, 1.0, 60.0)]
    (tmp_path / "waiting.json").write_text(json.dumps({"quarters": [], "waiting": rows}))
    assert push_of(server, place, tmp_path).waiting == 0


def test_what_is_counted_again_arrives_once(server, place, tmp_path):
    lanes = len(place.lane_numbers)
    push = push_of(server, place, tmp_path)
    count(push, place, BEGIN, 2)
    until_sent(push)
    again = push_of(server, place, tmp_path)  # killed: the hour is replayed
    count(again, place, BEGIN, 3)
    until_sent(again)
    assert len(server.entities["Observations"]) == 3 * lanes
    count(again, place, BEGIN, 2)  # the clock is set back
    until_sent(again)
    assert len(server.entities["Observations"]) == 3 * lanes
    count(again, place, BEGIN - QUARTER, 1)  # it was ahead: what was never there is new
    assert again.waiting == lanes
    until_sent(again)
    assert len({each[:2] for each in server.results()}) == len(server.results()) == 4 * lanes


@pytest.mark.parametrize("code", [301, 302, 303, 307, 308])
def test_a_server_that_sends_on_gets_nothing_sent_on(server, place, code):
    other = Server()
    rows = [LaneMeasure(place.lane_numbers[0], "hits", BEGIN, BEGIN + 1200, 1.0, 60.0)]
    lanes = LaneServer(Service.of(table(server)), place, "junction")
    lanes.push(rows)
    server.moved = code, other.address
    with pytest.raises(ServerError, match=f"the address to use is {other.address}$"):
        lanes.push(rows)
    with pytest.raises(ServerError, match=f"the address to use is {other.address}$"):
        lanes.push(rows, again=True)
    assert other.asked == []
    other.shutdown()
    other.server_close()


@pytest.mark.parametrize("key", ["token_file", "password_file"])
def test_a_log_in_goes_encrypted_or_stays_on_this_machine(tmp_path, once, key):
    (tmp_path / "secret").write_text("x")
    text = f'[live.sensorthings]\naddress = "http://x.example/v1.1"\n{key} = "secret"'
    site = LiveSite(tmp_path, once)
    bare = site.file.read_text().replace("[[sensor]]", f"{text}\n[[sensor]]", 1)
    site.file.write_text(bare)
    with pytest.raises(InputError, match="a password or token would go over http"):
        read_live_site(site.file)
    for place in ("https://x.example", "http://127.0.0.1:80", "http://[::1]", "http://localhost"):
        site.file.write_text(bare.replace("http://x.example", place))
        assert read_live_site(site.file).live.sensorthings is not None
