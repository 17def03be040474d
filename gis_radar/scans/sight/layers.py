"""Write sight as a GeoPackage that QGIS styles by itself, and read it back in place of a scan."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import scipy

from gis_radar.base import (
    QUIET,
    GisRadarError,
    InputError,
    Reporter,
    Text,
    UsageError,
    add_layer,
    atomic_write,
    dress_layers,
    keep_styles,
    opened_package,
    paths_of,
)
from gis_radar.hdmap import fingerprint
from gis_radar.poses import Pose, View, pose_from_dict
from gis_radar.scans.sight.kept import KeptSight
from gis_radar.scans.sight.recorded import MOVEMENT, NO_MOVEMENT, Contradiction
from gis_radar.scans.sight.sight import (
    HIDERS,
    OUT_OF_VIEW,
    STATES,
    Sight,
    SightScan,
    SightSource,
)
from gis_radar.scans.sight.tiles import SightTiles

SIGHT_LAYER, CONTRADICTED_LAYER = "sight", "contradicted"
COLUMNS = ("sensor", "pose", "tile_id", "state", "hidden_by", "hidden_at_m", "covered")
MAKE_ONE = Text("make one with: gis-radar sight")
# Farthest pose that a file of sight may be used for: a tile away, or half a metre at 60 m.
POSE_APART_M, POSE_APART_DEG = 0.5, 0.5


def write_sights(
    sights: Sequence[Sight],
    tiles: gpd.GeoDataFrame,
    path: str | Path,
    *,
    contradictions: Sequence[Contradiction] = (),
) -> None:
    """Write what sensors see, a row for each pose and tile in its view; QGIS loads the styles.

    Layer `sight`: `sensor`, `pose` (its number in the layer's metadata), `tile_id`, `state` (`in
    sight` or `hidden`), `hidden_by`, `hidden_at_m` (distance from the sensor in the plane, metres),
    `covered` (whether the scan decides it). The metadata hold the fingerprint of the tiles, the
    poses and the digests of the scans. Layer `contradicted`, where recordings were compared:
    `sensor`, `pose`, `tile_id`, `what`, `frames` with something that moves there, and
    `expected_frames`.

    Parameters
    ----------
    sights : sequence of Sight
        From :func:`find_sight`, or corrected by recordings.
    tiles : GeoDataFrame
        The tiles that the sights are of.
    path : str or Path
        The GeoPackage; it appears whole or not at all.
    contradictions : sequence of Contradiction
        From :func:`gis_radar.scans.sight.recorded.find_contradictions`, of poses of the sights.

    Raises
    ------
    UsageError
        If the name does not end in `.gpkg`.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError("{}: sight is written as GeoPackage", path, hint="end the name in .gpkg")
    about = {
        "fingerprint": fingerprint(tiles),
        "poses": json.dumps([sight.pose.as_dict() for sight in sights]),
        "scans": json.dumps([sight.scan for sight in sights]),
    }
    layers = {SIGHT_LAYER: [_rows(number, sight) for number, sight in enumerate(sights)]}
    if contradictions:
        poses = [sight.pose for sight in sights]
        compared = [_differences(poses.index(each.sight.pose), each) for each in contradictions]
        layers[CONTRADICTED_LAYER] = compared
    with atomic_write(path) as part:
        for layer, rows in layers.items():
            table = pd.concat(rows, ignore_index=True)
            add_layer(
                gpd.GeoDataFrame(
                    table.drop(columns="place"),
                    geometry=tiles.geometry.to_numpy()[table["place"].to_numpy(np.int64)],
                    crs=tiles.crs,
                ),
                part,
                layer,
                geometry_type="Polygon",
                layer_metadata=about,
            )
        names = {SIGHT_LAYER: "sight.qml", CONTRADICTED_LAYER: "contradicted.qml"}
        styles = {
            layer: (files(__package__) / names[layer]).read_text(encoding="utf-8")
            for layer in layers
        }
        dress_layers(part, styles, name="sight", about="what a sensor sees of the tiles")
        keep_styles(part, earlier=path)


def _rows(number: int, sight: Sight) -> pd.DataFrame:
    place = np.flatnonzero(sight.state != OUT_OF_VIEW)
    return pd.DataFrame(
        {
            "place": place,
            "sensor": sight.pose.sensor,
            "pose": number,
            "tile_id": sight.tile_id[place],
            "state": np.array(STATES)[sight.state[place]],
            "hidden_by": np.array(HIDERS)[sight.hider[place]],
            "hidden_at_m": sight.hidden_at_m[place],
            "covered": ~sight.uncovered[place],
        }
    )


def _differences(number: int, found: Contradiction) -> pd.DataFrame:
    place = np.flatnonzero(found.no_movement | found.movement)
    return pd.DataFrame(
        {
            "place": place,
            "sensor": found.sight.pose.sensor,
            "pose": number,
            "tile_id": found.sight.tile_id[place],
            "what": np.where(found.movement[place], MOVEMENT, NO_MOVEMENT).astype(object),
            "frames": found.count[place],
            "expected_frames": found.expected[place].round(1),
        }
    )


class SightFile:
    """Sight as a file of :func:`write_sights` holds it, in place of a scan.

    Parameters
    ----------
    path : str or Path
        The GeoPackage.
    tiles : SightTiles
        The tiles that it was made for.

    Raises
    ------
    InputError
        If the file is missing, damaged, no file of sight, or of other tiles.
    """

    def __init__(self, path: str | Path, tiles: SightTiles) -> None:
        self.path, self.tiles = Path(path), tiles
        rows, about = _read(self.path)
        if about["fingerprint"] != tiles.fingerprint:
            raise InputError(
                "{}: was made for tiles {}, these are {}",
                path,
                about["fingerprint"],
                tiles.fingerprint,
                hint="make it again for these tiles with: gis-radar sight",
            )
        try:
            poses = [pose_from_dict(each, what=str(path)) for each in json.loads(about["poses"])]
            scans = [str(each) for each in json.loads(about["scans"])]
            self.sights = [
                _sight_of(pose, scan, rows[rows["pose"] == number], tiles)
                for number, (pose, scan) in enumerate(zip(poses, scans, strict=True))
            ]
        except (ValueError, KeyError, TypeError, GisRadarError) as error:
            raise InputError("{}: damaged: {}", path, error, hint=MAKE_ONE) from error

    @cached_property
    def digest(self) -> str:
        """Digest of tiles, poses and states, independent of the file's name and time."""
        found = hashlib.blake2b(self.tiles.fingerprint.encode(), digest_size=16)
        for sight in self.sights:
            found.update(json.dumps(sight.pose.as_dict(), sort_keys=True).encode())
            found.update(sight.state.tobytes())
        return found.hexdigest()

    def read(self, poses: Sequence[Pose]) -> None:
        """Refuse poses that the file does not hold, before any work."""
        for pose in poses:
            self.find(pose)

    def find(self, pose: Pose) -> Sight:
        """Return the sight of the nearest pose of a sensor.

        Raises
        ------
        InputError
            If the file has none of this sensor, of another view, or of a pose too far away.
        """
        own = [sight for sight in self.sights if sight.pose.sensor == pose.sensor]
        if not own:
            names = ", ".join(dict.fromkeys(sight.pose.sensor for sight in self.sights))
            raise InputError("{}: holds no sight of {}, only of {}", self.path, pose.sensor, names)
        view = pose.view or View()
        alike = [sight for sight in own if (sight.pose.view or View()) == view]
        if not alike:
            raise InputError(
                "{}: the sight of {} was made for another view",
                self.path,
                pose.sensor,
                hint=Text("make it again for {} with: gis-radar sight", view),
            )
        apart = [_apart(sight.pose, pose) for sight in alike]
        best = min(range(len(alike)), key=lambda k: apart[k])
        away_m, turn_deg = apart[best]
        if away_m > POSE_APART_M or turn_deg > POSE_APART_DEG:
            raise InputError(
                "{}: the sight of {} was made {:.1f} m and {:.1f} deg from its pose",
                self.path,
                pose.sensor,
                away_m,
                turn_deg,
                hint="make it again for this pose with: gis-radar sight",
            )
        return replace(alike[best], pose=pose)

    def describe(self) -> dict[str, Any]:
        """Return file and digest of the sight, as a manifest holds them."""
        return {"file": self.path.name, "digest": self.digest}


def _apart(one: Pose, other: Pose) -> tuple[float, float]:
    """Return the distance (m) and the angle (deg) between two poses."""
    rotation = scipy.spatial.transform.Rotation
    turn = rotation.from_quat(one.quaternion).inv() * rotation.from_quat(other.quaternion)
    away_m = float(np.linalg.norm(one.position - other.position))
    return away_m, float(np.degrees(turn.magnitude()))


def _read(path: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return the rows of a file of sight and its metadata."""
    with opened_package(path, what="a file of sight", hint=MAKE_ONE) as place:
        about = pyogrio.read_info(place, layer=SIGHT_LAYER)["layer_metadata"] or {}
        rows = pyogrio.read_dataframe(place, layer=SIGHT_LAYER, read_geometry=False)
    lacks = [name for name in COLUMNS if name not in rows.columns]
    lacks += [name for name in ("fingerprint", "poses", "scans") if name not in about]
    if lacks:
        raise InputError(
            "{}: layer {} lacks {}", path, SIGHT_LAYER, ", ".join(lacks), hint=MAKE_ONE
        )
    return rows, about


def _sight_of(pose: Pose, scan: str, rows: pd.DataFrame, tiles: SightTiles) -> Sight:
    """Return sight from its rows; tiles without a row are out of view."""
    wanted = rows["tile_id"]
    if not (pd.api.types.is_integer_dtype(wanted) and wanted.isin(tiles.tile_id).all()):
        raise ValueError(Text("a row is of none of these tiles"))
    order = np.argsort(tiles.tile_id)
    place = order[np.searchsorted(tiles.tile_id, wanted.to_numpy(np.int64), sorter=order)]
    count = len(tiles.tile_id)
    state, hider = np.full(count, OUT_OF_VIEW, np.uint8), np.zeros(count, np.uint8)
    uncovered, hidden_at_m = np.zeros(count, np.bool_), np.full(count, np.nan)
    state[place] = [STATES.index(each) for each in rows["state"]]
    hider[place] = [HIDERS.index(each) for each in rows["hidden_by"].fillna("")]
    hidden_at_m[place] = rows["hidden_at_m"].to_numpy(np.float64)
    uncovered[place] = ~rows["covered"].to_numpy(np.bool_)
    return Sight(
        pose=pose, tile_id=tiles.tile_id, state=state, hider=hider, hidden_at_m=hidden_at_m,
        uncovered=uncovered, scan=scan,
    )  # fmt: skip


def open_sight(
    tiles: SightTiles,
    *,
    scans: str | Path | Sequence[str | Path] = (),
    scan_crs: Any = None,
    sight: str | Path | None = None,
    cache: str | Path | None = None,
    reporter: Reporter = QUIET,
) -> SightSource | None:
    """Open the source of sight: scans, a file of sight, or neither.

    Parameters
    ----------
    tiles : SightTiles
        The tiles.
    scans : path or sequence of paths
        Airborne scans, whole and not masked.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    sight : str or Path, optional
        A file of :func:`write_sights`, in place of scans.
    cache : str or Path, optional
        A folder for the sights of poses by these scans, so that each is computed once.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    SightScan, KeptSight, SightFile or None
        For :func:`find_sight` and :func:`describe_sight`; None means that sight is the view alone.

    Raises
    ------
    UsageError
        If both are given; InputError where a file is bad.
    """
    if sight is not None:
        if scans:
            raise UsageError("both scans and a file of sight are given", hint="give one of them")
        return SightFile(sight, tiles)
    if not scans:
        return None
    scan = SightScan(paths_of(scans), tiles, scan_crs=scan_crs, reporter=reporter)
    return scan if cache is None else KeptSight(scan, Path(cache))
