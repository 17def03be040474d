"""Files for a broker: Mosquitto's configuration, access, passwords; systemd units."""

from __future__ import annotations

import base64
import getpass
import hashlib
import secrets
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from gis_radar.base import atomic_folder
from gis_radar.live.wire.broker import FUSION, IN_FLIGHT, TOPICS, BrokerAddress
from gis_radar.live.wire.outbox import UNACKNOWLEDGED
from gis_radar.live.wire.payload import MOST_BYTES
from gis_radar.live.wire.settings import LiveSite, read_live_site, webhook_address

_CONFIG_FILE, ACCESS, _PASSWORDS = "mosquitto.conf", "access", "passwords"
# Begins of names in the folder; files of TLS, `server.*`, come from elsewhere and stay.
_OWNED = (_CONFIG_FILE, ACCESS, _PASSWORDS, "gis-radar-", "password_of_", "server.")
_ROUNDS, _SALT_BYTES = 101, 12  # as in Mosquitto's own mosquitto_passwd
_HEADER_BYTES = 1024  # bytes of a message beside its content: topic and properties


def write_broker_files(
    path: str | Path, folder: str | Path, *, webhook: str | None = None
) -> list[Path]:
    """Write the files of a live site's broker; passwords that are there stay.

    Parameters
    ----------
    path : str or Path
        The site's file, with a table `[live]`.
    folder : str or Path
        Folder of the files, which are written whole or not at all.
    webhook : str, optional
        Address to which the unit of fusion has it post alerts.

    Raises
    ------
    UsageError
        If the webhook is neither https nor http on this machine.
    InputError
        If the site's file does not fit.
    OutputError
        If they cannot be written.
    """
    site, place = read_live_site(path), Path(folder)
    options = ("--webhook", webhook_address(webhook)) if webhook is not None else ()
    users = [FUSION, *(each.name for each in site.sensor)]
    known = {user: _password(place / f"password_of_{user}") for user in users}
    with atomic_folder(place, owned=_OWNED) as part:
        texts = {
            _CONFIG_FILE: broker_config(site, place.resolve()),
            ACCESS: broker_access(site.live.site),
            _PASSWORDS: password_lines(known),
            **{f"password_of_{user}": f"{password}\n" for user, password in known.items()},
            **units(site, Path(path).resolve(), place.resolve(), options),
        }
        for name, text in texts.items():
            file = part / name
            file.touch(mode=0o600 if name.startswith("password_of_") else 0o640)
            file.write_text(text, encoding="utf-8")
        for each in place.glob("server.*"):
            (part / each.name).hardlink_to(each)  # its owner and mode stay
    return sorted(place.iterdir())


def _password(path: Path) -> str:
    """Return a password that was written before, which its sensor has, or a new one."""
    before = path.read_text(encoding="utf-8").strip() if path.is_file() else ""
    return before or secrets.token_urlsafe(18)


_CONFIG = """\
# Of gis_radar's live system; see docs/live.md. Nothing here must outlive the broker.
listener {port}
allow_anonymous false
# A client's id is its user name: with an id of its choice it would end the link of another.
use_username_as_clientid true
password_file {passwords}
acl_file {access}
persistence false
max_packet_size {size}
max_inflight_messages {in_flight}
max_queued_messages {queued}
max_queued_bytes {queued_bytes}
max_keepalive 60
# Else a message waits up to 40 ms for the acknowledgement of the one before it (Nagle's algorithm).
set_tcp_nodelay true
connection_messages true
log_dest stderr
"""
_TLS = """\
certfile {folder}/server.crt
keyfile {folder}/server.key
tls_version tlsv1.2
"""


def broker_config(site: LiveSite, folder: Path) -> str:
    """Return Mosquitto's configuration: log-in required, messages and queues bounded."""
    address = BrokerAddress.of(site.live.broker.address)
    # Twice the messages that all sensors together may have sent unacknowledged.
    queued = 2 * UNACKNOWLEDGED * len(site.sensor)
    return _CONFIG.format(
        port=address.port, passwords=folder / _PASSWORDS, access=folder / ACCESS,
        size=MOST_BYTES + _HEADER_BYTES, in_flight=IN_FLIGHT, queued=queued,
        queued_bytes=queued * 2048,
    ) + (_TLS.format(folder=folder) if address.tls else "")  # fmt: skip


