"""Sets of tiles as bytes, against numbers written digit by digit."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gis_radar.errors import InputError
from gis_radar.live.hits_folder.tile_sets import (
    pack_sets,
    pack_tiles,
    unpack_sets,
    unpack_tiles,
)

LAST = 2**63 - 1
TILES = st.one_of(st.integers(0, 300), st.integers(0, 50_000), st.integers(0, LAST))
SETS = st.lists(st.sets(TILES, max_size=40).map(sorted), max_size=6)


def plainly(tiles):
    """Write a set with numpy's differences and Python's numbers."""
    gaps = np.diff(np.array(tiles, dtype=object), prepend=-1) - 1
    text = b""
    for gap in gaps:
        digits = [int(gap) >> (7 * k) & 127 for k in range(max(-(-int(gap).bit_length() // 7), 1))]
        text += bytes(digit | 128 for digit in digits[:-1]) + bytes(digits[-1:])
    return text


@settings(deadline=None)  # compiled at the first call
@given(SETS)
def test_sets_are_written_as_stated_and_read_back(sets):
    begins = np.cumsum([0, *map(len, sets)])
    tiles = np.array([tile for each in sets for tile in each], np.int64)
    data, at = pack_sets(tiles, begins)
    assert [data[a:b].tobytes() for a, b in pairwise(at)] == [*map(plainly, sets)]
    read, places = unpack_sets(data, at)
    assert read.tolist() == tiles.tolist()
    assert places.tolist() == begins.tolist()
    for each in sets:
        assert unpack_tiles(pack_tiles(np.array(each, np.int64))).tolist() == each


@settings(deadline=None)
@given(st.binary(max_size=24))
def test_any_bytes_are_one_set_or_refused(blob):
    try:
        tiles = unpack_tiles(blob)
    except InputError:
        return
    assert pack_tiles(tiles) == blob
    assert (np.diff(tiles, prepend=-1) > 0).all()


@pytest.mark.parametrize(
    ("blob", "reason"),
    [
        (b"\x05\x80", "ends within a number"),
        (b"\x05\x80\x00", "longer than need be"),
        (b"\xff" * 9 + b"\x00", "over 2"),
        (b"\xff" * 8 + b"\x7f\x00", "over 2"),
    ],
)
def test_damage_is_named(blob, reason):
    with pytest.raises(InputError, match=f"the packet: damaged: set 1: .*{reason}"):
        unpack_tiles(blob, what="the packet")


def test_a_tile_that_is_not_there_is_refused():
    assert unpack_tiles(pack_tiles(np.array([7])), below=8).tolist() == [7]
    with pytest.raises(InputError, match="names tile 7 of 7"):
        unpack_tiles(pack_tiles(np.array([7])), below=7)


@pytest.mark.parametrize("tiles", [[3, 3], [4, 3], [-1, 2]])
def test_what_is_no_set_is_not_written(tiles):
    with pytest.raises(InputError, match=f"tile {tiles[0] if tiles[0] < 0 else 3} is in no place"):
        pack_tiles(np.array(tiles))


def test_bytes_of_one_set_never_complete_another():
    with pytest.raises(InputError, match="set 1"):
        unpack_sets(np.array([0x80, 0x01], np.uint8), np.array([0, 1, 2]))
