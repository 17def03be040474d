"""Alerts: one message where the state of a sensor changes, by MQTT and to a webhook."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace

import pytest
from live_programs import Lines
from live_site import Background, LiveSite, needs_mosquitto, wait_for

import gis_radar as gr
from gis_radar.base import Text, in_language
from gis_radar.base.languages import catalogue
from gis_radar.calibration import SENSOR_STATES
from gis_radar.calibration.findings import CLOCKS_APART, Cause, wrong
from gis_radar.live import Fusion, Link, SensorHealth, alerts, read_live_site
from gis_radar.live.alerts import CAUSES, HOLD_S, WELL, Alerts, Webhook
from gis_radar.live.wire.settings import webhook_address

NOON_S, BEGIN_S = 1_767_355_200.0, 5_000.0  # 2026-01-02T12:00:00Z


class Receiver(ThreadingHTTPServer):
    """A receiver of alerts; it answers the codes in `answers`, then 204."""

    daemon_threads = True

    def __init__(self, *answers):
        self.bodies, self.answers = [], list(answers)
        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_address[1]}/hook?token=secret"


class Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        assert self.headers["Content-Type"] == "application/json"
        assert self.path == "/hook?token=secret"
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.bodies.append(body)
        self.send_response(self.server.answers.pop(0) if self.server.answers else 204)
        self.send_header("Location", "/elsewhere")
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def receiver(request):
    with Receiver(*getattr(request, "param", ())) as found:
        yield found
        found.shutdown()


class Posted(list):
    """A webhook that keeps what it is given."""

    def put(self, content):
        self.append(json.loads(content))


class Watch:
    """Alerts of R1, asked each second of a clock of the test's own."""

    def __init__(self, folder, *, reporter=None, language="en"):
        self.health = SensorHealth(name="R1", heard_s=NOON_S)
        self.published, self.posted, self.second = [], Posted(), 0
        given = {} if reporter is None else {"reporter": reporter}
        self.alerts = Alerts(
            "junction", [self.health], path=folder / "alerts.json", webhook=self.posted,
            publish=lambda name, alert: self.published.append((name, json.loads(alert))),
            language=language, **given,
        )  # fmt: skip

    def run(self, seconds, **alarms):
        """Raise the alarms, end all others, and let seconds pass."""
        for kind in {*self.health.alarms} - alarms.keys():
            self.health.alarm(kind, None)
        for kind, text in alarms.items():
            self.health.alarm(kind, text)
        for _ in range(seconds):
            if not alarms.keys() & {"silent", "offline", "moved"}:
                self.health.heard_s = NOON_S + self.second
            self.alerts.check(NOON_S + self.second, BEGIN_S + self.second)
            self.second += 1
        return [each["state"] for each in self.posted]

    @property
    def states(self):
        return [alert["state"] for _, alert in self.published]


@pytest.fixture
def watch(tmp_path):
    return Watch(tmp_path)


def test_a_sensor_that_falls_silent_is_told_once_with_when_and_what_to_do(watch):
    watch.run(100)
    assert (watch.states, watch.posted) == (["works"], [])  # that all is well is no news
    watch.run(round(HOLD_S), silent="for 6 s")
    assert watch.states == ["works"]
    watch.run(500, silent="for 65 s")
    assert watch.published[1:] == [("R1", watch.posted[0])]
    assert watch.posted == [{
        "version": 2, "site": "junction", "sensor": "R1", "state": "silent",
        "since": "2026-01-02T12:01:39Z",  # its last frame
        "message": "R1: nothing comes from the sensor: for 65 s; check the radar and its cable; "
                   "where all sensors are silent, the broker",
    }]  # fmt: skip
    assert watch.run(100) == ["silent", "works"]
    assert watch.posted[1]["since"] == "2026-01-02T12:11:00Z"
    assert watch.posted[1]["message"] == "R1: it works; there is nothing to do"


def test_a_link_that_comes_back_and_a_sensor_that_flaps_send_no_message_each_time(watch):
    watch.run(100)
    assert watch.run(50, offline="lost") == []
    assert watch.run(100) == []
    for _ in range(100):
        watch.run(4, silent="for 6 s")
        watch.run(7)
    assert watch.posted[0]["state"] == "silent"
    assert watch.posted[0]["since"] == "2026-01-02T12:04:10Z"  # since it flaps
    assert len(watch.posted) == 1
    assert watch.run(100) == ["silent", "works"]


