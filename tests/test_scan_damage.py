"""Scans that were damaged on their way, or whose figures cannot be: refused or named."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from maps import Listener
from scans import box_roads, ground, level, write_points

import gis_radar as gr
from gis_radar.base import CrsError, InputError, NoAnswerError
from gis_radar.scans.header import read_header

ROAD = (0.0, 0.0, 60.0, 8.0)
AROUND = (-5.0, -5.0, 65.0, 13.0)
POINTS_AT = 96  # where a header says where its points begin


def mask(path, roads=None, **options):
    return gr.mask_road([path], roads or box_roads(ROAD), engine="laspy", **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "scan.laz"
    return write_points(path, ground(AROUND, level, density=30.0)).read_bytes()


def changed(whole, path, at, form, value):
    data = bytearray(whole)
    struct.pack_into(form, data, at, value)
    path.write_bytes(data)
    return path


def laszip_at(data):
    return data.index(b"laszip encoded") - 2 + 54


def table_at(data):
    (points_at,) = struct.unpack_from("<I", data, POINTS_AT)
    return struct.unpack_from("<q", data, points_at)[0]


# What is changed: where from the begin of the record or the table, as what, to what.
RECORD = {
    "method": (0, "<H", 1),
    "no points a chunk": (12, "<I", 0),
    "billions of points a chunk": (12, "<I", 0xFFFFFFF0),
    "no parts of a point": (32, "<H", 0),
    "thousands of parts": (32, "<H", 60_000),
    "part of 60,000 bytes": (36, "<H", 60_000),
    "part of a type that is none": (34, "<H", 99),
}


@pytest.mark.parametrize("what", RECORD)
def test_a_record_of_the_compression_that_cannot_be(tmp_path, whole, what):
    at, form, value = RECORD[what]
    path = changed(whole, tmp_path / "s.laz", laszip_at(whole) + at, form, value)
    with pytest.raises(InputError, match=r"s\.laz: damaged or cut off: its record"):
        mask(path)


def test_a_scan_without_its_record(tmp_path, whole):
    (tmp_path / "s.laz").write_bytes(whole.replace(b"laszip encoded", b"laszip encoder"))
    with pytest.raises(InputError, match="record of the compression is missing"):
        mask(tmp_path / "s.laz")


@pytest.mark.parametrize("count", [0xFFFFFFFF, 0x7FFFFFFF, 1_000_000, 5_000])
def test_a_table_of_chunks_that_cannot_be(tmp_path, whole, count):
    """lazrs takes the memory first, and ends the process where there is none."""
    path = changed(whole, tmp_path / "s.laz", table_at(whole) + 4, "<I", count)
    with pytest.raises(InputError, match=rf"s\.laz: .*its table claims {count} chunks"):
        mask(path)


@pytest.mark.parametrize("at", [0, 7, 10**15, -5])
def test_a_table_that_is_not_in_the_file(tmp_path, whole, at):
    (points_at,) = struct.unpack_from("<I", whole, POINTS_AT)
    path = changed(whole, tmp_path / "s.laz", points_at, "<q", at)
    with pytest.raises(InputError, match="table of chunks is at byte"):
        mask(path)


def test_a_table_of_other_chunks_is_refused(tmp_path, whole):
    data = bytearray(whole)
    for byte in range(table_at(whole) + 8, len(data)):
        data[byte] ^= 0xFF
    (tmp_path / "s.laz").write_bytes(data)
    with pytest.raises(InputError, match=r"s\.laz"):
        mask(tmp_path / "s.laz")


@pytest.mark.parametrize("points", [1, 49_999, 50_000, 50_001, 120_000])
def test_chunks_of_every_count_are_read(tmp_path, points):
    path = write_points(tmp_path / "s.laz", np.zeros((points, 3)))
    assert read_header(path).point_count == points


def layered(path, point_format, points):
    """Write points whose parts are compressed in layers, with bytes of their own."""
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams(name="own", type="3u1"))
    data = laspy.LasData(header)
    data.x = data.y = data.z = np.linspace(0.0, 100.0, points)
    data.write(path)
    return path


@pytest.mark.parametrize("point_format", [6, 7, 8, 9, 10])
@pytest.mark.parametrize("points", [1, 50_001])
def test_layers_are_read(tmp_path, point_format, points):
    path = layered(tmp_path / "s.laz", point_format, points)
    assert read_header(path).point_count == points


@pytest.mark.parametrize("layer", range(9 + 1 + 3))
def test_layers_longer_than_their_chunk(tmp_path, layer):
    """lazrs takes the memory first, and ends the process where there is none."""
    data = layered(tmp_path / "s.laz", 7, 10).read_bytes()
    heads = 8 + 30 + 6 + 3 + 4  # the table's place, a point in full, the number of points
    at = struct.unpack_from("<I", data, POINTS_AT)[0] + heads + 4 * layer
    path = changed(data, tmp_path / "s.laz", at, "<I", 0xFFF00000)
    with pytest.raises(InputError, match=r"s\.laz: .*chunk 0 claims layers longer than itself"):
        read_header(path)


def test_a_flip_never_gives_another_road(tmp_path, whole):
    """Either nothing that matters changed, or the scan is refused."""
    right = mask(Path(tmp_path / "s.laz").write_bytes(whole) and tmp_path / "s.laz")
    rng = np.random.default_rng(11)
    (points_at,) = struct.unpack_from("<I", whole, POINTS_AT)
    refusals = 0
    for place in rng.integers(points_at + 8, len(whole), 60):
        data = bytearray(whole)
        data[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "s.laz").write_bytes(data)
        try:
            found = mask(tmp_path / "s.laz")
        except (InputError, NoAnswerError):
            refusals += 1
            continue
        assert found.covered > 0.9 * right.covered, place
        assert abs(np.median(found.points[:, 2]) - 100.0) < 0.05, place
    assert refusals > 10


@pytest.mark.parametrize(("axis", "value"), [(2, 1e300), (2, 1e9), (0, -1e12), (1, np.nan)])
def test_offsets_that_cannot_be(tmp_path, whole, axis, value):
    path = changed(whole, tmp_path / "s.laz", 155 + 8 * axis, "<d", value)
    with pytest.raises(InputError, match=r"s\.laz: damaged or cut off: offsets"):
        mask(path)


@pytest.mark.parametrize(("axis", "moved"), [(0, 102.0), (1, -300.0), (2, 1e4)])
def test_points_outside_the_extent_of_the_header(tmp_path, whole, axis, moved):
    (offset,) = struct.unpack_from("<d", whole, 155 + 8 * axis)
    path = changed(whole, tmp_path / "s.laz", 155 + 8 * axis, "<d", offset + moved)
    with pytest.raises(InputError, match="outside the extent of its header along"):
        mask(path)


@pytest.mark.parametrize("engine", ["laspy", "auto"])
@pytest.mark.parametrize(("less", "said"), [(0.9, None), (5.0, "5 m"), (60.0, "60 m")])
def test_an_extent_that_is_too_small_is_no_damage(tmp_path, whole, less, said, engine):
    """Programs round it; others crop, shift and merge without writing it anew."""
    (east,) = struct.unpack_from("<d", whole, 179)
    path = changed(whole, tmp_path / "s.laz", 179, "<d", east - less)
    heard = Listener()
    found = gr.mask_road([path], box_roads(ROAD), engine=engine, reporter=heard)
    assert found.covered > 0.9
    warned = [text for level, text in heard.messages if level == "warning" and "extent" in text]
    assert warned == ([] if said is None else [
        f"{path}: points lie up to {said} outside the extent of its header, which does not count"
    ])  # fmt: skip


def test_heights_in_feet_by_their_own_crs(tmp_path):
    path = write_points(tmp_path / "s.laz", ground(AROUND, level), crs="EPSG:32618+6360")
    with pytest.raises(CrsError, match=r"s\.laz: its heights are in US survey foot"):
        mask(path)


@pytest.mark.parametrize(("scan_m", "said"), [(-900.0, "-1000.00 m"), (1640.0, "1540.00 m")])
def test_heights_far_from_the_maps_are_named(tmp_path, scan_m, said):
    """A thousand metres low, or in feet: measured and said, where it was `not known`."""
    xyz = ground(AROUND, lambda x, _: np.full(np.shape(x), scan_m))
    heard = Listener()
    found = mask(
        write_points(tmp_path / "s.laz", xyz), box_roads(ROAD, heights=[level]), reporter=heard
    )
    assert found.figures()["scan_over_map_m"] == float(said.split()[0])
    assert (
        f"the scans lie {said} over the map's heights: another vertical datum? none is so far off"
        in str(heard.messages)
    )


def test_next_to_nothing_of_the_road_is_no_mask(tmp_path):
    """A corner of the road and points far around: the extent promises all of it."""
    xyz = ground((0.0, 0.0, 8.0, 4.0), level, density=40.0)
    far = np.array([[-900.0, -300.0, 100.0], [900.0, 300.0, 100.0]])
    path = write_points(tmp_path / "s.laz", np.vstack([xyz, far]))
    roads = box_roads((-800.0, 0.0, 800.0, 8.0))
    with pytest.raises(NoAnswerError, match=r"s\.laz: only 0\.\d% of the road inside the scans"):
        mask(path, roads)


def test_a_sparse_mask_is_named(tmp_path):
    heard = Listener()
    xyz = ground((0.0, 0.0, 5.0, 8.0), level, density=40.0)
    far = np.array([[-5.0, -5.0, 100.0], [65.0, 13.0, 100.0]])
    mask(write_points(tmp_path / "s.laz", np.vstack([xyz, far])), reporter=heard)
    assert "8% of the road inside the scans has points" in str(heard.messages)


def test_a_scan_of_a_part_of_the_site_is_still_a_mask(tmp_path):
    path = write_points(tmp_path / "s.laz", ground(AROUND, level, density=30.0))
    assert mask(path, box_roads((0.0, 0.0, 6000.0, 8.0))).covered == pytest.approx(0.01, rel=0.1)
