"""Databases of the live system that a loss of power, a bad disk or an edit has damaged."""

import sqlite3
from contextlib import closing

import pytest
from live_site import SAMPLE

import gis_radar as gr
from gis_radar.errors import InputError
from gis_radar.live.buffer import DiskBuffer
from gis_radar.live.journal import FrameRow, Journal, PoseRow
from gis_radar.live.payload import HITS, PoseContent

PRINT = "00112233445566778899aabbccddeeff"


@pytest.mark.parametrize("damage", ["zeros", "rows", "note"])
def test_a_damaged_buffer_is_put_aside_and_the_sensor_goes_on(tmp_path, damage):
    path = tmp_path / "b"
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        stream = buffer.stream
        for k in range(300):
            buffer.append(HITS, bytes([k % 256]) * 50)
    if damage == "zeros":  # as a loss of power leaves them
        path.write_bytes(path.read_bytes()[:8192] + bytes(8192))
    else:
        rows, note = "UPDATE messages SET kind = 77", "UPDATE notes SET value = 'x y'"
        with closing(sqlite3.connect(path)) as database, database:
            database.execute(rows if damage == "rows" else note)
    before = path.read_bytes()
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        assert (len(buffer), buffer.why) == (0, "it is damaged")
        assert buffer.stream != stream
        assert buffer.append(HITS, b"new") == 1
        assert buffer.put_aside.read_bytes() == before
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        assert (len(buffer), buffer.put_aside) == (1, None)


def test_a_file_that_is_no_buffer_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("my notes, and more of them")
    with closing(sqlite3.connect(tmp_path / "own.gpkg")) as database, database:
        database.execute("CREATE TABLE mine (a)")
    for path in tmp_path.iterdir():
        before = path.read_bytes()
        with pytest.raises(InputError, match="is no disk buffer"):
            DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT)
        assert path.read_bytes() == before
    with pytest.raises(InputError, match="is no journal"):
        Journal(tmp_path / "own.gpkg", fingerprint=PRINT)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        ("DELETE FROM poses", "1 rows of frames cannot be"),
        ("UPDATE poses SET content = 5", "1 rows of poses cannot be"),
        ("ALTER TABLE marks RENAME COLUMN stream TO other", "the columns of marks"),
        ("UPDATE frames SET time_us = 9000000000000000000", "no known year"),
    ],
)
def test_a_damaged_journal_is_named_and_kept(tmp_path, damage, says):
    """It alone holds frames that were acknowledged: nothing is put aside in silence."""
    path = tmp_path / "j"
    with Journal(path, fingerprint=PRINT) as journal:
        journal.add_pose(PoseRow(1, "R1", "ab", 1, b"{}", 1, "v"))
        journal.add([FrameRow("R1", 10**15, 1, 2, 1, 0, 5, b"\0")], "R1", "ab", 2)
        journal.commit()
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(damage)
    with pytest.raises(InputError, match=says) as caught:
        Journal(path, fingerprint=PRINT)
    assert str(path) in caught.value.message
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"damaged: it cannot be read|do not fit together"):
        Journal(path, fingerprint=PRINT)


@pytest.mark.parametrize("validity_s", [0.0, -1.0, float("nan"), float("inf"), 1e6])
def test_a_pose_with_an_impossible_hold_is_refused(validity_s):
    """Frames would cover no time, or years of it, in what is written."""
    pose = gr.read_pose(SAMPLE / "R1.json").as_dict()
    content = PoseContent(pose=pose, since_step=0, fingerprint=PRINT, validity_s=validity_s)
    with pytest.raises(InputError, match="validity_s is"):
        PoseContent.unpack(content.pack())