@pytest.mark.parametrize(
    ("alarms", "state"),
    [
        ({"silent": "for 9 s", "moved": "its pose is not known"}, "moved"),
        ({"offline": "lost", "moved": "its pose is not known"}, "silent"),
        ({"silent": "for 9 s", "off_time": "frames of 1970"}, "clock off"),
        ({"silent": "for 9 s", "refused": "tiles a, expected b"}, "silent"),
        ({"pose": "does not fit", "clock": "+50 ms"}, "pose doubtful"),
        ({"pose": wrong("3 s", Cause(Text(CLOCKS_APART, "R2"), "")).text_with_advice}, "clock off"),
        ({"clock": "+50 ms"}, "clock off"),
        ({"damaged": "number 5", "twins": "two", "off_time": "one frame"}, "works"),
    ],
)
def test_the_worst_of_several_alarms_says_what_state_it_is(watch, alarms, state):
    watch.run(70, **alarms)
    assert watch.states == [state]


def test_from_one_fault_to_another_is_a_message(watch):
    watch.run(70, clock="+50 ms")
    assert watch.run(70, moved="its pose is not known") == ["clock off", "moved"]
    first, second = (each["since"] for each in watch.posted)
    assert (first, second) == ("2026-01-02T12:00:00Z", "2026-01-02T12:01:10Z")


def test_a_new_start_tells_nothing_again_and_the_broker_all(watch, tmp_path):
    watch.run(70, pose="does not fit")
    again = Watch(tmp_path)
    again.alerts.repeat()
    assert again.published == watch.published
    assert again.run(100, pose="does not fit") == []
    assert again.run(70) == ["works"]  # which it became meanwhile


@pytest.mark.parametrize("text", ["{", "[1]", '{"R1": 3}', '{"R1": {}}'])
def test_a_damaged_file_of_alerts_stops_nothing(tmp_path, text):
    said = Lines()
    (tmp_path / "alerts.json").write_text(text)
    assert Watch(tmp_path, reporter=said).run(70, clock="+50 ms") == ["clock off"]
    assert said.told("alerts.json: it is damaged")


def test_states_are_those_of_a_city_and_sentences_in_the_sites_language(tmp_path):
    texts = {Text(each) for cause in CAUSES for each in (cause.state, cause.advice)}
    assert texts | {WELL} <= catalogue("de").keys()
    assert {each.state for each in CAUSES} <= {*SENSOR_STATES}
    watch = Watch(tmp_path, language="de")
    with in_language("en"):
        watch.run(70, silent=Text("for {:.0f} s", 65.0))
    assert watch.posted[0]["state"] == "silent"
    assert watch.posted[0]["message"].startswith("R1: vom Sensor kommt nichts: seit 65 s; ")


@pytest.mark.parametrize("receiver", [(503, 301)], indirect=True)
def test_a_receiver_that_fails_gets_the_alert_again_and_is_told_once(receiver, monkeypatch):
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # not for this machine
    said = Lines()
    hook = Webhook(receiver.address, retries_s=(0.01, 0.02, 0.04), reporter=said)
    hook.put(b'{"state": "silent"}')
    wait_for(lambda: hook.sent == 1 and len(said.lines) == 2)
    assert receiver.bodies == [{"state": "silent"}] * 3
    assert said.lines == [
        "the webhook at 127.0.0.1 takes no alerts: it answers 503",
        "the webhook at 127.0.0.1 takes alerts again",
    ]
    assert hook.figures() == {"webhook_sent": 1.0, "webhook_lost": 0.0}


def test_alerts_that_nobody_takes_are_counted_and_hold_nothing_up(monkeypatch):
    monkeypatch.setattr(alerts, "MOST_ALERTS_WAITING", 2)
    said, receiver = Lines(), Receiver()
    receiver.shutdown()  # takes connections, and answers nothing
    monkeypatch.setattr(alerts, "TIMEOUT_S", 0.5)
    hook = Webhook(receiver.address, retries_s=(0.01,), reporter=said)
    begin = time.monotonic()
    for _ in range(5):
        hook.put(b"{}")
    assert time.monotonic() - begin < alerts.TIMEOUT_S
    wait_for(lambda: hook.lost == 5)
    assert said.lines == ["the webhook at 127.0.0.1 takes no alerts: timed out"]
    receiver.server_close()


