"""Small files that ask for much time or memory: one line, and soon; limits are lowered here."""

import gzip

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest
import rosbags.rosbag1
import rosbags.rosbag2
import shapely
from maps import EAST, NORTH, Listener, write_road
from scans import ground, write_points
from test_formats_bags import ars548_rows, clouds, write_bag
from test_formats_pcd import rows_of, write_pcd

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.recordings import open_recording, settings, unpacking
from gis_radar.recordings.readers.pcd import decompress, read_pcd
from gis_radar.scans import point_store, read_roads
from gis_radar.scans.cells import squares_with_cells


@pytest.fixture
def limited():
    """Lower limits of the readers; others are as usual."""
    with pytest.MonkeyPatch.context() as patch:

        def lower(**limits):
            patch.undo()
            for name, value in limits.items():
                patch.setattr(settings, name.upper(), value)

        yield lower


def table(rows=200, **further):
    columns = {"time": 1.7e9 + 0.05 * np.arange(rows)}
    columns |= {name: np.full(rows, 5.0, np.float32) for name in ("x", "y", "z")}
    columns |= {name: np.zeros(rows, np.float32) for name in ("range_rate", "rcs")}
    return pa.table(columns | further)


def rows(path, **options):
    return sum(len(piece) for piece in open_recording(path).read(**options))


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_tables_of_many_columns(tmp_path, limited, ending):
    path, out = tmp_path / f"r.{ending}", tmp_path / "out.parquet"
    wide = table(**{f"c{i}": np.zeros(200) for i in range(10)})
    pa_csv.write_csv(wide, path) if ending == "csv" else pq.write_table(wide, path)
    assert rows(path) == 200
    limited(most_columns=15)
    for use in (lambda: open_recording(path), lambda: gr.convert(path, out)):
        with pytest.raises(InputError, match=rf"r\.{ending}: has 16 columns, at most 15"):
            use()


@pytest.mark.parametrize("dictionary", [True, False])
def test_texts_that_fill_the_memory(tmp_path, limited, dictionary):
    """A gigabyte of one text is a kilobyte of Parquet; who needs no text does not unpack it."""
    path = tmp_path / "r.parquet"
    pq.write_table(table(note=pa.array(["x" * 5000] * 200)), path, use_dictionary=dictionary)
    assert rows(path) == 200
    for use in (lambda: rows(path, further=True), lambda: gr.convert(path, tmp_path / "o.parquet")):
        with pytest.raises(InputError, match="column note holds a text of 5,000 bytes"):
            use()
    limited(longest_text=5000, most_text_bytes=900 if dictionary else 900_000)
    with pytest.raises(InputError, match=r"column note holds .* MiB in one row group"):
        rows(path, further=True)
    limited(longest_text=5000)
    assert rows(path, further=True) == 200


def test_lists_that_fill_the_memory(tmp_path, limited):
    path = tmp_path / "r.parquet"
    pq.write_table(table(rows=2, note=pa.array([[0.0] * 50_000, []])), path)
    limited(most_text_bytes=300_000)
    with pytest.raises(InputError, match=r"column note holds .* MiB in one row group"):
        rows(path, further=True)


@pytest.mark.parametrize(
    "kind", [pa.string(), pa.large_string(), pa.binary(), pa.string_view(), pa.list_(pa.string())]
)
def test_texts_stay_as_they_are(tmp_path, kind):
    words = ["a", None, "ä", "a"] * 50
    texts = [[word] for word in words] if pa.types.is_list(kind) else words
    pq.write_table(table(note=pa.array(texts).cast(kind)), tmp_path / "r.parquet")
    (piece,) = open_recording(tmp_path / "r.parquet").read(further=True)
    assert piece.further["note"].cast(pa.array(texts).type).to_pylist() == texts


@pytest.mark.parametrize("group", [7, 30])
def test_a_frame_of_millions_is_none(tmp_path, limited, monkeypatch, group):
    """One time for all rows: the time of the file, not of its frames."""
    monkeypatch.setattr("gis_radar.recordings.parquet_table.ROWS_AT_ONCE", group)
    path, times = tmp_path / "r.parquet", np.repeat(1.7e9 + np.arange(4.0), 50)
    pq.write_table(table().set_column(0, "time", pa.array(times)), path)
    limited(most_rows_of_frame=50)
    assert rows(path) == 200
    limited(most_rows_of_frame=49)
    for use in (lambda: rows(path), lambda: gr.convert(path, tmp_path / "out.parquet")):
        with pytest.raises(InputError, match=r"r\.parquet: over 49 rows of one time"):
            use()


