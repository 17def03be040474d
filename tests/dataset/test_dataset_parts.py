"""Parts and hours: whole or not there, equal bytes, and refused when they are not what they say."""

import json
import os
import shutil
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gis_radar.base import STEPS_PER_HOUR, InputError
from gis_radar.dataset import (
    HourWriter,
    Origin,
    part_path,
    read_hour,
    read_hours,
    record_path,
)
from gis_radar.dataset.files.parts import ROWS_IN_GROUP, PartDigest, PartWriter
from gis_radar.dataset.files.tables import (
    HITS,
    HOUR_TABLES,
    OBSERVED,
    OCCUPIED,
    TABLES,
    TRACKS,
    VEHICLES,
)

HOUR = 472_222
BEGIN = HOUR * STEPS_PER_HOUR
ORIGIN = Origin(fingerprint="f00d", method=1, inputs="abc")
HIT_ROWS = {"tile_id": [0, 0, 3], "step": [BEGIN, BEGIN + 7, BEGIN + STEPS_PER_HOUR - 1]}


def write_hour(folder, hour=HOUR, origin=ORIGIN, **tables):
    with HourWriter(folder=folder, hour=hour, origin=origin) as writer:
        for table in HOUR_TABLES:
            writer.write(table, tables.get(table.name, table.empty()))
    return read_hour(folder, hour)


