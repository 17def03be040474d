"""Spools of the sample's frames at other times, and the site that fusion's worker measures."""

from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import gis_radar as gr
from gis_radar.live import (
    DetectionSelector,
    Envelope,
    PoseContent,
    Spool,
    SpooledFrames,
    frames_of_recording,
    key_of_pose,
    pack_detections,
    pack_message,
)
from gis_radar.live.hours.hour_work import MeasuredSite
from gis_radar.measures import road_near
from gis_radar.scans import SightTiles, find_sight

SAMPLE = gr.sample_folder()
FRAMES = 800  # of a sensor: 40 s of the sample's hundred


@cache
def sample_road():
    """Return the sample's tiles, as where vehicles are looked for."""
    return SightTiles.of(gr.make_tiles(gr.read_map(SAMPLE / "junction.osm")))


@cache
def tiles_file():
    """Return the bytes of a file of the sample's tiles, and their fingerprint."""
    roads = gr.read_map(SAMPLE / "junction.osm")
    with TemporaryDirectory() as place:
        path = Path(place) / "tiles.gpkg"
        gr.write_tiles(gr.make_tiles(roads), path, problems=roads.problems)
        return path.read_bytes(), SightTiles.of(gr.read_tiles(path)).fingerprint


@cache
def selected_frames(name, path=None):
    """Return what a sensor of the sample sends: of its first seconds, or of another recording."""
    road, pose = sample_road(), gr.read_pose(SAMPLE / f"{name}.json")
    selector, height = DetectionSelector(road), road_near(find_sight(pose, road), road)
    frames = frames_of_recording(path or SAMPLE / f"{name}.parquet")
    if path is None:
        frames = islice(frames, FRAMES)
    return [selector.find(each, pose, road_m=height) for each in frames]


def frames_at(name, begin_us, *, seconds=30.0):
    """Return the first seconds of them as if the first of all sensors came at a time."""
    first = min(selected_frames(each)[0].time_us for each in ("R1", "R2"))
    return [
        replace(each, time_us=each.time_us - first + begin_us)
        for each in selected_frames(name)
        if each.time_us - first < 1e6 * seconds
    ]


class SpooledSite:
    """The sample as a live site: what its sensors sent waits in fusion's spool.

    Keys are those of the site, in place of the usual ones.
    """

    def __init__(self, folder, **given):
        self.folder = folder / "live"
        tiles = folder / "tiles.gpkg"
        content, self._print = tiles_file()
        tiles.write_bytes(content)
        self.site = MeasuredSite(
            **{
                "folder": self.folder, "map": SAMPLE / "junction.osm", "tiles": tiles,
                "sensors": ("R1", "R2"), "scans": (), "scan_crs": None, "filters": gr.Filters(),
                "cycles": {}, "timezone": "UTC", "vehicles": False, "keep_s": 1e10,
                "most_bytes": 1e12, "of_lanes": {"lanes": []},
            } | given
        )  # fmt: skip
        self.spool = Spool(self.folder / "spool")
        self.spool.rotate()
        self._number = 0

    def pose(self, name, **changes):
        """Return the message with a pose of a sensor."""
        pose = gr.read_pose(SAMPLE / f"{name}.json").as_dict() | changes
        return PoseContent(pose=pose, fingerprint=self._print).pack()

    def add(self, name, frames, *, pose=None):
        """Put frames of a sensor in the spool, and close its file; return all closed ones."""
        message = pose or self.pose(name)
        key = key_of_pose(message)
        for begin in range(0, len(frames), 50):
            self._number += 1
            content = pack_detections(frames[begin : begin + 50], pose=key)
            payload = pack_message(Envelope(stream=b"abcd", number=self._number), content)
            self.spool.add(SpooledFrames(name, message, payload))
        self.spool.collect()
        self.spool.write()
        self.spool.rotate()
        return self.spool.closed

    def parts(self, hour=None):
        """Return the digests of the dataset's parts, of an hour or all."""
        found = self.site.dataset.glob(f"*/date=*/{'*' if hour is None else hour}.parquet")
        return {str(path.relative_to(self.site.dataset)): path.read_bytes() for path in found}
