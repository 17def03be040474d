"""Hours of a site joined: vehicles that were followed in parts of a run, each by itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.files import whole_folder
from gis_radar.progress import QUIET, Reporter
from gis_radar.vehicles.folder import (
    DRIVEN,
    OWNED,
    Vehicles,
    read_vehicles,
    write_beside_tracks,
)
from gis_radar.vehicles.merging import edges_of, join_vehicles
from gis_radar.vehicles.passages import LaneletPlaces, PassageBook
from gis_radar.vehicles.pieces import warn_of_poses
from gis_radar.vehicles.settings import DEFAULTS, VehicleSettings
from gis_radar.vehicles.tables import BLOCK_STEPS, COVERED, PASSAGES, TRACKS, VISIBLE, TableWriter

STAGE = "joining the hours"


def write_driven(folder: Path, seen: Sequence[pd.DataFrame]) -> None:
    """Write where sensors see the vehicles of an hour drive, to be judged with other hours."""
    table = pd.concat(seen, ignore_index=True) if seen else pd.DataFrame({"vehicle": []})
    table.to_parquet(folder / DRIVEN, index=False)


def join_hours(
    parts: Sequence[str | Path], folder: str | Path, *, tiles: gpd.GeoDataFrame,
    settings: VehicleSettings = DEFAULTS, reporter: Reporter = QUIET,
) -> Vehicles:  # fmt: skip
    """Join the hours of a site as one folder.

    Other than folders that :func:`gis_radar.merge_vehicles` takes, they come from one run: a sensor
    may be missing in some, and poses may change from one to the next.

    Parameters
    ----------
    parts : sequence of paths
        Folders of :func:`gis_radar.find_vehicles`, each of a span.
    folder : str or Path
        Where the whole goes; it appears whole or not at all.
    tiles : GeoDataFrame
        That they were made from: a vehicle may pass the middle of a lanelet between two hours.
    settings : VehicleSettings
        How far vehicles may be off their lanes.
    reporter : Reporter
        Receives progress, and warnings about the whole.
    """
    hours = [read_vehicles(part) for part in parts]
    whole = join_vehicles(hours)
    between = _passages_between(hours, [Path(part) for part in parts], whole, tiles)
    passages = pd.concat([whole.passages, between], ignore_index=True)
    passages = passages.drop_duplicates(["vehicle", "lanelet_id"])
    provenance = replace(
        whole.provenance,
        hold_s={name: s for part in hours for name, s in sorted(part.provenance.hold_s.items())},
        sources=_joined_sources(whole.provenance.sources),
    )
    begins = [int(part.frames["first_step"].min()) for part in hours]
    with whole_folder(Path(folder), owned=OWNED, reporter=reporter) as place, ExitStack() as files:
        tracks, covered, visible = (
            files.enter_context(
                TableWriter(kind, place / kind.file, provenance.fingerprint, by_piece=by_piece)
            )
            for kind, by_piece in ((TRACKS, False), (COVERED, True), (VISIBLE, True))
        )
        for rows in whole.tracks():
            tracks.add(TRACKS.typed(rows))
        for block in whole.blocks():
            covered.add(block.covered)
            visible.add(block.visible)
            reached = sum(begin < (block.number + 1) * BLOCK_STEPS for begin in begins)
            reporter.progress(STAGE, reached, len(hours))
        passages = PASSAGES.typed(passages.sort_values([*PASSAGES.order]))
        write_beside_tracks(place, provenance, whole.frames, whole.vehicles, passages)
    seen = [pd.read_parquet(Path(part) / DRIVEN) for part in parts]
    found = read_vehicles(folder)
    report_vehicles(found, [each for each in seen if len(each)], settings, reporter)
    return found


def _passages_between(
    hours: Sequence[Vehicles], parts: Sequence[Path], whole: Vehicles, tiles: gpd.GeoDataFrame
) -> pd.DataFrame:
    """Return the passages between the last step of an hour and the first of the next.

    Each hour fits its vehicles by itself. By the one a vehicle may be before a middle up to its
    last step, by the other past it from its first one on: neither has seen it pass.
    """
    places = LaneletPlaces.of(tiles := tiles.sort_values("tile_id", ignore_index=True))
    found = [PASSAGES.empty()]
    begins = {edges_of(each)[0] for each in hours}
    for hour, part in zip(hours, parts, strict=True):
        last = edges_of(hour)[1]
        if last + 1 not in begins:
            continue
        states = pd.concat(whole.tracks((last, last + 1)), ignore_index=True)
        passed = PassageBook(places=places).find(states, whole.vehicles)
        if len(passed):
            tile_id = tiles["tile_id"].to_numpy()[passed["tile"]]
            runs = pd.read_parquet(part / VISIBLE.file, filters=[("tile_id", "in", tile_id)])
            shown = runs.loc[(runs["first_step"] <= last) & (runs["last_step"] >= last), "tile_id"]
            found.append(passed[np.isin(tile_id, shown)].drop(columns="tile"))
    return pd.concat(found, ignore_index=True)


def report_vehicles(
    found: Vehicles, seen: Sequence[pd.DataFrame], settings: VehicleSettings, reporter: Reporter
) -> None:
    """Warn where no vehicle moves, or vehicles drive beside the lanes."""
    if len(found.vehicles) == 0:
        reporter.log("no vehicle moves in these recordings: the coverage is zero", "warning")
    for line in warn_of_poses(seen, settings.pieces):
        reporter.log(line, "warning")


def _joined_sources(sources: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one entry a recording: the rows of all its hours, and the poses that they met."""
    found: dict[str, dict[str, Any]] = {}
    for source in sources:
        rest = {name: each for name, each in source.items() if name not in {"rows", "poses"}}
        known = found.setdefault(json.dumps(rest, sort_keys=True), rest | {"rows": 0, "poses": []})
        known["rows"] += source["rows"]
        known["poses"] += [pose for pose in source["poses"] if pose not in known["poses"]]
    return list(found.values())
