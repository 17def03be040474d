"""Peers: hit share as in the paper, and the best occupancy that the detections allow."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scenes import SceneFiles
from true_occupancy import HIDDEN_STEPS, occupied_pairs

import gis_radar as gr
from gis_radar.base import STEP_S, Booleans, Floats, step_of

BESIDE_M = 0.5  # how far beside its vehicle a detection may lie


def hits(site: SceneFiles) -> pd.DataFrame:
    """Return the hit share (the paper's occupancy) as ``tile_id occupied_s visible_s``."""
    wide = gr.make_heatmap(_hits_only(site)).wide()
    renamed = {"hit_s": "occupied_s", "observed_s": "visible_s"}
    return pd.DataFrame(wide[["tile_id", *renamed]]).rename(columns=renamed)


def _hits_only(site: SceneFiles) -> gr.Dataset:
    """Return a dataset of a scene's hits, measured again only where its files have changed."""
    return gr.measure(
        site.recordings, site.poses, site.tiles(), None, site.kept / "hits", scans=[site.scan],
        hits_only=True, only=True,
    )  # fmt: skip


def oracle(site: SceneFiles) -> pd.DataFrame:
    """Return the occupancy of true footprints, as far as detections show them: a tracker's best.

    A vehicle counts from its first detection to its last, without gaps of over ten seconds.
    """
    truth, traffic, tiles = site.truth(), site.traffic(), site.tiles()
    count = truth.occupied.shape[1]
    traffic = traffic.within(truth.first_step, truth.first_step + count - 1)
    hit = steps_with_detections(site, traffic.states)
    seen = tiles[tiles["tile_id"].isin(truth.tile_id)]
    pairs = occupied_pairs(seen, traffic, truth.first_step)
    known = pd.DataFrame({**pairs, "at": pairs["step"] + truth.first_step})
    last = pd.merge_asof(known.sort_values("at"), hit, on="at", by="vehicle")
    both = pd.merge_asof(last, hit.rename(columns={"hit": "next"}), on="at", by="vehicle",
                         direction="forward")  # fmt: skip
    held = both[both["next"] - both["hit"] <= HIDDEN_STEPS]
    occupied = np.zeros_like(truth.occupied)
    occupied[held["tile"], held["step"]] = True
    return pd.DataFrame(
        {
            "tile_id": truth.tile_id,
            "occupied_s": (occupied & truth.visible).sum(axis=1) * STEP_S,
            "visible_s": truth.visible.sum(axis=1) * STEP_S,
        }
    )


def steps_with_detections(site: SceneFiles, states: pd.DataFrame) -> pd.DataFrame:
    """Return the steps in which a detection lies on a vehicle: ``vehicle at hit`` (both: step)."""
    states = states.sort_values("step", kind="stable")
    steps = states["step"].to_numpy()
    columns = ["easting", "northing", "heading", "length", "width", "vehicle"]
    boxes = states[columns].to_numpy(np.float64)
    found = []
    for pose, path in zip(site.poses, site.recordings, strict=True):
        table = pd.read_parquet(path).dropna(subset="x")
        places = pose.to_map(table[["x", "y", "z"]].to_numpy(np.float64))[:, :2]
        heard = step_of(table["time"].to_numpy())
        for step in np.unique(heard):
            low, high = np.searchsorted(steps, [step, step + 1])
            begin, end = np.searchsorted(heard, [step, step + 1])
            on = _inside(places[begin:end], boxes[low:high]).any(axis=0)
            found += [(int(v), int(step)) for v in boxes[low:high][on, 5]]
    hit = pd.DataFrame(found, columns=["vehicle", "at"]).drop_duplicates()
    return hit.sort_values("at", ignore_index=True).assign(hit=lambda t: t["at"])


def _inside(places: Floats, boxes: Floats) -> Booleans:
    """Return (places, boxes): whether a place is in a footprint, or up to `BESIDE_M` beside it."""
    away = places[:, None] - boxes[:, :2]
    cos, sin = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    along = np.abs(cos * away[..., 0] + sin * away[..., 1])
    aside = np.abs(cos * away[..., 1] - sin * away[..., 0])
    return np.asarray(
        (along < boxes[:, 3] / 2.0 + BESIDE_M) & (aside < boxes[:, 4] / 2.0 + BESIDE_M)
    )
