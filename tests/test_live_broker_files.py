"""What `--broker-files` writes: Mosquitto and systemd find no fault in it."""

import errno
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from live_site import LiveSite, needs_mosquitto

from gis_radar.base import InputError
from gis_radar.live import (
    read_edge_file,
    read_live_site,
    write_broker_files,
)


@pytest.fixture
def site(tmp_path, once):
    (tmp_path / "50 % of $all").mkdir()
    return LiveSite(tmp_path / "50 % of $all", once)


def test_passwords_are_for_their_owner_alone(site):
    folder = site.folder / "broker"
    found = {path.name for path in folder.glob("password_of_*")}
    assert found == {"password_of_fusion", "password_of_R1", "password_of_R2"}
    for name in found:
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600
    assert len({(folder / name).read_text() for name in found}) == len(found)
    assert stat.S_IMODE((folder / "passwords").stat().st_mode) == 0o640  # few rounds of a hash
    texts = [path.read_text() for path in folder.iterdir() if not path.name.startswith("password_")]
    assert not [text for text in texts if site.password("R1") in text]


def test_a_sensor_that_comes_later_locks_no_other_out(site):
    before = site.password("R1")
    more = (site.folder / "SITE.toml").read_text() + '\n[[sensor]]\nname = "R3"\n'
    (site.folder / "SITE.toml").write_text(more)
    key = site.folder / "broker" / "server.key"
    key.write_text("of TLS")
    key.chmod(0o400)
    write_broker_files(site.folder / "SITE.toml", site.folder / "broker")
    assert site.password("R1") == before
    assert (key.read_text(), stat.S_IMODE(key.stat().st_mode)) == ("of TLS", 0o400)
    assert site.password("R3") not in {before, site.password("fusion")}
    lines = (site.folder / "broker" / "passwords").read_text().splitlines()
    assert [line.partition(":")[0] for line in lines] == ["fusion", "R1", "R2", "R3"]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_finds_no_fault_in_the_units(site):
    units = sorted((site.folder / "broker").glob("*.service"))
    assert [unit.name for unit in units] == [
        "gis-radar-broker.service", "gis-radar-edge@.service", "gis-radar-live.service",
    ]  # fmt: skip
    # A signal is fusion's to pass on: its process of vehicles would begin anew.
    assert all("\nKillMode=mixed\n" in unit.read_text() for unit in units)
    text = units[1].read_text()  # of another machine, where the program is elsewhere
    assert "ExecStart=/usr/local/lib/gis_radar/bin/gis-radar edge %i.toml\n" in text
    units[1].write_text(text.replace("/usr/local/lib/gis_radar/bin/gis-radar", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *units], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    said = [line for line in done.stderr.splitlines() if "gis-radar" in line]
    assert (done.returncode, said) == (0, [])


@needs_mosquitto
def test_mosquitto_says_nothing_against_its_configuration(site):
    site.broker.start()
    site.broker.kill()
    said = site.broker.config.with_suffix(".log").read_text()
    assert "Error" not in said
    assert "Warning" not in said.replace("Warning: Mosquitto should not be run as root", "")


def test_two_sensors_of_one_folder_have_a_buffer_each(site):
    paths = set()
    for name in ("R1", "R2"):
        text = site.edge(name).read_text()
        file = site.folder / f"{name}.toml"
        file.write_text(text.replace(f'[buffer]\nfile = "{name}.buffer"\n', ""))
        assert "buffer" not in file.read_text()
        paths.add(read_edge_file(file).buffer_path.name)
    assert paths == {"R1.buffer", "R2.buffer"}


def test_fusion_names_a_password_that_is_not_there(site):
    (site.folder / "broker/password_of_fusion").unlink()
    with pytest.raises(InputError, match=r"password_of_fusion: no such file") as caught:
        read_live_site(site.file).address()
    assert "broker" in caught.value.hint


def test_fusion_names_a_password_that_it_may_not_read(site, monkeypatch):
    live = read_live_site(site.file)

    def denied(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "stat", denied)  # of a folder that is closed to it
    monkeypatch.setattr(Path, "read_text", denied)
    with pytest.raises(InputError, match=r"password_of_fusion: cannot be read: .*denied"):
        live.address()
