"""A sensor's buffer that a loss of power, a bad disk or an edit has damaged."""

import sqlite3
from contextlib import closing

import pytest

from gis_radar.base import InputError
from gis_radar.live import DiskBuffer

PRINT = "00112233445566778899aabbccddeeff"


@pytest.mark.parametrize("damage", ["zeros", "columns"])
def test_a_damaged_buffer_is_put_aside_and_the_sensor_goes_on(tmp_path, damage):
    path = tmp_path / "b"
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        stream = buffer.stream
        for k in range(300):
            buffer.append(bytes([k % 256]) * 50)
    if damage == "zeros":  # as a loss of power leaves them
        path.write_bytes(path.read_bytes()[:8192] + bytes(8192))
    else:
        with closing(sqlite3.connect(path)) as database, database:
            database.execute("ALTER TABLE messages RENAME COLUMN content TO other")
    before = path.read_bytes()
    with DiskBuffer(path, most_bytes=10**7, fingerprint=PRINT) as buffer:
        assert (len(buffer), buffer.why) == (0, "it is damaged")
        assert buffer.stream != stream
        assert buffer.append(b"new") == 1
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