def files(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_an_hour_is_read_as_written(tmp_path):
    record = write_hour(tmp_path, hits=HIT_ROWS)
    with record.opened(tmp_path, HITS) as file:
        assert file.read().to_pydict() == HIT_ROWS
    assert record.parts["hits"].rows == 3
    assert part_path(tmp_path, HITS, HOUR).relative_to(tmp_path).as_posix() == (
        "hits/date=2023-11-14/22.parquet"
    )
    assert list(read_hours(tmp_path)) == [HOUR]


@pytest.mark.parametrize("table", HOUR_TABLES, ids=lambda table: table.name)
def test_an_empty_part_has_all_columns(tmp_path, table):
    record = write_hour(tmp_path)
    with record.opened(tmp_path, table) as file:
        assert file.read().schema.names == table.names
    assert pd.read_parquet(part_path(tmp_path, table, HOUR)).empty


@given(st.lists(st.integers(0, 400), max_size=5))
@settings(max_examples=25)
def test_bytes_do_not_depend_on_batches(tmp_path_factory, cuts):
    folder = tmp_path_factory.mktemp("parts")
    tile, step = np.divmod(np.arange(400), 20)
    written = []
    for edges in ([0, 400], [0, *sorted(cuts), 400]):
        path = folder / f"{len(written)}"
        writer = PartWriter(HITS, path, {})
        for low, high in pairwise(edges):
            writer.add({"tile_id": tile[low:high], "step": step[low:high]})
        writer.close()
        written.append(path.read_bytes())
    assert written[0] == written[1]


def test_row_groups_are_full(tmp_path):
    rows = ROWS_IN_GROUP + 5
    writer = PartWriter(HITS, tmp_path / "hits", {})
    for part in np.array_split(np.arange(rows), 3):
        writer.add({"tile_id": part, "step": part})
    assert writer.close().rows == rows
    found = pq.read_metadata(tmp_path / "hits")
    assert [found.row_group(i).num_rows for i in range(2)] == [ROWS_IN_GROUP, 5]


@pytest.mark.parametrize(
    ("table", "rows", "message"),
    [
        (HITS, {"tile_id": [1]}, "hits: lacks the column step"),
        (HITS, {"tile_id": [1, 0], "step": [5, 6]}, "hits: rows do not ascend by tile_id, step"),
        (HITS, {"tile_id": [1, 1], "step": [5, 5]}, "hits: rows do not ascend by tile_id, step"),
        (HITS, {"tile_id": ["x"], "step": [5]}, "hits: tile_id holds something else than int64"),
        (HITS, {"tile_id": [1.5], "step": [5]}, "hits: tile_id holds something else than int64"),
        (HITS, {"tile_id": [1], "step": [None]}, "hits: step is empty in row 0"),
        (HITS, {"tile_id": [1], "step": [1, 2]}, "hits: columns differ in length"),
        (
            OBSERVED,
            {"tile_id": [1, 1], "first_step": [5, 7], "last_step": [7, 9]},
            "observed: runs of a tile overlap, or end before they begin",
        ),
        (
            OCCUPIED,
            {"tile_id": [1], "first_step": [5], "last_step": [4], "seen": [True]},
            "occupied: runs of a tile overlap, or end before they begin",
        ),
    ],
)
def test_rows_that_are_not_the_table_are_refused(table, rows, message):
    with pytest.raises(InputError) as refused:
        table.to_arrow(rows)
    assert refused.value.message == message


def test_batches_follow_each_other(tmp_path):
    writer = PartWriter(HITS, tmp_path / "hits", {})
    writer.add({"tile_id": [2], "step": [1]})
    with pytest.raises(InputError, match="rows do not ascend"):
        writer.add({"tile_id": [1], "step": [2]})


def test_large_lanelet_ids_and_missing_ones_are_kept(tmp_path):
    big = 9_007_199_254_740_993
    rows = {name: [0, 0] for name in TRACKS.names} | {
        "vehicle": [1, 1], "step": [BEGIN, BEGIN + 4], "seen": [True, False],
        "lanelet_id": np.ma.MaskedArray([big, 0], [False, True]),
    }  # fmt: skip
    record = write_hour(tmp_path, tracks=rows)
    with record.opened(tmp_path, TRACKS) as file:
        assert file.read(["lanelet_id"])["lanelet_id"].to_pylist() == [big, None]


def test_lists_are_kept(tmp_path):
    rows = {name: [1.5] for name in VEHICLES.names} | {
        "vehicle": [HOUR * 1_000_000], "first_step": [BEGIN], "last_step": [BEGIN],
        "lanelets": [np.array([7, 9])],
    }  # fmt: skip
    record = write_hour(tmp_path, vehicles=rows)
    with record.opened(tmp_path, VEHICLES) as file:
        assert file.read(["lanelets"])["lanelets"].to_pylist() == [[7, 9]]


def test_the_same_rows_give_the_same_bytes(tmp_path):
    write_hour(tmp_path / "one", hits=HIT_ROWS)
    write_hour(tmp_path / "two", hits=pd.DataFrame(HIT_ROWS))
    write_hour(tmp_path / "two", hits=pa.table(HIT_ROWS))
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_a_failed_making_leaves_the_earlier_one(tmp_path):
    write_hour(tmp_path, hits=HIT_ROWS)
    before = files(tmp_path)
    with (
        pytest.raises(InputError),
        HourWriter(folder=tmp_path, hour=HOUR, origin=ORIGIN) as writer,
    ):
        writer.write(HITS, {"tile_id": [9], "step": [BEGIN]})
        writer.write(OBSERVED, {})
    assert files(tmp_path) == before


def test_a_making_that_ends_between_two_parts_is_no_hour(tmp_path, monkeypatch):
    write_hour(tmp_path, hits=HIT_ROWS)
    moves, move = [], Path.replace

    def stop_at_third(fresh, path):
        moves.append(path)
        if len(moves) == 3:
            raise KeyboardInterrupt
        move(fresh, path)

    other = replace(ORIGIN, inputs="other")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "replace", stop_at_third)
        write_hour(tmp_path, origin=other)
    assert read_hours(tmp_path) == {}
    assert not list(tmp_path.rglob(".*"))
    write_hour(tmp_path, origin=other)
    write_hour(tmp_path / "fresh", origin=other)
    again = files(tmp_path / "fresh")
    shutil.rmtree(tmp_path / "fresh")
    assert files(tmp_path) == again


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="names of open files")
def test_a_part_and_its_name_are_on_disk_before_the_record_says_so(tmp_path, monkeypatch):
    """As after a power failure: what was not brought to disk may be missing, in any order."""
    done, contents, sync, move = [], {}, os.fsync, Path.replace

    def note(handle):
        done.append(Path(f"/proc/self/fd/{handle}").resolve())
        sync(handle)

    def renamed(fresh, path):
        contents[fresh] = f"content of {path.name}"
        done.append(path)
        return move(fresh, path)

    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(Path, "replace", renamed)
    record = record_path(tmp_path, HOUR)
    paths = [*(part_path(tmp_path, table, HOUR) for table in HOUR_TABLES), record]
    in_order = [each for path in paths for each in (f"content of {path.name}", path, path.parent)]
    write_hour(tmp_path, hits=HIT_ROWS)
    assert [contents.get(each, each) for each in done] == in_order
    done.clear()
    write_hour(tmp_path, hits=HIT_ROWS)
    assert [contents.get(each, each) for each in done] == [
        record.parent,
        *in_order,
    ]  # that the earlier record is gone


def test_tables_that_are_no_longer_made_go(tmp_path):
    write_hour(tmp_path)
    with HourWriter(folder=tmp_path, hour=HOUR, origin=ORIGIN) as writer:
        writer.write(HITS, HIT_ROWS)
    record = read_hour(tmp_path, HOUR)
    assert [p.parent.parent.name for p in tmp_path.rglob("*.parquet")] == ["hits"]
    with pytest.raises(InputError, match=r"the hour 2023-11-14T22:00Z has no tracks"):
        record.opened(tmp_path, TRACKS).__enter__()


def cut_short(folder, path):
    path.write_bytes(path.read_bytes()[:-40])


def flip_footer(folder, path):
    whole = bytearray(path.read_bytes())
    whole[-6] ^= 0xFF
    path.write_bytes(whole)


