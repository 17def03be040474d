"""Who reaches the live system and means it harm: readers of the page, and sensors."""

import asyncio
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import ExitStack, contextmanager
from copy import copy

import pytest
from live_programs import Lines
from live_replay import Replay
from live_site import LONGEST_S, LiveSite, free_port

from gis_radar.base import InputError, Reporter
from gis_radar.cli.console import JsonConsole, TerminalConsole
from gis_radar.live import (
    Intake,
    PoseContent,
    Received,
    Spool,
    WebServer,
    Windows,
    make_app,
    read_live_site,
)
from gis_radar.live.served.page import MOST_READERS, page_server
from gis_radar.live.web_server import MOST_CONNECTIONS, REQUEST_S
from gis_radar.measures import FrameCounter
from gis_radar.poses import pose_from_dict
from gis_radar.scans import SightTiles


@pytest.fixture(scope="module")
def live(measure_once):
    return Replay(measure_once)


@contextmanager
def served(live, **given):
    server = WebServer(make_app(live), "127.0.0.1:0", **given)
    try:
        yield ("127.0.0.1", int(server.open().rstrip("/").rpartition(":")[2]))
    finally:
        server.close()


@pytest.fixture(scope="module")
def place(live):
    with served(live) as place:
        yield place


def code_of(place, path, **headers):
    request = urllib.request.Request(f"http://{place[0]}:{place[1]}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=LONGEST_S) as answer:  # noqa: S310
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def is_closed(connection):
    """Tell whether the other end has closed a connection, which sent nothing that matters."""
    connection.setblocking(False)
    try:
        while connection.recv(65_536):
            pass
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True
    return True


def test_the_token_in_the_file_of_the_page_is_asked_for(live, tmp_path, once):
    (tmp_path / "token").write_text("s3cret\n")
    site = LiveSite(tmp_path, once)
    table = f'[live.page]\naddress = "127.0.0.1:{free_port()}"\ntoken_file = "token"\n[[sensor]]'
    site.file.write_text(site.file.read_text().replace("[[sensor]]", table, 1))
    read = read_live_site(site.file)
    page = page_server(live, read, read.live.page, live.place.tiles)
    try:
        place = ("127.0.0.1", int(page.open().rstrip("/").rpartition(":")[2]))
        assert code_of(place, "/metrics") == 401
        assert code_of(place, "/metrics", Authorization="Bearer s3cret") == 200
    finally:
        page.close()


def test_idle_connections_take_no_more_files_than_there_are(place):
    assert 3 * MOST_CONNECTIONS <= 1024  # that a process may usually open
    with ExitStack() as stack:
        idle = [stack.enter_context(socket.create_connection(place, LONGEST_S))
                for _ in range(MOST_CONNECTIONS + 100)]  # fmt: skip
        assert code_of(place, "/state.json") == 200
        still_open = [each for each in idle if not is_closed(each)]
        assert len(still_open) <= MOST_CONNECTIONS
        assert is_closed(idle[0])  # those that waited longest were closed


@pytest.mark.parametrize("before", [b"", b"GET /ogc HTTP/1.1\r\nHost: localhost\r\n\r\n"])
def test_half_a_header_is_not_waited_for(place, before):
    with socket.create_connection(place, LONGEST_S) as connection:
        begin = time.monotonic()
        connection.sendall(before)
        connection.sendall(b"GET / HTTP/1.1\r\nX-Slow: ")
        while not is_closed(connection):
            time.sleep(0.2)
            assert time.monotonic() - begin < 20 * REQUEST_S
            try:
                connection.send(b"x")  # each byte begins uvicorn's own time-out anew
            except OSError:
                break
        assert time.monotonic() - begin > REQUEST_S - 1.0


def test_who_does_not_read_is_not_waited_for(live):
    with (
        served(live, unread_s=1.0) as place,
        socket.create_connection(place, LONGEST_S) as connection,
    ):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65_536)
        asked = b"GET /site.json HTTP/1.1\r\nHost: localhost\r\n\r\n"
        connection.sendall(20 * asked)  # megabytes: more than the system keeps for who is slow
        time.sleep(3.0)
        found = 0
        while part := connection.recv(65_536):
            found += len(part)
        with urllib.request.urlopen(f"http://{place[0]}:{place[1]}/site.json") as answer:
            assert 0 < found < 10 * len(answer.read())


def test_a_connection_serves_one_request_after_another(place):
    asked = b"GET /ogc HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with socket.create_connection(place, LONGEST_S) as connection:
        for asks in (asked, 2 * asked, asked):
            connection.sendall(asks)
            found = b""
            while found.count(b"HTTP/1.1 200") < len(asks) // len(asked):
                found += connection.recv(65_536)


async def _codes(live, count):
    """Ask for the stream of events many times at once; give what each is answered at first."""
    app = make_app(live)
    codes, gone, answered = [], asyncio.Event(), asyncio.Event()
    scope = {"type": "http", "method": "GET", "path": "/events", "query_string": b"",
             "headers": [(b"host", b"localhost")], "root_path": "",
             "asgi": {"spec_version": "2.3"}}  # fmt: skip

    async def receive():
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message):
        if message["type"] == "http.response.start":
            codes.append(message["status"])
            if not len(codes) % count:
                answered.set()

    for _ in range(2):
        gone.clear()
        answered.clear()
        readers = [asyncio.create_task(app(dict(scope), receive, send)) for _ in range(count)]
        async with asyncio.timeout(LONGEST_S):
            await answered.wait()
            gone.set()
            await asyncio.gather(*readers)
            await asyncio.sleep(0)
    return codes


