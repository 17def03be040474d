"""Targets of the fuzzer: every reader of a file that others made, a line a target."""

from __future__ import annotations

import json
import time
import traceback
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from faults.inputs import DAY, HOUR, UTM, build, part_of
from pyproj import CRS
from radars import detection, detection_list

import gis_radar as gr
from fuzz import edits, live
from gis_radar.dataset.files.tables import HOUR_TABLES
from gis_radar.recordings import open_recording
from gis_radar.recordings.readers.udp import LIST_METHOD, method_of, read_detections
from gis_radar.scans import open_scan, read_roads

SECONDS = 10.0  # of the processor; who reads a file of some kilobytes for longer hangs
OURS = "gis_radar"


@dataclass(frozen=True, kw_only=True)
class Target:
    """A reader, and how the bytes of a fuzzer become its file.

    Parameters
    ----------
    name : str
        Of the target.
    paths : tuple of str
        Files in the folder of inputs; of several, the first byte says which one is changed.
    read : callable
        Reads in a folder of inputs; an error of ours is an answer, any other a finding.
    edit : callable
        Writes the changed file from bytes and what was there.
    needs : str
        A package that may not be there.
    """

    name: str
    paths: tuple[str, ...]
    read: Callable[[Path], object]
    edit: edits.Edit = edits.replaced
    needs: str = ""

    def seeds(self, folder: Path) -> list[bytes]:
        """Return bytes to begin with."""
        several = len(self.paths) > 1
        sound = [(folder / path).read_bytes() for path in self.paths]
        if self.edit is not edits.replaced:
            programs = [b"", *(bytes(range(k, k + 12)) for k in range(0, 240, 24))]
            sound = [each[:1000] for each in sound] if self.name.endswith("header") else programs
        return [bytes([k] * several) + each for k, each in enumerate(sound)]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What no reader may do: where and how it was met."""

    kind: str
    place: str
    text: str

    @property
    def name(self) -> str:
        """One name for the same finding."""
        return "".join(each if each.isalnum() else "-" for each in f"{self.kind}-{self.place}")


class Bench:
    """A folder of sound inputs of which one file at a time is changed, and read."""

    def __init__(self, target: Target, folder: Path) -> None:
        self.target, self.folder = target, folder
        self.sound = {path: (folder / path).read_bytes() for path in target.paths}
        self.changed: str | None = None

    def run(self, data: bytes) -> Finding | None:
        """Read what bytes make of an input; return what went wrong, if anything."""
        self.put(data)
        return self.read()

    def read(self) -> Finding | None:
        """Read the inputs as they are; return what went wrong, if anything."""
        begin = time.process_time()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                self.target.read(self.folder)
            except gr.GisRadarError as error:
                found = _odd_message(error)
            except (KeyboardInterrupt, SystemExit):
                raise
            except BaseException as error:  # noqa: BLE001 - a panic of Rust is no Exception
                found = _finding(error)
            else:
                found = None
        seconds = time.process_time() - begin
        if found is None and caught:
            first = caught[0]
            where = f"{Path(first.filename).name}:{first.lineno}"
            found = Finding(kind=first.category.__name__, place=where, text=str(first.message))
        if found is None and seconds > SECONDS:
            found = Finding(kind="slow", place=self.target.name, text=f"{seconds:.1f} s")
        return found

    def put(self, data: bytes) -> None:
        """Write the changed file, and the one that was changed before as it was."""
        paths = self.target.paths
        self.restore()
        path = paths[data[0] % len(paths)] if len(paths) > 1 and data else paths[0]
        self.changed = path
        rest = data[1:] if len(paths) > 1 else data
        self.target.edit(rest, self.sound[path], self.folder / path)

    def restore(self) -> None:
        """Write the file that was changed as it was."""
        if self.changed is not None:
            (self.folder / self.changed).write_bytes(self.sound[self.changed])


def _odd_message(error: gr.GisRadarError) -> Finding | None:
    """Complain of a message that is no line."""
    if len(error.message.splitlines()) == 1:
        return None
    where = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(where.filename).name}:{where.lineno}"
    return Finding(kind="message", place=place, text=error.message[:2000])


def _finding(error: BaseException) -> Finding:
    steps = traceback.extract_tb(error.__traceback__)
    ours = [step for step in steps if f"/{OURS}/" in step.filename] or steps
    place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
    text = "".join(traceback.format_exception(error))
    return Finding(kind=type(error).__name__, place=place, text=text[-6000:])


def build_inputs(folder: Path) -> None:
    """Write a sound input of every kind."""
    build(folder)
    sample = (gr.sample_folder() / "junction.osm").read_bytes()
    (folder / "sample.osm").write_bytes(_few_lanelets(sample, 3))
    for count in range(3):
        payload = detection_list(1_700_000_000.0, [detection()] * count)
        (folder / f"list{count}.bin").write_bytes(payload)
    live.build(folder)


def _few_lanelets(sample: bytes, count: int) -> bytes:
    """Return the first lanelets of a map with what they use."""
    root = ET.fromstring(sample)  # noqa: S314 - our own sample
    lanelets = [each for each in root.iter("relation")
                if any(tag.get("v") == "lanelet" for tag in each.iter("tag"))][:count]  # fmt: skip
    ways = {member.get("ref") for each in lanelets for member in each.iter("member")}
    used = {node.get("ref") for way in root.iter("way") if way.get("id") in ways
            for node in way.iter("nd")}  # fmt: skip
    for each in list(root):
        keep = each in lanelets or each.get("id") in (used if each.tag == "node" else ways)
        if each.tag == "relation":
            keep = each in lanelets
        if not keep:
            root.remove(each)
    return ET.tostring(root)


def _map(name: str) -> Callable[[Path], object]:
    return lambda folder: gr.make_tiles(gr.read_map(folder / name), length_m=5.0)


def _converted(name: str) -> Callable[[Path], object]:
    def convert(folder: Path) -> None:
        made = gr.convert(folder / name, folder / "made.parquet")
        for path in made.outputs:  # what we wrote is a recording
            _rows(path)

    return convert


def _rows(path: Path) -> int:
    return sum(len(batch) for batch in open_recording(path).read())


def _pose(folder: Path) -> None:
    """Read a pose, and again as it was written."""
    pose = gr.read_pose(folder / "R1.json")
    pose.write(folder / "again.json")
    again = gr.read_pose(folder / "again.json")
    assert (again.sensor, again.crs, again.easting) == (pose.sensor, pose.crs, pose.easting)


def _track(folder: Path) -> None:
    track = gr.read_track(folder / "track.csv")
    track.write(folder / "again.csv")
    assert len(gr.read_track(folder / "again.csv").poses) == len(track.poses)


def _payload(folder: Path) -> None:
    payload = (folder / "list2.bin").read_bytes()
    if method_of(payload) == LIST_METHOD:
        frame = read_detections(payload, sensor="R1", recorder_time=0.0)
        assert frame is None or len(frame) == len(frame.rcs)


@contextmanager
def _opened(folder: Path) -> Iterator[gr.Dataset]:
    """Open the dataset while the record of its hour gives the sizes that its parts have."""
    path = folder / "dataset" / "hours" / f"{HOUR}.json"
    record = path.read_bytes()
    with suppress(ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError):
        known = json.loads(record)
        for name, part in known["parts"].items():
            part["size"] = (folder / part_of(name)).stat().st_size
        path.write_text(json.dumps(known))
    try:
        yield gr.open_dataset(folder / "dataset")
    finally:
        path.write_bytes(record)


def _dataset(folder: Path) -> None:
    """Read all that a dataset holds, whole and in part."""
    with _opened(folder) as found:
        for name in ("tiles", "recordings", "poses", "sights", "hours", "continued", "figures"):
            getattr(found, name)()
        for name in TIMED:
            read = getattr(found, name)
            read()
            read(begin=34_000_000_005, end=34_000_000_020)


def _products(folder: Path) -> None:
    with _opened(folder) as found:
        gr.make_heatmap(found, interval="1s")
        gr.measure_quality(found)


def _checked(folder: Path) -> None:
    gr.open_dataset(folder / "dataset").check()


def _scan(name: str) -> Callable[[Path], object]:
    def read(folder: Path) -> None:
        scan = open_scan(folder / name)
        list(scan.batches(scan.bounds, scan.crs))

    return read


def _site(folder: Path) -> object:
    return gr.check_site(folder / "SITE.toml")


def _maps(folder: Path) -> None:
    _map("map.osm")(folder)
    _map("sample.osm")(folder)


def _file(read: Callable[[Path], object], name: str) -> Callable[[Path], object]:
    return lambda folder: read(folder / name)


def _wkt_roads(folder: Path) -> object:
    return read_roads(folder / "roads.csv", map_crs="EPSG:4326")


def _road(path: Path) -> object:
    return gr.read_road(path, CRS.from_user_input(UTM))


TIMED = [table.name for table in HOUR_TABLES if table.name != "continued"] + ["tile_counts"]
PARTS = " ".join(part_of(table.name) for table in HOUR_TABLES)
WHOLE = " ".join(f"dataset/{each}.parquet" for each in ("poses", "recordings", "sights"))
DOCUMENTS = f"dataset/dataset.json dataset/hours/{HOUR}.json"
COUNTS = f"dataset/tile_counts/date={DAY}/day.parquet"
OF_LIVE = " ".join(f"live/{each}" for each in live.MESSAGES)
FIRST_CLOUD = "clouds/1700000000.000000.pcd"
ROWS = {
    "osm": ("map.osm sample.osm", _maps, edits.replaced),
    "osm text": ("sample.osm", _map("sample.osm"), edits.text),
    "ars548": ("list2.bin", _payload, edits.detections),
    "pcap": ("capture.pcap", _converted("capture.pcap"), edits.replaced),
    "pcapng": ("capture.pcapng", _converted("capture.pcapng"), edits.replaced),
    "pcd": (FIRST_CLOUD, _converted("clouds"), edits.replaced),
    "rosbag1": ("cloud.bag", _converted("cloud.bag"), edits.replaced),
    "rosbag2": ("bag/bag.db3", _converted("bag"), edits.database),
    "rosbag2 metadata": ("bag/metadata.yaml", _converted("bag"), edits.text),
    "mcap": ("mcap/mcap.mcap", _converted("mcap"), edits.replaced),
    "csv table": ("table.csv", _converted("table.csv"), edits.text),
    "pose": ("R1.json", _pose, edits.replaced),
    "pose values": ("R1.json", _pose, edits.document),
    "track": ("track.csv", _track, edits.replaced),
    "track text": ("track.csv", _track, edits.text),
    "dataset": (f"{PARTS} {WHOLE} {COUNTS}", _dataset, edits.table),
    "dataset bytes": (f"{PARTS} {WHOLE} {COUNTS} {DOCUMENTS}", _dataset, edits.replaced),
    "dataset documents": (DOCUMENTS, _dataset, edits.document),
    "dataset tiles": ("dataset/tiles.gpkg", _dataset, edits.database),
    "dataset products": (f"{PARTS} {WHOLE} {COUNTS}", _products, edits.table),
    "dataset check": (f"{PARTS} {DOCUMENTS}", _checked, edits.replaced),
    "site": ("SITE.toml", _site, edits.replaced),
    "site text": ("SITE.toml", _site, edits.text),
    "laz header": ("scan.laz", _scan("scan.laz"), edits.head(1000)),
    "laz": ("road.laz", _file(_road, "road.laz"), edits.replaced),
    "recording csv": ("R1.csv", _file(_rows, "R1.csv"), edits.text),
    "recording": ("R1.parquet", _file(_rows, "R1.parquet"), edits.replaced),
    "recording values": ("R1.parquet", _file(_rows, "R1.parquet"), edits.table),
    "tiles": ("tiles.gpkg", _file(gr.read_tiles, "tiles.gpkg"), edits.database),
    "heat map": ("heatmap/heatmap.gpkg", _file(gr.read_heatmap, "heatmap"), edits.database),
    "roads csv": ("roads.csv", _wkt_roads, edits.text),
    "roads": ("roads.gpkg", _file(read_roads, "roads.gpkg"), edits.database),
    "live detections": ("live/detections", live.detections, edits.replaced),
    "live messages": (OF_LIVE, live.messages, edits.replaced),
    "live records": ("live/status live/pose", live.messages, edits.record),
    "live acknowledgement": ("live/ack", live.acknowledgement, edits.replaced),
    "live acknowledgement values": ("live/ack", live.acknowledgement, edits.record),
    "live buffer": ("live/buffer", live.buffer, edits.database),
    "live buffer bytes": ("live/buffer", live.buffer, edits.replaced),
    "live spool": ("live/spool", live.kept_spool, edits.replaced),
    "sensor file": ("SENSOR.toml", live.sensor_file, edits.replaced),
    "sensor file text": ("SENSOR.toml", live.sensor_file, edits.text),
    "live site text": ("LIVE.toml", live.live_site, edits.text),
}
TARGETS = {
    name: Target(
        name=name,
        paths=tuple(paths.split()),
        read=read,
        edit=edit,
        needs="paho" if name.startswith(("live buffer", "live ack")) else "",
    )
    for name, (paths, read, edit) in ROWS.items()
}