def other_hour(folder, path):
    write_hour(folder, hour=HOUR + 1)
    same_size(folder, part_path(folder, HITS, HOUR + 1), path)


def other_table(folder, path):
    same_size(folder, part_path(folder, OBSERVED, HOUR), path)


def older_making(folder, path):
    write_hour(folder / "old", origin=replace(ORIGIN, inputs="cba"))
    same_size(folder, part_path(folder / "old", HITS, HOUR), path)


def other_tiles(folder, path):
    write_hour(folder / "other", origin=replace(ORIGIN, fingerprint="beef"))
    same_size(folder, part_path(folder / "other", HITS, HOUR), path)


def other_steps(folder, path):
    write_part_of(folder, path, {"tile_id": [1], "step": [BEGIN - 1]}, HITS)


def other_columns(folder, path):
    write_part_of(folder, path, OBSERVED.empty(), OBSERVED)


def same_size(folder, source, path):
    """Put a part in the place of another, of whose size the record knows nothing now."""
    shutil.copy(source, path)
    amend(folder, path)


def write_part_of(folder, path, rows, table):
    writer = PartWriter(table, path, ORIGIN.metadata(HITS, HOUR))
    writer.add(rows)
    writer.close()
    amend(folder, path)


def amend(folder, path):
    from gis_radar.dataset import write_record

    record = read_hour(folder, HOUR)
    known = record.parts["hits"]
    digest = PartDigest(rows=known.rows, size=path.stat().st_size, sha256=known.sha256)
    write_record(folder, replace(record, parts={**record.parts, "hits": digest}))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda _, path: path.unlink(), "is missing"),
        (cut_short, "has .* bytes, not"),
        (flip_footer, "damaged: "),
        (other_hour, "is of hour '2023-11-14T23:00Z', not '2023-11-14T22:00Z'"),
        (other_table, "is of table 'observed', not 'hits'"),
        (older_making, "is of inputs 'cba', not 'abc'"),
        (other_tiles, "is of fingerprint 'beef', not 'f00d'"),
        (other_steps, "step lies outside its hour"),
        (other_columns, "lacks the column step"),
    ],
)
def test_parts_that_are_not_their_hours_are_refused(tmp_path, damage, message):
    write_hour(tmp_path, hits=HIT_ROWS)
    path = part_path(tmp_path, HITS, HOUR)
    damage(tmp_path, path)
    record = read_hour(tmp_path, HOUR)
    with pytest.raises(InputError, match=message) as refused:
        record.opened(tmp_path, HITS).__enter__()
    assert refused.value.message.startswith(str(path))
    assert "measure again" in refused.value.hint


def test_a_flipped_bit_that_unpacks_to_another_number_is_found_when_it_is_read(tmp_path):
    rng = np.random.default_rng(1)
    steps = BEGIN + np.sort(rng.choice(STEPS_PER_HOUR, 2000, replace=False))
    record = write_hour(tmp_path, hits={"tile_id": np.zeros(2000, np.int64), "step": steps})
    path = part_path(tmp_path, HITS, HOUR)
    column, whole = pq.read_metadata(path).row_group(0).column(1), path.read_bytes()
    end = column.data_page_offset + column.total_compressed_size
    for place in range(end - 1, column.data_page_offset, -1):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with suppress(OSError):  # it does not unpack
            if (pq.read_table(path)["step"].to_numpy() != steps).any():
                break
    with (
        pytest.raises(InputError, match=r"damaged: .*checksum"),
        record.opened(tmp_path, HITS) as file,
    ):
        file.read()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not the record of an hour: not JSON"),
        ("[]", "damaged"),
        ('{"schema": 1}', "damaged"),
        ('{"schema": 2}', "has schema 2, newer than 1"),
    ],
)
def test_records_that_are_none_are_refused(tmp_path, text, message):
    write_hour(tmp_path)
    path = record_path(tmp_path, HOUR)
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        read_hours(tmp_path)
    assert refused.value.message.startswith(str(path))


@pytest.mark.parametrize(
    ("name", "value"),
    [("fingerprint", []), ("inputs", []), ("inputs", 7), ("method", []), ("method", "3")],
)
def test_a_record_whose_origin_is_of_other_types_is_damaged(tmp_path, name, value):
    write_hour(tmp_path)
    path = record_path(tmp_path, HOUR)
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))
    with pytest.raises(InputError, match=f"damaged.*{name}"):
        read_hours(tmp_path)


def test_the_record_of_another_hour_is_refused(tmp_path):
    write_hour(tmp_path)
    path = record_path(tmp_path, HOUR)
    path.rename(path.with_name("05.json"))
    with pytest.raises(InputError, match=r"05\.json: is the record of 2023-11-14T22:00Z"):
        read_hours(tmp_path)


def test_every_column_says_what_it_means():
    for table in TABLES.values():
        assert table.means
        assert all(column.means for column in table.columns), table.name
        assert set(table.order) <= set(table.names)