def test_a_burst_of_readers_does_not_pass_their_limit_and_leaves_no_trace(live):
    assert MOST_READERS < MOST_CONNECTIONS  # who asks once is answered, too
    codes = asyncio.run(_codes(live, 500))
    for burst in (codes[:500], codes[500:]):
        assert (burst.count(200), burst.count(503)) == (MOST_READERS, 500 - MOST_READERS)


@pytest.mark.parametrize("name", ["tiles", "vehicles", "lanes", "intervals", "sensors"])
def test_an_empty_layer_is_filtered_like_any_other(live, name):
    full, live = live.snapshot(), copy(live)
    empty = type(full)(step=0, now=full.now[:0], observed_now=full.observed_now,
                       hit=0 * full.hit, observed=0 * full.observed)  # fmt: skip
    live.snapshot, rows = lambda: empty, live.lane_intervals().iloc[:0]
    live.lane_intervals = lambda: rows
    asked = {"tiles": "hit_now", "vehicles": "speed", "lanes": "lane", "intervals": "lane",
             "sensors": "sensor"}[name]  # fmt: skip
    with served(live) as place:
        path = f"/ogc/collections/{name}/items?bbox=-180,-90,180,90&{asked}=1"
        assert code_of(place, path) == 200
        assert code_of(place, f"{path}&datetime=2025-06-12T07:31:00Z") == 200


def test_no_other_page_reads_metrics_in_the_name_of_this_machine(place):
    assert code_of(place, "/metrics") == 200
    assert code_of(place, "/metrics", Host="evil.example") == 400
    assert code_of(place, "/metrics", Host="localhost") == 200
    threads = threading.active_count()
    with ExitStack() as stack:
        for _ in range(50):
            stack.enter_context(socket.create_connection(place, LONGEST_S))
        assert code_of(place, "/metrics") == 200
        assert threading.active_count() < threads + 50  # a pool for answers is all


@pytest.mark.parametrize(
    "changes",
    [{"easting": 1e300}, {"easting": 5e7}, {"northing": -1e300}, {"height": 1e300},
     {"view": {"max_range_m": 1e300}}],
)  # fmt: skip
def test_a_pose_that_is_nowhere_is_not_taken(live, changes):
    record = live.poses["R1"].as_dict()
    pose_from_dict(record, what="R1")
    with pytest.raises(InputError, match=f"{next(iter(changes))}"):
        pose_from_dict(record | changes, what="R1")


@pytest.fixture
def said():
    return Lines()


@pytest.fixture
def intake(live, tmp_path, said):
    road = SightTiles.of(live.place.tiles)
    return Intake(
        ["R1"], spool=Spool(tmp_path / "spool"), road=road,
        counter=FrameCounter(road), windows=Windows(0.2),
        oldest_s=1e6, reporter=said,
    )  # fmt: skip


def test_fusion_goes_past_a_pose_that_is_nowhere(intake, live):
    pose = live.poses["R1"].as_dict() | {"easting": 1e300}
    message = PoseContent(pose=pose, fingerprint=live.place.fingerprint).pack()
    intake.handle(Received("v1/s/R1/pose", message, 1.0, retained=False))
    sensor = intake.sensors["R1"]
    assert sensor.pose is None
    assert "easting" in sensor.health.alarms["damaged"]


@pytest.mark.parametrize(
    "status",
    ['{"version": 2, "state": "online", "stream": "00\\nerror: forged"}',
     '{"version": 2, "state": "online", "stream": "' + 60_000 * "a" + '"}',
     '{"version": 2, "state": "online", "lost": ' + 4_000 * "9" + "}",
     '{"version": 2, "state": "online", "lost": ' + 60_000 * "9" + "}",
     '{"version": "' + 60_000 * "a" + '"}'],
)  # fmt: skip
def test_a_status_writes_no_line_of_its_own_and_no_long_one(intake, said, status):
    for text in (status, '{"version": 2, "state": "online", "stream": "0011aabb"}', status):
        intake.handle(Received("v1/s/R1/status", text.encode(), 1.0, retained=False))
    health = intake.sensors["R1"].health
    for text in (*said.lines, *health.alarms.values(), str(health.counts["lost"])):
        assert len(text.splitlines()) == 1
        assert len(text) < 600
    assert intake.sensors["R1"].stream == "0011aabb"


def test_a_status_whose_number_is_true_counts_nothing(intake):
    status = b'{"version": 2, "state": "online", "lost": true}'
    intake.handle(Received("v1/s/R1/status", status, 1.0, retained=False))
    assert "lost" not in intake.sensors["R1"].health.alarms


@pytest.mark.parametrize("console", [JsonConsole, TerminalConsole, Reporter])
def test_a_line_of_the_log_is_one_line(console, capsys, caplog):
    with caplog.at_level("INFO"):
        console().log("R1\nerror: forged \x1b[2J \u2028" + 60_000 * "x")
    written = "".join([*capsys.readouterr(), *(each.getMessage() for each in caplog.records)])
    assert len(written.strip().splitlines()) == 1
    assert "\x1b" not in written
    assert len(written) < 3_000


@pytest.mark.parametrize("console", [JsonConsole, TerminalConsole])
def test_what_to_do_about_an_error_is_one_line(console, capsys):
    console().error(InputError("not known", hint="it has a\nerror: forged \x1b[2J \u2028b"))
    written = "".join(capsys.readouterr())
    assert len(written.strip().splitlines()) == 1
    assert not any(each in written for each in ("\x1b", "\\n", "\\u001b"))  # as it is, as JSON
