"""PCD files: their three kinds, the time in their names, LZF."""

import struct

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import Listener
from radars import START, times

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.recordings import DamagedError
from gis_radar.recordings.readers.pcd import decompress, read_pcd, time_in_name

FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("doppler", "f8"), ("rcs", "i1"), ("snr", "u2")]
DATA = ("ascii", "binary", "binary_compressed")


def rows_of(number=0, count=5):
    rows = np.zeros(count, dtype=FIELDS)
    rows["x"], rows["y"] = np.arange(count) + number * 100, -1.5
    rows["doppler"], rows["rcs"], rows["snr"] = 0.1, -3, np.arange(count) * 1000
    return rows


def compress(content):
    """LZF by the plainest rule: the last place with the same three bytes, else a literal."""
    packed, known, at = bytearray(), {}, 0
    while at < len(content):
        start, known[content[at : at + 3]] = known.get(content[at : at + 3]), at
        if start is None or at - start > 8191 or at + 3 > len(content):
            packed += bytes([0, content[at]])
            at += 1
            continue
        length = 3
        while (
            length < 264
            and at + length < len(content)
            and (content[start + length] == content[at + length])
        ):
            length += 1
        back = at - start - 1
        short = min(length - 2, 7)
        packed.append(short << 5 | back >> 8)
        if short == 7:
            packed.append(length - 9)
        packed.append(back & 0xFF)
        at += length
    return bytes(packed)


def write_pcd(path, rows, data="binary", *, version=True):
    names = rows.dtype.names
    kinds = [rows.dtype[name] for name in names]
    letters = {"f": "F", "i": "I", "u": "U"}
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(["VERSION 0.7"] if version else []),
        "FIELDS " + " ".join("_" if name.startswith("gap") else name for name in names),
        "SIZE " + " ".join(str(kind.base.itemsize) for kind in kinds),
        "TYPE " + " ".join(letters[kind.base.kind] for kind in kinds),
        "COUNT " + " ".join(str(int(np.prod(kind.shape))) for kind in kinds),
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        f"DATA {data}\n",
    ]
    if data == "ascii":
        lines = [" ".join(str(v) for n in names for v in np.ravel(row[n])) for row in rows]
        body = ("\n".join(lines) + "\n").encode()
    elif data == "binary":
        body = rows.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in names)
        packed = compress(plain)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes("\n".join(head).encode() + body)
    return path


@pytest.mark.parametrize("data", DATA)
def test_a_folder_becomes_a_recording(tmp_path, data):
    folder = tmp_path / "front"
    folder.mkdir()
    for number, time in enumerate(times(4)):
        write_pcd(folder / f"{time:.3f}.pcd", rows_of(number), data)
    (folder / "notes.txt").write_text("not a cloud")
    result = gr.convert(folder, tmp_path / "r.parquet")
    table = pq.read_table(tmp_path / "r.parquet").to_pandas()
    assert result.recordings[0].sensor == "front"
    np.testing.assert_allclose(table["time"].unique(), times(4))
    expected = np.concatenate([rows_of(number) for number in range(4)])
    for column, field in {
        "x": "x",
        "y": "y",
        "range_rate": "doppler",
        "rcs": "rcs",
        "snr": "snr",
    }.items():
        np.testing.assert_array_equal(table[column], expected[field].astype(np.float32), column)


@settings(max_examples=40)
@given(data=st.data())
def test_any_cloud_reads_back(tmp_path_factory, data):
    kinds = st.sampled_from(["f4", "f8", "i1", "i2", "i4", "u1", "u2", "u4"])
    names = data.draw(st.lists(st.sampled_from("abcdef"), unique=True, min_size=1))
    fields = [(name, data.draw(kinds)) for name in names]
    fields += [("gap", "u1", (data.draw(st.integers(2, 5)),))] * data.draw(st.integers(0, 1))
    rows = np.zeros(data.draw(st.integers(0, 30)), dtype=fields)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    for name in names:
        rows[name] = rng.integers(0, 3, len(rows))
    folder = tmp_path_factory.mktemp("pcd")
    for kind in DATA:
        read = read_pcd(write_pcd(folder / "r.pcd", rows, kind))
        for name in names:
            np.testing.assert_array_equal(read[name], rows[name])


