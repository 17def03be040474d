"""A cache of sight in a folder: what a sensor sees from a pose is computed once."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import atomic_write
from gis_radar.poses import Pose, View
from gis_radar.scans.sight.sight import METHOD, Sight, SightScan

_ARRAYS = ("state", "hider", "hidden_at_m", "uncovered")
_DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


class KeptSight:
    """Sight by a scan, with a cache of the sights of poses.

    Parameters
    ----------
    scan : SightScan
        The scans.
    folder : Path
        Holds a file for each pose; several processes may use it at a time.
    """

    def __init__(self, scan: SightScan, folder: Path) -> None:
        self.scan, self.folder = scan, folder

    def read(self, poses: Sequence[Pose]) -> None:
        """Read what the scan has around the poses that are not in the cache."""
        self.scan.read([pose for pose in poses if not self._path(pose).exists()])

    def find(self, pose: Pose) -> Sight:
        """Return what a sensor sees from a pose, from the cache or by the scan.

        Raises
        ------
        InputError
            As of :meth:`SightScan.find`.
        """
        path = self._path(pose)
        if (kept := self._kept(path, pose)) is not None:
            return kept
        sight = self.scan.find(pose)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **{name: getattr(sight, name) for name in _ARRAYS})
        return sight

    def describe(self) -> dict[str, Any]:
        """Return the description of the scan for a manifest."""
        return self.scan.describe()

    def _kept(self, path: Path, pose: Pose) -> Sight | None:
        """Return a sight from the cache; None where it is missing or damaged."""
        try:
            with path.open("rb") as file, np.load(file) as arrays:
                found = {name: arrays[name] for name in _ARRAYS}
        except _DAMAGED:
            return None
        ids = self.scan.tiles.tile_id
        if any(values.shape != ids.shape for values in found.values()):
            return None
        return Sight(pose=pose, tile_id=ids, scan=self.scan.digest, **found)

    def _path(self, pose: Pose) -> Path:
        """Return the file of a pose: its name is a digest of all that sight depends on."""
        place = [pose.position.tolist(), pose.quaternion.tolist(), asdict(pose.view or View())]
        digest = hashlib.blake2b(self._origin, digest_size=16)
        digest.update(json.dumps(place).encode())
        return self.folder / f"{digest.hexdigest()}.npz"

    @cached_property
    def _origin(self) -> bytes:
        """Digest of scan, tiles and method."""
        tiles = self.scan.tiles
        found = hashlib.blake2b(f"{self.scan.digest} {METHOD}".encode())
        found.update(tiles.fingerprint.encode() + tiles.height.tobytes())
        return found.digest()
