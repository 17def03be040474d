"""Peers: other ways from a scene's recordings to a coverage, on the same poses and tiles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from scenes import SceneFiles

import gis_radar as gr
from gis_radar.steps import STEP_S

CLOSED_STEPS = 20  # 1 s


def hits(site: SceneFiles) -> pd.DataFrame:
    """Return hit occupancy, the paper's."""
    occupancy = _occupancy(site)
    wide = gr.make_heatmap(occupancy, site.tiles()).wide()
    renamed = {"occupied_s": "covered_s", "observed_s": "visible_s"}
    return pd.DataFrame(wide[["tile_id", *renamed]]).rename(columns=renamed)


def hits_closed(site: SceneFiles) -> pd.DataFrame:
    """Return hit occupancy with gaps of a second and less between hits of a tile closed."""
    occupancy = _occupancy(site)
    step, tile = (np.concatenate(c) for c in zip(*occupancy.held_hits(), strict=True))
    order = np.lexsort([step, tile])
    step, tile = step[order], tile[order]
    gap = np.diff(step, append=step[-1:])
    same = np.append(tile[1:] == tile[:-1], False)
    steps = np.where(same & (gap <= CLOSED_STEPS + 1), gap, 1)
    closed = pd.Series(steps * STEP_S).groupby(tile).sum()
    table = hits(site)
    return table.assign(covered_s=table["tile_id"].map(closed).fillna(0.0))


def _occupancy(site: SceneFiles) -> gr.Occupancy:
    folder: Path = site.kept / "occupancy"
    if not folder.exists():
        gr.measure_occupancy(site.recordings, site.poses, site.tiles(), folder)
    return gr.read_occupancy(folder)


PEERS: Mapping[str, Callable[[SceneFiles], pd.DataFrame]] = {
    "hits": hits,
    "closed": hits_closed,
}