@settings(max_examples=200)
@given(content=st.binary(max_size=300) | st.binary(max_size=6).map(lambda part: part * 90))
def test_lzf_reads_back(content):
    assert decompress(compress(content), len(content)) == content


@pytest.mark.parametrize("packed", [b"\x05ab", b"\x20\x05", b"\xe0", b"", b"\x00a\x00b"])
def test_lzf_that_is_none(packed):
    with pytest.raises(DamagedError):
        decompress(packed, 3)


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("1708578204.202447652.pcd", 1708578204.202447652),
        ("1708578204.2.pcd", 1708578204.2),
        ("1708578204_202447652.pcd", 1708578204.202447652),
        ("1708578204_002447652.pcd", 1708578204.002447652),
        ("1708578204_2447652.pcd", 1708578204.002447652),
        ("1708578204.pcd", 1708578204.0),
        ("1708578204202.pcd", 1708578204.202),
        ("1708578204202447.pcd", 1708578204.202447),
        ("frame-1708578204202447652-radar.pcd", 1708578204.202447652),
        ("2024-02-22T05-03-24.202Z.pcd", 1708578204.202),
        ("20240222_050324.pcd", 1708578204.0),
        ("radar_2024-02-22_05-03-24-202447.pcd", 1708578204.202447),
    ],
)
def test_times_in_names(tmp_path, name, time):
    assert time_in_name(tmp_path / name) == pytest.approx(time, abs=1e-6)


@pytest.mark.parametrize("name", ["000123.pcd", "cloud.pcd", "20241399_050324.pcd"])
def test_names_without_a_time_are_refused(tmp_path, name):
    write_pcd(tmp_path / name, rows_of())
    with pytest.raises(InputError, match=r"no time in the name|no valid date"):
        gr.convert(tmp_path, tmp_path / "r.parquet")


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-3],
        lambda content: content.replace(b"POINTS 5", b"POINTS 5000000000000"),
        lambda content: content.replace(b"SIZE 4", b"SIZE 3"),
        lambda content: content.replace(b"DATA binary", b"DATA binary_other"),
        lambda content: content[:40],
        lambda _: b"\xff" * 100_000,
        lambda _: b"",
    ],
)
def test_a_damaged_file_of_several_is_left_out(tmp_path, damage):
    write_pcd(tmp_path / f"{START:.1f}.pcd", rows_of())
    bad = write_pcd(tmp_path / f"{START + 1:.1f}.pcd", rows_of())
    bad.write_bytes(damage(bad.read_bytes()))
    notes = Listener()
    result = gr.convert(tmp_path, tmp_path / "r.parquet", reporter=notes)
    assert result.recordings[0].frames == 1
    assert result.left_out == {"damaged_frames": 1}
    assert bad.name in notes.text
    with pytest.raises(InputError, match="no PCD file that can be read"):
        gr.convert(bad, tmp_path / "other.parquet")


def test_an_empty_road_is_not_refused_for_a_damaged_file(tmp_path):
    write_pcd(tmp_path / f"{START:.1f}.pcd", rows_of(count=0))
    write_pcd(tmp_path / f"{START + 1:.1f}.pcd", rows_of()).write_bytes(b"")
    result = gr.convert(tmp_path, tmp_path / "r.parquet")
    assert result.recordings[0].empty_frames == 1


def test_a_cloud_without_positions_lists_its_fields(tmp_path):
    rows = np.zeros(2, dtype=[("a", "f4"), ("b", "f4")])
    write_pcd(tmp_path / f"{START:.1f}.pcd", rows)
    with pytest.raises(InputError, match="no positions among the fields a, b"):
        gr.convert(tmp_path, tmp_path / "r.parquet")
    gr.convert(tmp_path, tmp_path / "r.parquet", columns={"x": "a", "y": "b"})
    assert pq.read_metadata(tmp_path / "r.parquet").num_rows == 2
