"""Days drawn from measured parts of a minute, as in `make city`."""

from datetime import UTC, datetime, timedelta
from unittest.mock import Mock

import pytest

from gis_radar.dataset.files.registry import RecordingEntry
from simulation.drawn_days import DRAWN, DayDrawer
from tools import simulated_city as tool

DAY = datetime(2026, 10, 1, tzinfo=UTC)


@pytest.fixture
def registry():
    entry = RecordingEntry(
        path="R1.parquet", digest="d", sensor="R1", pose="R1-1", first_time=0.0, last_time=1.0,
        validity_s=0.1, rows=1, has_rates=True, has_elevation=True,
    )  # fmt: skip
    return Mock(entries=[entry])


def test_sites_of_a_drawn_city_are_no_copies_of_each_other(registry):
    digests = set()
    for fingerprint in ("tiles of one", "tiles of another"):
        dataset = Mock(**{"manifest.fingerprint": fingerprint})
        drawer = DayDrawer(dataset=dataset, parts={}, demands=[])
        entries = drawer.entries(registry, DAY, DAY + timedelta(days=1))
        digests |= {each.digest for each in entries}
    assert len(digests) == 2


def test_a_site_whose_making_was_broken_off_is_made_again(tmp_path, monkeypatch):
    """What lies in the city's root is whole: its hours measured, all of its months drawn."""
    calls = []

    def measure(site, sensors, folder):
        folder.mkdir(parents=True)
        (folder / "dataset.json").write_text("{}", encoding="utf-8")
        return Mock(**{"manifest.settings": {DRAWN: "begun"}})

    def draw(*_):
        calls.append("draw")
        if len(calls) == 1:
            raise KeyboardInterrupt

    for name, made in {"make_site": Mock(), "measured": measure, "draw": draw}.items():
        monkeypatch.setattr(tool, name, made)
    words = [str(tmp_path), "--sites", "1"]
    with pytest.raises(KeyboardInterrupt):
        tool.main(words)
    assert not list((tmp_path / "root").glob("site=*"))
    tool.main(words)
    tool.main(words)
    assert calls == ["draw", "draw"]
    (made,) = (tmp_path / "root").iterdir()
    assert made.name.startswith("site=")
