"""Link to the broker: MQTT 5 by paho, with TLS, a will, and a new connection after each loss.

The broker keeps no sessions: messages that must not be lost wait at the sensor until fusion has
stored them, so that a broker may be killed, or lose its disk.
"""

from __future__ import annotations

import ssl
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from gis_radar.base import QUIET, GisRadarError, InputError, Reporter, Text, UsageError
from gis_radar.live.wire.payload import MOST_BYTES

if TYPE_CHECKING:
    from paho.mqtt.client import Client

LIVE = "pip install gis_radar[live]"
TOPICS = "v1"  # the version of the tree of topics
FUSION = "fusion"  # fusion's name in topics, and its user name at the broker
_PORTS = {"mqtt": 1883, "mqtts": 8883}
_KEEP_ALIVE_S = 10  # a cut link is noticed after 1.5 times this
_SLOWEST_RETRY_S = 30
IN_FLIGHT = 100  # messages sent before the broker has confirmed the first
_TAKEN_OVER, _REFUSED = 142, range(128, 256)  # reason codes of MQTT 5
# Short links in this time that no restart explains: another program has the same name.
_SHORT_LINKS, _SHORT_LINKS_WITHIN_S = 3, 120.0
_POLL_S = 0.005  # between two looks at an empty queue
_SHORT_LINK_S = 10.0  # duration below which a link is short


@dataclass(frozen=True, kw_only=True)
class BrokerAddress:
    """Address of a broker and the log-in there.

    Parameters
    ----------
    host, port : str, int
        Host and port.
    user, password : str
        The log-in; empty for none.
    tls : bool
        Whether the link is encrypted.
    authority : Path, optional
        Certificate of the authority that signed the broker's; by default the system's are used.
    """

    host: str
    port: int
    user: str = ""
    password: str = field(default="", repr=False)
    tls: bool = False
    authority: Path | None = None

    @classmethod
    def of(cls, address: str, **options: Any) -> BrokerAddress:
        """Read `mqtt://HOST[:PORT]` or `mqtts://HOST[:PORT]`.

        Raises
        ------
        UsageError
            If it is no such address.
        """
        if "@" in address:  # a password may stand before it, which the message must not repeat
            raise UsageError(
                "the address of a broker holds a user", hint="state user and password_file"
            )
        try:
            parts = urlsplit(address)
            port = _PORTS[parts.scheme] if parts.port is None else parts.port
            fits = bool(parts.hostname and port) and not (
                parts.path.strip("/") or parts.query or parts.fragment
            )
        except (ValueError, KeyError):
            fits = False
        if not fits:
            raise UsageError(
                "{} is no address of a broker",
                repr(address),
                hint="such as mqtts://broker.example:8883",
            )
        return cls(host=parts.hostname or "", port=port, tls=parts.scheme == "mqtts", **options)

    def __str__(self) -> str:
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.host}:{self.port}"


class Received(NamedTuple):
    """A received message.

    Parameters
    ----------
    topic : str
        Its topic.
    payload : bytes
        Its content.
    time : float
        Arrival, UNIX seconds.
    retained : bool
        Whether the broker had kept it from before.
    """

    topic: str
    payload: bytes
    time: float
    retained: bool


