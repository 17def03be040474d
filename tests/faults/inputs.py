"""Small inputs of every kind, and the command that reads each: a line a kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from maps import EAST, NORTH, write_road
from radars import START, frames_of, times, write_pcap, write_pcapng
from scans import ground, write_points
from test_formats_bags import ars548_rows, clouds, write_bag
from test_formats_pcd import rows_of, write_pcd

import gis_radar as gr

UTM = "EPSG:25832"
DAY, HOUR = "2023-11-14", "2023-11-14/22"  # of the recordings
AROUND = (-5.0, -5.0, 25.0, 8.0)


@dataclass(frozen=True, kw_only=True)
class Kind:
    """An input file and the command that reads it; `{}` in the words is its place."""

    path: str
    words: str

    @property
    def name(self) -> str:
        return f"{self.words.split()[0]} {self.path}"


def part_of(table: str) -> str:
    """Return where the part of a table lies in the dataset of the inputs."""
    return f"dataset/{table}/date={DAY}/{HOUR[-2:]}.parquet"


MASK = "mask scan.laz --engine laspy --map {} -o out.laz"
MEASURE = "measure R1.parquet --pose R1.json --tiles tiles.gpkg --map map.osm -o out"
HEATMAP = "heatmap dataset -o out"
KINDS = [
    Kind(path="map.osm", words="tiles {} -o out.gpkg"),
    Kind(path="streets.gpkg", words="tiles map.osm --streets {} -o out.gpkg"),
    Kind(path="map.osm", words=MASK),
    *(Kind(path=f"roads.{each}", words=MASK) for each in ("gpkg", "geojson", "shp", "fgb")),
    Kind(path="roads.csv", words=MASK + " --map-crs EPSG:4326"),
    Kind(path="scan.laz", words="mask {} --engine laspy --map roads.gpkg -o out.laz"),
    Kind(path="scan.las", words="mask {} --engine laspy --map roads.gpkg -o out.laz"),
    Kind(path="road.laz", words="tiles map.osm --road {} -o out.gpkg"),
    Kind(path="R1.parquet", words=MEASURE.replace("R1.parquet", "{}")),
    Kind(path="R1.csv", words=MEASURE.replace("R1.parquet", "{}")),
    Kind(path="R1.parquet", words="project {} --pose R1.json -o out.gpkg"),
    Kind(path="R1.csv", words="project {} --pose R1.json -o out.laz"),
    Kind(path="R1.json", words=MEASURE.replace("R1.json", "{}")),
    Kind(path="R1.json", words="sensors {} -o out.gpkg"),
    Kind(path="track.csv", words="project R1.parquet --pose {} -o out.parquet"),
    Kind(path="track.csv", words=MEASURE.replace("R1.json", "{}")),
    Kind(path="tiles.gpkg", words=MEASURE.replace("tiles.gpkg", "{}")),
    Kind(path="map.osm", words=MEASURE.replace("map.osm", "{}")),
    *(Kind(path=f"dataset/{each}", words=HEATMAP)
      for each in ("dataset.json", f"hours/{HOUR}.json", "tiles.gpkg", "recordings.parquet")),
    *(Kind(path=part_of(each), words=HEATMAP) for each in ("frames", "visible")),
    Kind(path=f"dataset/tile_counts/date={DAY}/day.parquet", words=HEATMAP),
    Kind(path="dataset/poses.parquet", words="quality dataset -o out.csv"),
    Kind(path=part_of("frames"), words="quality dataset -o out.csv"),
    Kind(path=part_of("tracks"), words="footprints dataset -o out.gpkg"),
    Kind(path=part_of("vehicles"), words="traffic dataset --interval 1min -o out"),
    Kind(path="heatmap/heatmap.gpkg", words="report heatmap --dataset dataset -o out"),
    Kind(path="heatmap/heatmap.gpkg", words="qgis heatmap -o out.qgz"),
    Kind(path="SITE.toml", words="check {}"),
    *(Kind(path=each, words="convert {} -o out.parquet")
      for each in ("capture.pcap", "capture.pcapng", "cloud.bag", "table.csv")),
    Kind(path="clouds/1700000000.000000.pcd", words="convert clouds -o out.parquet"),
    Kind(path="bag/metadata.yaml", words="convert bag -o out.parquet"),
    Kind(path="bag/bag.db3", words="convert bag -o out.parquet"),
    Kind(path="mcap/mcap.mcap", words="convert mcap -o out.parquet"),
]  # fmt: skip

SITE = f"""title = "Site"
timezone = "Europe/Berlin"
[map]
file = "map.osm"
crs = "{UTM}"
[[sensor]]
name = "R1"
recordings = ["R1.parquet"]
pose = "R1.json"
view = {{ max_range_m = 60.0 }}
"""


def build(folder: Path) -> None:
    """Write all inputs into a folder."""
    roads = shapely.box(EAST, NORTH, EAST + 20.0, NORTH + 3.0)
    layer = gpd.GeoDataFrame({"name": ["A"]}, geometry=[roads], crs=UTM)
    write_road(folder / "map.osm")
    for each in ("gpkg", "shp", "fgb"):
        layer.to_file(folder / f"roads.{each}")
    layer.to_crs(4326).to_file(folder / "roads.geojson")
    (folder / "roads.csv").write_text(f'name,wkt\nA,"{layer.to_crs(4326).geometry[0].wkt}"\n')
    line = shapely.LineString([(EAST, NORTH), (EAST + 20.0, NORTH)])
    gpd.GeoDataFrame({"name": ["A"]}, geometry=[line], crs=UTM).to_file(folder / "streets.gpkg")
    xyz = ground(AROUND, lambda x, _: np.full(np.shape(x), 100.0), density=20.0)
    write_points(folder / "scan.laz", xyz)
    write_points(folder / "scan.las", xyz)
    _recordings(folder)
    _radars(folder)
    (folder / "SITE.toml").write_text(SITE)
    mask = gr.mask_road([folder / "scan.laz"], folder / "roads.gpkg", engine="laspy")
    mask.write(folder / "road.laz")
    tiles = gr.make_tiles(gr.read_map(folder / "map.osm"))
    gr.write_tiles(tiles, folder / "tiles.gpkg", problems=gr.read_map(folder / "map.osm").problems)
    pose = gr.read_pose(folder / "R1.json")
    found = gr.measure(
        [folder / "R1.parquet"], [pose], tiles, folder / "map.osm", folder / "dataset"
    )
    gr.make_heatmap(found, interval="1s").write(folder / "heatmap")
    missing = [kind.path for kind in KINDS if not (folder / kind.path).is_file()]
    assert not missing, missing


def _recordings(folder: Path) -> None:
    time = np.repeat(START + 0.05 * np.arange(60), 3)
    number = np.arange(len(time), dtype=np.float32)
    names = ("x", "y", "z", "range_rate", "rcs")
    table = pd.DataFrame({"time": time, "x": 6.0 + number % 17, "y": 1.5, "z": -4.0,
                          "range_rate": 3.0, "rcs": 5.0})  # fmt: skip
    table = table.astype(dict.fromkeys(names, np.float32))
    table.to_parquet(folder / "R1.parquet")
    table.to_csv(folder / "R1.csv", index=False)
    table.rename(columns={"range_rate": "doppler"}).to_csv(folder / "table.csv", index=False)
    pose = gr.Pose(
        sensor="R1", crs=gr.read_pose(gr.sample_folder() / "R1.json").crs, easting=EAST - 5.0,
        northing=NORTH, height=105.0, yaw=0.0, pitch=0.0, roll=0.0, view=gr.View(max_range_m=60.0),
        evidence={"sigma": {"easting": 0.1, "northing": 0.1}, "event": ""},
    )  # fmt: skip
    pose.write(folder / "R1.json")
    poses = tuple(replace(pose, easting=EAST - 5.0 + k / 10) for k in range(3))
    gr.PoseTrack(poses=poses, since=START + np.arange(3.0)).write(folder / "track.csv")


def _radars(folder: Path) -> None:
    packets = list(frames_of(times(3)))
    write_pcap(folder / "capture.pcap", packets)
    micros = [(0, round(time * 1e6), packet) for time, packet in packets]
    write_pcapng(folder / "capture.pcapng", micros, [(1, 6)])
    messages = clouds(ars548_rows)
    write_bag(folder / "bag", messages)
    write_bag(folder / "mcap", messages, "mcap")
    write_bag(folder / "cloud", messages, "ros1")
    (folder / "clouds").mkdir()
    for time in times(3):
        write_pcd(folder / "clouds" / f"{time:.6f}.pcd", rows_of(), "binary_compressed")