def broker_access(site: str) -> str:
    """Return the access list: a sensor publishes its own topics, fusion reads those of all."""
    root, kinds = f"{TOPICS}/{site}", ("detections", "status", "pose")
    lines = [
        f"user {FUSION}", *(f"topic read {root}/+/{kind}" for kind in kinds),
        *(f"topic write {root}/{each}" for each in ("+/ack", "+/health", f"{FUSION}/#")), "",
        *(f"pattern write {root}/%u/{kind}" for kind in kinds), f"pattern read {root}/%u/ack",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def password_lines(known: Mapping[str, str]) -> str:
    """Return Mosquitto's file of passwords, hashed by PBKDF2 with SHA-512 as mosquitto_passwd."""
    lines = []
    for user, password in known.items():
        salt = secrets.token_bytes(_SALT_BYTES)
        digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, _ROUNDS)
        texts = (base64.b64encode(each).decode() for each in (salt, digest))
        lines.append(f"{user}:$7${_ROUNDS}${'$'.join(texts)}\n")
    return "".join(lines)


_UNIT = """\
[Unit]
Description={about}
After=network-online.target time-sync.target
Wants=network-online.target
StartLimitIntervalSec=0

[Service]
ExecStart={words}
User={user}
WorkingDirectory={folder}
{more}Restart=always
RestartSec=5
TimeoutStopSec={stop_s}
KillMode=mixed
ProtectSystem=strict
ReadWritePaths="{folder}"
ProtectHome=read-only
PrivateTmp=true
PrivateDevices=true
NoNewPrivileges=true

[Install]
WantedBy=multi-user.target
"""
# Folder of compiled code: homes are read only, and an account may have none.
_CACHE = "CacheDirectory=gis_radar\nEnvironment=NUMBA_CACHE_DIR=%C/gis_radar\n"
# Paths on a sensor's own computer, as in docs/live.md.
_SENSOR_FOLDER, _PROGRAM = "/var/lib/gis_radar", "/usr/local/lib/gis_radar/bin/gis-radar"
_USER = "gis_radar"
_STOP_S = 300  # time to stop: fusion follows the last minutes of vehicles and writes the hour


def units(site: LiveSite, file: Path, folder: Path, options: Sequence[str] = ()) -> dict[str, str]:
    """Return systemd's units by name: broker and fusion on this machine, and a sensor's on its own.

    Parameters
    ----------
    site : LiveSite
        Of the site's file.
    file, folder : Path
        The site's file, and where the files of the broker are.
    options : sequence of str
        Options of fusion.
    """
    broker = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    program = shutil.which("gis-radar", path=Path(sys.executable).parent) or _PROGRAM
    user = getpass.getuser()
    here = {
        "user": _USER if user == "root" else user,
        "folder": str(file.parent).replace("%", "%%"),
    }
    at_sensor = {"user": _USER, "folder": _SENSOR_FOLDER}
    name = site.live.site
    services = {
        "broker": (f"Broker of {name}", (broker, "-c", str(folder / _CONFIG_FILE)), here),
        "live": (f"Live map of {name}", (program, "live", file.name, *options), here),
        # The instance is the sensor: gis-radar-edge@R1 runs R1.toml.
        "edge@": (f"Radar %i of {name}", (_PROGRAM, "edge", "%i.toml"), at_sensor),
    }
    return {
        f"gis-radar-{key}.service": _UNIT.format(
            about=about,
            words=_command(words, instance=key == "edge@"),
            stop_s=_STOP_S,
            more="" if key == "broker" else _CACHE,
            **where,
        )
        for key, (about, words, where) in services.items()
    }


def _command(words: Sequence[str], *, instance: bool) -> str:
    """Quote a command for systemd, so that no variables or specifiers in it are expanded."""
    if instance:
        return " ".join(words)
    quoted = (each.replace("\\", "\\\\").replace('"', '\\"') for each in words)
    return " ".join(f'"{each}"' for each in quoted).replace("%", "%%").replace("$", "$$")