# Packed files.


def test_packed_clouds_are_unpacked_at_the_speed_of_bytes():
    """An LZF of 3 bytes holds 264; copies that run into themselves are the usual ones."""
    copy, size = b"\x00a" + b"\xe0\xff\x00" * 4000, 1 + 264 * 4000
    assert decompress(copy, size) == b"a" * size
    assert decompress(b"\x02abc" + b"\x20\x02" + b"\xe0\x01\x01", 4 + 2 + 10) == (
        b"abcabc" + b"bcbcbcbcbc"
    )


def test_clouds_that_claim_too_much(tmp_path, limited):
    path = tmp_path / "1700000000.0.pcd"
    write_pcd(path, rows_of(), "binary_compressed")
    count = len(read_pcd(path))
    for limit in ({"most_rows_of_frame": count - 1}, {"most_frame_bytes": 10}):
        limited(**limit)
        with pytest.raises(InputError, match="no PCD file that can be read"):
            gr.convert(path, tmp_path / "out.parquet")


def test_a_capture_that_explodes(tmp_path, limited):
    head = bytes.fromhex("d4c3b2a1020004000000000000000000ffff000001000000")
    packet = bytes(8) + (16).to_bytes(4, "little") * 2 + bytes(16)
    path = tmp_path / "c.pcap.gz"
    path.write_bytes(gzip.compress(head + packet * 100_000))
    limited(free_expansion_bytes=10_000, most_expansion=100)
    heard = Listener()
    with pytest.raises(InputError, match=r"c\.pcap\.gz"):
        gr.convert(path, tmp_path / "out.parquet", reporter=heard)
    assert "grows to over 100 times its size" in str(heard.messages)


def test_a_capture_that_ends_in_zeros(tmp_path):
    """They were packets without bytes, a million to each 16 MB."""
    head = bytes.fromhex("d4c3b2a1020004000000000000000000ffff000001000000")
    (tmp_path / "c.pcap").write_bytes(head + bytes(1 << 20))
    heard = Listener()
    with pytest.raises(InputError, match=r"c\.pcap"):
        gr.convert(tmp_path / "c.pcap", tmp_path / "out.parquet", reporter=heard)
    assert "only zeros from byte 24 on" in str(heard.messages)


PACKED = {
    "ros1-bz2": (rosbags.rosbag1.Writer, lambda w: w.set_compression(w.CompressionFormat.BZ2)),
    "ros1-lz4": (rosbags.rosbag1.Writer, lambda w: w.set_compression(w.CompressionFormat.LZ4)),
    **{
        f"{kind}-{mode}": (
            rosbags.rosbag2.Writer,
            lambda w, mode=mode: w.set_compression(
                rosbags.rosbag2.CompressionMode[mode], rosbags.rosbag2.CompressionFormat.ZSTD
            ),
        )
        for kind, mode in (("sqlite3", "FILE"), ("sqlite3", "MESSAGE"), ("mcap", "STORAGE"))
    },
}


@pytest.mark.parametrize("packed", PACKED)
def test_bags_that_explode(tmp_path, limited, monkeypatch, packed):
    kind = packed.partition("-")[0]
    writer, compress = PACKED[packed]
    begin = writer.__init__

    def packing(self, *words, **options):
        begin(self, *words, **options)
        compress(self)

    monkeypatch.setattr(writer, "__init__", packing)
    path = write_bag(tmp_path / "bag", clouds(lambda i: ars548_rows(i, count=500)), kind)
    assert gr.convert(path, tmp_path / "out.parquet").recordings[0].detections == 1500
    limited(most_chunk_bytes=1000, free_expansion_bytes=100, most_expansion=1)
    with pytest.raises(InputError, match=r"when it is unpacked|no usable frame"):
        gr.convert(path, tmp_path / "out.parquet")


def test_a_chunk_that_is_cut_off_is_damaged():
    with pytest.raises(ValueError, match="cut off"):
        unpacking.unpacked(unpacking.bz2.BZ2Decompressor, b"")


def test_a_chunk_of_several_streams_is_unpacked_whole_and_within_the_limit(limited):
    make, packed = unpacking.bz2.BZ2Decompressor, unpacking.bz2.compress(bytes(600))
    assert unpacking.unpacked(make, packed * 2) == bytes(1200)
    limited(most_chunk_bytes=1000)
    with pytest.raises(ValueError, match="when it is unpacked"):
        unpacking.unpacked(make, packed * 2)


