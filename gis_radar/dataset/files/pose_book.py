"""Poses of a dataset, and what each of them sees: `poses.parquet` and `sights.parquet`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from gis_radar.base import InputError
from gis_radar.dataset.files.parts import part_path, single_file, write_single_file
from gis_radar.dataset.files.tables import POSES, SIGHTS
from gis_radar.measures import PoseSight, digest_of_sights, pose_names
from gis_radar.poses import ANGLES, POSITION, PoseTrack, pose_from_dict


@dataclass(frozen=True, kw_only=True)
class PoseBook:
    """Pose tracks of a dataset, and the sights of their poses.

    Parameters
    ----------
    tracks : dict
        By name; a single pose is a track of one.
    sights : dict
        By the same name, the sight of each pose.
    """

    tracks: dict[str, PoseTrack] = field(default_factory=dict)
    sights: dict[str, Sequence[PoseSight]] = field(default_factory=dict)

    def joined(self, other: PoseBook) -> PoseBook:
        """Return a book with the poses of both."""
        return PoseBook(tracks=self.tracks | other.tracks, sights=self.sights | other.sights)

    def of(self, names: Iterable[str]) -> PoseBook:
        """Return a book with some of the tracks."""
        tracks = {name: self.tracks[name] for name in sorted(set(names))}
        return PoseBook(tracks=tracks, sights={name: self.sights[name] for name in tracks})

    @property
    def by_pose(self) -> dict[str, PoseSight]:
        """Sights by the name of their pose, each once."""
        found = {each.name: each for sights in self.sights.values() for each in sights}
        return dict(sorted(found.items()))

    def write(self, folder: Path, fingerprint: str) -> None:
        """Write the tables of poses and sights of a dataset with tiles of a fingerprint."""
        write_single_file(SIGHTS, folder, _sights_table(self), fingerprint)
        write_single_file(POSES, folder, _poses_table(self), fingerprint)

    @classmethod
    def read(cls, folder: Path, fingerprint: str, recordings: pa.Table) -> PoseBook:
        """Read the poses of a dataset and their sights.

        Parameters
        ----------
        folder : Path
            Folder of the dataset.
        fingerprint : str
            Fingerprint of its tiles.
        recordings : pyarrow.Table
            Its table of recordings, read before: a run that adds some writes their poses first.

        Raises
        ------
        InputError
            If a table is damaged, or of another run than the recordings.
        """
        poses, sights = (
            single_file(table, folder, fingerprint).read() for table in (POSES, SIGHTS)
        )
        try:
            book = _poses_from(poses, sights, folder)
            known = {name: digest_of_sights(each) for name, each in book.sights.items()}
            stated = recordings.filter(recordings["sights"].is_valid())
            tracks = stated.group_by(["pose", "sights"]).aggregate([("path", "min")]).to_pylist()
            other = [each["path_min"] for each in tracks if known[each["pose"]] != each["sights"]]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError("{}: damaged: {}", folder, f"{error!r:.200}") from error
        if other:
            raise InputError(
                "{}: is not of the run that measured {}, or poses.parquet is not",
                part_path(folder, SIGHTS),
                min(other),
                hint="bring back the files of this dataset, or measure into a new folder",
            )
        return book


def _poses_table(poses: PoseBook) -> Mapping[str, Any]:
    rows = []
    for name, track in poses.tracks.items():
        names = pose_names(name, len(track.poses))
        since = [each if math.isfinite(each) else None for each in track.since.tolist()]
        for own, pose, begin, sight in zip(
            names, track.poses, since, poses.sights[name], strict=True
        ):
            rows.append(
                {
                    "pose": own, "sensor": pose.sensor, "track": name, "since": begin,
                    **{part: getattr(pose, part) for part in (*POSITION, *ANGLES)},
                    "sight": sight.name,
                    "road_m": sight.road_m if math.isfinite(sight.road_m) else None,
                    "document": json.dumps(pose.as_dict(), sort_keys=True),
                }
            )  # fmt: skip
    rows.sort(key=lambda row: str(row["pose"]))
    return {name: [row[name] for row in rows] for name in POSES.names}


def _sights_table(poses: PoseBook) -> Mapping[str, Any]:
    names = [*poses.by_pose]
    tiles = [each.tile_id for each in poses.by_pose.values()]
    return {
        "pose": np.repeat(np.array([*names, ""], object)[:-1], [len(each) for each in tiles]),
        "tile_id": np.concatenate([np.empty(0, np.int64), *tiles]),
    }


def _poses_from(poses: pa.Table, sights: pa.Table, folder: Path) -> PoseBook:
    """Return the poses of a dataset from its tables."""
    frame, pairs = poses.to_pandas(), sights.to_pandas()
    tiles = {name: rows.to_numpy(np.int64) for name, rows in pairs.groupby("pose")["tile_id"]}
    book = PoseBook()
    for name, rows in frame.groupby("track", sort=True):
        track_poses = tuple(
            pose_from_dict(json.loads(text), what=f"{folder}: {name}") for text in rows["document"]
        )
        since = rows["since"].fillna(-math.inf).to_numpy(np.float64)
        book.tracks[str(name)] = PoseTrack(poses=track_poses, since=since)
        sight_names = set(rows["sight"])
        own_sights = {
            own: PoseSight(
                name=own, pose=pose, road_m=float(road_m),
                tile_id=tiles.get(own, np.empty(0, np.int64)),
            )
            for own, pose, road_m in zip(rows["pose"], track_poses, rows["road_m"], strict=True)
            if own in sight_names
        }  # fmt: skip
        book.sights[str(name)] = tuple(own_sights[head] for head in rows["sight"])
    return book
