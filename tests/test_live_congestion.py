"""Many sensors behind a broker, and fusion that stood still: none is lost, and none gets stuck."""

from collections import deque
from types import SimpleNamespace

from test_live_faults import PRINT, Lines

from gis_radar.live import (
    Acknowledgement,
    DiskBuffer,
    Outbox,
    Received,
    SensorTopics,
    check_of,
    unpack_message,
)

SENSORS, RATE, STEP_S = 8, 20, 0.25
QUEUED = 2 * 400 * SENSORS  # that the broker holds, as its files say
DRAINED = round(1.25 * SENSORS * RATE * STEP_S)  # that fusion takes in a step: a quarter more


class Broker:
    """Holds messages in order, as many as it may; the others are dropped, as Mosquitto does."""

    def __init__(self):
        self.queue = deque()

    def publish(self, topic, payload, *, retain=False, qos=1):
        del retain, qos
        if topic.endswith("detections") and len(self.queue) < QUEUED:
            self.queue.append((topic.split("/")[2], payload))


class Link:
    """A sensor's link to the broker."""

    def __init__(self, broker):
        self.publish, self.received = broker.publish, deque()
        self.connected, self.connections = True, 1

    def take(self, _timeout_s):
        return self.received.popleft() if self.received else None


class Sensor:
    """A sensor with its outbox, and what fusion knows of it."""

    def __init__(self, name, folder, broker):
        self.link = Link(broker)
        self.buffer = DiskBuffer(folder / name, most_bytes=10**8, fingerprint=PRINT)
        self.buffer.add_pose(b"a pose")
        topics = SensorTopics("s", name)
        self.outbox = Outbox(self.buffer, self.link, topics, figures=dict, reporter=Lines())
        self.stored = self.resend = self.again = 0
        self.waits = False

    def take(self, payload):
        """Take a message as fusion does: in order, and once; ask again where some are missing."""
        envelope, content = unpack_message(payload)
        if envelope.number <= self.stored:
            self.again += 1
        elif envelope.number == self.stored + 1:
            self.stored, self.check, self.waits = envelope.number, check_of(content), False
        elif not self.waits:
            self.resend, self.waits = self.resend + 1, True

    def acknowledge(self):
        if self.stored:
            found = Acknowledgement(
                stream=self.buffer.stream.hex(), stored=self.stored, check=self.check,
                session="a", resend=self.resend,
            )  # fmt: skip
            self.link.received.append(Received("ack", found.pack(), 1.0, retained=True))


def test_what_waited_while_fusion_stood_still_is_caught_up(tmp_path, monkeypatch):
    """Fusion stands still for a minute, then takes a quarter more than what comes."""
    clock = SimpleNamespace(now_s=1000.0)
    clock.monotonic = lambda: clock.now_s
    monkeypatch.setattr("gis_radar.live.wire.outbox.time", clock)
    broker = Broker()
    sensors = {f"R{k}": Sensor(f"R{k}", tmp_path, broker) for k in range(SENSORS)}
    made = 0
    for step in range(round(400 / STEP_S)):
        clock.now_s += STEP_S
        for each in sensors.values():
            for _ in range(round(RATE * STEP_S)):
                each.outbox.put(b"some detections")
            each.outbox.pump()
        made += round(RATE * STEP_S)
        if step * STEP_S >= 60.0:
            for _ in range(min(DRAINED, len(broker.queue))):
                name, payload = broker.queue.popleft()
                sensors[name].take(payload)
            if step % 4 == 0:  # fusion's disk
                for each in sensors.values():
                    each.acknowledge()
    behind = max(made - each.stored for each in sensors.values())
    again = sum(each.again for each in sensors.values())
    assert behind < 5 * RATE  # seconds
    assert again < 0.2 * made * SENSORS