def test_of_a_chunk_no_more_is_unpacked_than_the_limit(limited):
    asked = []

    class Unpacker:
        """One of a chunk of gigabytes."""

        def decompress(self, _packed, max_length=-1):
            asked.append(max_length)
            return bytes(max_length if max_length >= 0 else 10_000)

    limited(most_chunk_bytes=1000)
    with pytest.raises(ValueError, match="when it is unpacked"):
        unpacking.unpacked(Unpacker, b"")
    assert asked == [1001]


# Maps, sites and roads.


@pytest.mark.parametrize("where", ["<osm", "<node", "<tag"])
def test_a_tag_that_does_not_end(tmp_path, where):
    """The parser of Python 3.11 looks through it again with every kilobyte: 50 MB take hours."""
    text = write_road(tmp_path / "m.osm").read_text()
    big = text.replace(where, f'{where} a="{"x" * 3_000_000}"', 1)
    (tmp_path / "m.osm").write_text(big)
    with pytest.raises(InputError, match=r"m\.osm: line \d+: a tag of over 1 MiB"):
        gr.read_map(tmp_path / "m.osm")


def test_elements_in_elements(tmp_path):
    text = write_road(tmp_path / "m.osm").read_text()
    (tmp_path / "m.osm").write_text(text.replace("</osm>", "<a>" * 1000))
    with pytest.raises(InputError, match=r"m\.osm: line \d+: elements are nested 100 deep"):
        gr.read_map(tmp_path / "m.osm")


def test_more_tiles_than_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("gis_radar.hdmap.tiles.MOST_TILES", 100)
    roads = gr.read_map(write_road(tmp_path / "m.osm"))
    assert len(gr.make_tiles(roads)) <= 100
    with pytest.raises(InputError, match=r"over 100 tiles of 0\.05 m"):
        gr.make_tiles(roads, length_m=0.05)


def test_a_site_of_ten_thousand_sensors(tmp_path):
    one = '[[sensor]]\nname = "R{}"\nrecordings = ["a.parquet"]\npose = "p.json"\n'
    (tmp_path / "S.toml").write_text("".join(one.format(k) for k in range(10_000)))
    with pytest.raises(InputError, match=r"S\.toml: has 10,000 sensors, at most 200"):
        gr.read_site(tmp_path / "S.toml")


def test_a_site_file_of_megabytes(tmp_path):
    (tmp_path / "S.toml").write_text("# " + "x" * (5 << 20))
    with pytest.raises(InputError, match=r"S\.toml: 5 MiB is no site file"):
        gr.read_site(tmp_path / "S.toml")


def test_roads_that_fill_a_country(tmp_path, monkeypatch):
    """Kept are counts by square, not the places of all cells: 88 km2 are 352 million."""
    scan = write_points(tmp_path / "s.laz", ground((0.0, 0.0, 20.0, 20.0), lambda x, _: 0 * x))
    roads = shapely.box(EAST - 300.0, NORTH - 100.0, EAST + 300.0, NORTH + 100.0)
    layer = gpd.GeoDataFrame(geometry=[roads], crs="EPSG:25832")
    layer.to_file(tmp_path / "r.gpkg")
    mask = gr.mask_road([scan], tmp_path / "r.gpkg", engine="laspy")
    cells = mask.cells
    assert cells.missing[:, 2].sum() == cells.area_cells - len(cells.points)
    assert len(cells.missing) < 1.1 * 40 * 15
    monkeypatch.setattr(point_store, "MOST_BLOCKS", 2)
    few = read_roads(tmp_path / "r.gpkg")
    with pytest.raises(InputError, match=r"r\.gpkg: its roads fill over 2 squares of 256 m"):
        gr.mask_road([scan], few, engine="laspy")


def test_cells_are_counted_by_square():
    from gis_radar.base import Grid

    grid = Grid(cell_m=0.5, west=-4, south=-4, columns=40, rows=40)
    cells = np.random.default_rng(3).random((40, 40)) < 0.5
    corner = np.array([-7.5, 1e6])
    places = (grid.centres(np.flatnonzero(cells)) + corner) // 3.0
    want, count = np.unique(places, axis=0, return_counts=True)
    found = squares_with_cells(cells, grid, corner, 3.0)
    order = np.lexsort(found.T[1::-1])
    np.testing.assert_array_equal(found[order], np.column_stack([want * 3.0, count]))
    assert squares_with_cells(np.zeros_like(cells), grid, corner, 3.0).shape == (0, 3)