@pytest.mark.parametrize(
    "url",
    ["http://alerts.example/secret", "ftp://127.0.0.1/secret", "https:///secret",
     "https://u:secret@a.example", "https://a:x/secret", "https://a.example/secret me", "secret",
     "", "https://[a/secret"],
)  # fmt: skip
def test_other_addresses_are_refused_and_not_repeated(tmp_path, once, url):
    with pytest.raises(gr.UsageError, match="the address of the webhook is none") as caught:
        gr.run_fusion(LiveSite(tmp_path, once).file, webhook=url)
    assert "secret" not in f"{caught.value}{caught.value.hint}"


@pytest.mark.parametrize("url", ["https://a.example/x?y=z", "http://localhost:80", "http://[::1]"])
def test_addresses(url):
    assert webhook_address(url) == url


@needs_mosquitto
@pytest.mark.usefixtures("measured_in_a_thread")
def test_a_live_site_tells_an_operator_and_its_webhook(tmp_path, once, receiver, monkeypatch):
    monkeypatch.setattr(alerts, "HOLD_S", 0.5)
    site = LiveSite(tmp_path, once)
    site.let_in("operator", "topic read v1/#")
    site.broker.start()
    address = read_live_site(site.file).address()
    operator = Link(
        type(address).of(site.address, user="operator", password="secret"),  # noqa: S106
        name="operator", topics=("v1/junction/+/health",),
    )  # fmt: skip
    operator.open()
    fusion = Fusion(read_live_site(site.file), webhook=Webhook(receiver.address))
    middle = Background(fusion.run)
    try:
        wait_for(lambda: len(receiver.bodies) >= 2)
        heard = {}

        def is_heard():
            while (message := operator.take(0.0)) is not None:
                heard[message.topic] = json.loads(message.payload)
            return len(heard) == 2 and all(each["state"] == "silent" for each in heard.values())

        wait_for(is_heard)
        assert sorted(heard) == ["v1/junction/R1/health", "v1/junction/R2/health"]
        told = sorted(receiver.bodies, key=lambda each: each["sensor"])
        assert told == [heard[topic] for topic in sorted(heard)]
        assert "gis_radar_webhook_sent 2.0" in fusion.metrics()
        site.broker.kill()
        heard.clear()
        site.broker.start()  # without a memory
        wait_for(is_heard)
    finally:
        middle.end()
        operator.close()
        site.broker.kill()
    assert len(receiver.bodies) == 2


def test_the_log_is_in_one_language(tmp_path, once, run, monkeypatch):
    site = LiveSite(tmp_path, once)
    done = SimpleNamespace(outputs=[], figures=dict)

    def fusion(_, *, reporter, **_more):
        reporter.warn("{}: {}: {}", "R1", Text("nothing comes from the sensor"), "5 s")
        return done

    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    monkeypatch.setattr(gr, "run_fusion", fusion)
    code, _, said = run("live", site.file)
    assert (code, said) == (0, "warning: R1: nothing comes from the sensor: 5 s\n")
    monkeypatch.undo()
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    assert "lässt sich nicht lesen" in run("live", tmp_path / "none.toml")[2]


def test_the_option_reaches_fusion_and_its_unit(tmp_path, once, run, monkeypatch):
    site, given = LiveSite(tmp_path, once), {}
    hook = "https://alerts.example/a%20b?c=$d"
    done = SimpleNamespace(outputs=[], figures=dict)
    with monkeypatch.context() as patched:
        patched.setattr(gr, "run_fusion", lambda _, **more: given.update(more) or done)
        assert run("live", site.file, "--webhook", hook)[0] == 0
    assert given["webhook"] == hook
    assert run("live", site.file, "--webhook", hook, "--broker-files", tmp_path / "b")[0] == 0
    unit = (tmp_path / "b" / "gis-radar-live.service").read_text()
    assert ' "--webhook" "https://alerts.example/a%%20b?c=$$d"\n' in unit
    for more in ((), ("--broker-files", tmp_path / "c")):
        assert run("live", site.file, "--webhook", "http://a.example", *more)[0] == 2
    assert not (tmp_path / "c").exists()
