"""The broker with TLS: certificates of an authority of our own, and those that are none."""

import shutil
import subprocess

import pytest
from live_programs import Lines, assert_all_recorded
from live_site import Background, LiveSite, needs_mosquitto, wait_for

from gis_radar.base import InputError
from gis_radar.live import BrokerAddress, Edge, Fusion, Link, read_edge_file, read_live_site

pytestmark = [
    needs_mosquitto,
    pytest.mark.usefixtures("measured_in_a_thread"),
    # paho leaves the socket of a handshake that failed to the garbage collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed"),
]


def openssl(folder, words):
    subprocess.run(["openssl", *words.split()], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="session")
def authority(once):
    """Give a folder with an authority and certificates as docs/live.md makes them, smaller keys."""

    def make(folder):
        key = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
        for name in ("ca", "other"):
            openssl(folder, f"req -x509 {key} -days 3650 -subj /CN={name} "
                            f"-keyout {name}.key -out {name}.crt")  # fmt: skip
        for name, host, days, signer in (
            ("good", "localhost", 825, "ca"),
            ("foreign", "localhost", 825, "other"),
            ("elsewhere", "broker.example", 825, "ca"),
            ("expired", "localhost", -1, "ca"),
        ):
            openssl(folder, f"req {key} -subj /CN={host} -keyout {name}.key -out {name}.csr")
            (folder / "names").write_text(f"subjectAltName=DNS:{host}")
            of_authority = f"-CA {signer}.crt -CAkey {signer}.key -CAcreateserial"
            openssl(folder, f"x509 -req -in {name}.csr {of_authority} -days {days} "
                            f"-extfile names -out {name}.crt")  # fmt: skip
        return folder

    return once("live_authority", make)


def secure_site(folder, once, authority, name, **given):
    site = LiveSite(folder, once, names=("R1",), scheme="mqtts", host="localhost",
                    authority=authority / "ca.crt", **given)  # fmt: skip
    for end in ("crt", "key"):
        shutil.copy(authority / f"{name}.{end}", site.folder / "broker" / f"server.{end}")
    site.broker.start()
    return site


def test_fusion_and_a_sensor_speak_through_tls(tmp_path, once, authority):
    site = secure_site(tmp_path, once, authority, "good")
    try:
        middle = Background(Fusion(read_live_site(site.file)).run)
        edge = Edge(read_edge_file(site.edge("R1")))
        work = Background(edge.run)
        work.join()
        work.end()
        middle.end()
        plain, said = BrokerAddress.of(f"mqtt://localhost:{site.port}"), Lines()
        link = Link(plain, name="plain", reporter=said)
        link.open()
        wait_for(lambda: said.lines)  # nothing gets through without TLS
        assert not link.connected
        link.close()
        assert len(said.lines) == 1
        assert "does it speak mqtts://?" in said.lines[0]
    finally:
        site.broker.kill()
    assert_all_recorded(site, ["R1"])


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("foreign", "unable to get local issuer certificate"),
        ("elsewhere", "Hostname mismatch, certificate is not valid for 'localhost'"),
        ("expired", "certificate has expired"),
    ],
)
def test_a_certificate_that_is_not_trusted_is_named_in_one_line(
    tmp_path, once, authority, name, why
):
    site = secure_site(tmp_path, once, authority, name)
    said = Lines()
    link = Link(read_edge_file(site.edge("R1")).address(), name="junction-R1", reporter=said)
    try:
        link.open()
        wait_for(lambda: said.lines)
        address = f"mqtts://localhost:{site.port}"
        told = f"the certificate of the broker at {address} is refused: {why}"
        assert len(said.lines) == 1
        assert said.lines[0].startswith(f"junction-R1: {told}")
        assert said.lines[0].endswith("; trying on")
        assert not link.connected
    finally:
        link.close()
        site.broker.kill()


def test_a_broker_without_tls_where_tls_is_expected_is_one_line(tmp_path, once, authority):
    site = LiveSite(tmp_path, once, names=("R1",))
    site.broker.start()
    said = Lines()
    address = BrokerAddress.of(f"mqtts://127.0.0.1:{site.port}", authority=authority / "ca.crt")
    link = Link(address, name="junction-R1", reporter=said)
    try:
        link.open()
        wait_for(lambda: said.lines)
        assert len(said.lines) == 1
    finally:
        link.close()
        site.broker.kill()


def test_an_authority_that_is_none_is_refused(tmp_path):
    (tmp_path / "ca.crt").write_text("no certificate")
    address = BrokerAddress.of("mqtts://localhost", authority=tmp_path / "ca.crt")
    with pytest.raises(InputError, match="no certificate of an authority"):
        Link(address, name="one")