class Link:
    """Connection to the broker that is made again whenever it is lost.

    Parameters
    ----------
    address : BrokerAddress
        Address of the broker.
    name : str
        Id of the client, for log lines; the broker uses the user's name.
    topics : sequence of str
        Topics to subscribe to.
    will : (str, bytes), optional
        Topic and content, published by the broker and retained once this program is gone.
    reporter : Reporter
        Receives a line when the link is made, lost or refused.

    Attributes
    ----------
    connections : int
        Number of times it was made.

    Raises
    ------
    GisRadarError
        If paho-mqtt is not installed.
    InputError
        If the certificate of the authority cannot be read.
    """

    def __init__(
        self, address: BrokerAddress, *, name: str, topics: tuple[str, ...] = (),
        will: tuple[str, bytes] | None = None, reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.connections = 0
        self._address, self._name, self._topics = address, name, topics
        self._reporter, self._logged = reporter, ""
        self._received: SimpleQueue[Received] = SimpleQueue()
        self._taken: deque[float] = deque(maxlen=_SHORT_LINKS)
        self._connected, self._refusing, self._since = False, False, 0.0
        self._client = self._new_client(will)

    def _new_client(self, will: tuple[str, bytes] | None) -> Client:
        """Return paho's client with log-in, TLS, will and callbacks; refuse a missing paho."""
        try:
            from paho.mqtt import client as mqtt  # noqa: PLC0415 - an extra
            from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415
            from paho.mqtt.packettypes import PacketTypes  # noqa: PLC0415
            from paho.mqtt.properties import Properties  # noqa: PLC0415
        except ImportError as error:
            raise GisRadarError("paho-mqtt is not installed", hint=LIVE) from error
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2, client_id=self._name, protocol=mqtt.MQTTv5
        )
        if self._address.user:
            client.username_pw_set(self._address.user, self._address.password)
        if self._address.tls:
            client.tls_set_context(_tls_context(self._address.authority))
        if will is not None:
            client.will_set(will[0], will[1], qos=1, retain=True)
        client.max_inflight_messages_set(IN_FLIGHT)
        client.reconnect_delay_set(1, _SLOWEST_RETRY_S)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_connect_fail = self._on_connect_fail
        client.on_message, client.on_publish = self._on_message, self._on_publish
        self._properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        self._properties.MaximumPacketSize = MOST_BYTES + 1024
        return client

    def open(self) -> None:
        """Start connecting in the background."""
        self._client.connect_async(
            self._address.host, self._address.port, keepalive=_KEEP_ALIVE_S, clean_start=True,
            properties=self._properties,
        )  # fmt: skip
        self._client.loop_start()

    def close(self, topic: str = "", farewell: bytes = b"") -> None:
        """Disconnect; a farewell is retained in place of the will."""
        if topic and self._connected:
            self._client.publish(topic, farewell, qos=1, retain=True).wait_for_publish(2.0)
        self._client.disconnect()
        self._client.loop_stop()
        self._connected = False

    @property
    def connected(self) -> bool:
        """Whether the link is up."""
        return self._connected

    def publish(self, topic: str, payload: bytes, *, retain: bool = False, qos: int = 1) -> None:
        """Publish a message; without a link it is dropped.

        Detections go at QoS 0: fusion acknowledges what it has stored and asks for what is missing,
        so acknowledgements of the broker would add nothing.
        """
        if self._connected:
            self._client.publish(topic, payload, qos=qos, retain=retain)

    def take(self, timeout_s: float) -> Received | None:
        """Return the next received message, or None after `timeout_s` seconds."""
        until = time.monotonic() + timeout_s
        while True:
            try:
                return self._received.get_nowait()
            except Empty:
                # not `get` with a timeout: in 3.11, a signal as it expires makes it wait for ever
                left = until - time.monotonic()
                if left <= 0.0:
                    return None
                time.sleep(min(left, _POLL_S))

    def _log_once(self, text: str) -> None:
        if text != self._logged:  # log a failure once, however often it is retried
            self._logged = text
            self._reporter.log(
                Text("{}: {}", self._name, text), "info" if self._connected else "warning"
            )

    # Callbacks, which paho calls in its thread.

    def _on_connect(self, _c: Any, _u: Any, _f: Any, reason: Any, _p: Any) -> None:
        """Subscribe once the broker accepts the link."""
        self._refusing = bool(reason.is_failure)
        if self._refusing:
            self._log_once(
                Text("the broker at {} refuses the link: {}; trying on", self._address, reason)
            )
            return
        if self._topics:
            self._client.subscribe([(topic, 1) for topic in self._topics])
        self._connected, self._since = True, time.monotonic()
        self.connections += 1
        self._log_once(Text("linked to the broker at {}", self._address))

    def _on_connect_fail(self, _c: Any, _u: Any) -> None:
        # paho calls this while it handles the exception, and passes no reason
        self._log_once(Text("{}; trying on", _why_no_link(sys.exc_info()[1], self._address)))

    def _on_disconnect(self, _c: Any, _u: Any, _f: Any, reason: Any, _p: Any) -> None:
        """Log why the link ended, and reconnect slowly where another program has the same name."""
        was, self._connected = self._connected, False
        if not was and _code(reason) and not self._refusing:
            self._log_once(
                Text(
                    "the broker at {} ends the link at once: does it speak {}://? trying on",
                    self._address,
                    Text("mqtt") if self._address.tls else Text("mqtts"),
                )
            )
        self._refusing = False
        if not was or not _code(reason):
            return
        now = time.monotonic()
        # Mosquitto 2.0 sends no reason code when another program takes the name over.
        if _code(reason) == _TAKEN_OVER or now - self._since < _SHORT_LINK_S:
            self._taken.append(now)
        if len(self._taken) == _SHORT_LINKS and now - self._taken[0] < _SHORT_LINKS_WITHIN_S:
            # reconnect slowly: the other program is served meanwhile, and both report it
            self._client.reconnect_delay_set(_SLOWEST_RETRY_S // 2, _SLOWEST_RETRY_S)
            self._log_once("the broker ends each link soon: has another program the same name?")
            return
        self._log_once(Text("the link to the broker is lost: {}; trying on", reason))

    def _on_message(self, _c: Any, _u: Any, message: Any) -> None:
        self._received.put(
            Received(message.topic, message.payload, time.time(), bool(message.retain))
        )

    def _on_publish(self, _c: Any, _u: Any, _mid: int, reason: Any, _p: Any) -> None:
        if _code(reason) in _REFUSED:
            self._log_once(Text("the broker does not take a message: {}", reason))


def _why_no_link(error: BaseException | None, address: BrokerAddress) -> str:
    """Return the reason why a link failed: no answer, or an untrusted certificate."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return Text(
            "the certificate of the broker at {} is refused: {}", address, error.verify_message
        )
    if isinstance(error, ssl.SSLError):
        reason = error.reason or str(error)
        return Text("the broker at {} does not speak TLS as expected: {}", address, reason)
    return Text("no broker answers at {}", address)


def _code(reason: Any) -> int:
    """Return the reason code of MQTT 5."""
    return int(getattr(reason, "value", 0))


def _tls_context(authority: Path | None) -> ssl.SSLContext:
    """Return a TLS context from version 1.2 on, by the system's authorities or by one's own."""
    try:
        context = ssl.create_default_context(cafile=authority)
    except (OSError, ssl.SSLError) as error:
        raise InputError("{}: no certificate of an authority: {}", authority, error) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


@dataclass(frozen=True)
class SensorTopics:
    """The topics of a sensor: `v1/SITE/SENSOR/detections`, and so on.

    Parameters
    ----------
    site, sensor : str
        Names of site and sensor; `+` matches any.
    """

    site: str
    sensor: str

    def of(self, kind: str) -> str:
        """Return the topic of `detections`, `status`, `pose`, `ack` or `health`."""
        return f"{TOPICS}/{self.site}/{self.sensor}/{kind}"


def parts_of(topic: str) -> tuple[str, str]:
    """Return sensor and kind of a topic; both are empty if it is not of this tree."""
    parts = topic.split("/")
    return (parts[2], parts[3]) if len(parts) == 4 and parts[0] == TOPICS else ("", "")
