"""A street that forks at a stop line, cars on it, and datasets of them."""

from __future__ import annotations

import math

import geopandas as gpd
import numpy as np
import pandas as pd
from driven import drive, driven
from maps import EAST, NORTH, UTM
from shapely import LineString, Polygon

APPROACH, STRAIGHT, LEFT = 10, 20, 30  # lanes, each of one lanelet of that number
LINE_M = 60.0  # the stop line, at the end of the approach


def strip(lanelet, place, turn_deg, length, first_tile):
    """Lay the tiles of a lanelet from a place, headed so."""
    way = np.array([math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))])
    side = 1.5 * np.array([-way[1], way[0]])
    rows = []
    for i in range(round(length / 0.5)):
        begin, end = (np.array(place) + (EAST, NORTH) + way * 0.5 * k for k in (i, i + 1))
        ring = Polygon([begin - side, end - side, end + side, begin + side])
        rows.append({
            "tile_id": first_tile + i, "lanelet_id": lanelet, "index": i, "s_m": 0.5 * i,
            "length_m": 0.5, "width_m": 3.0, "height_m": 0.0, "subtype": "road", "lane": lanelet,
            "geometry": ring,
        })  # fmt: skip
    return rows


def fork():
    """Lay an approach that forks at its stop line: straight on, or 25 degrees to the left."""
    rows = strip(APPROACH, (0, 0), 0, 60, 0)
    rows += strip(STRAIGHT, (60, 0), 0, 40, len(rows))
    rows += strip(LEFT, (60, 0), 25, 40, len(rows))
    return gpd.GeoDataFrame(rows, crs=UTM)


def fork_lanes(line_m=LINE_M):
    """Give the lanes of the fork, on streets of which one looks like a formula."""
    end = (EAST + 60 + 40 * math.cos(math.radians(25)), NORTH + 40 * math.sin(math.radians(25)))
    lines = [
        LineString([(EAST, NORTH), (EAST + 60, NORTH)]),
        LineString([(EAST + 60, NORTH), (EAST + 100, NORTH)]),
        LineString([(EAST + 60, NORTH), end]),
    ]
    known = {
        "lane": [APPROACH, STRAIGHT, LEFT], "subtype": ["road"] * 3, "length_m": [60.0, 40.0, 40.0],
        "street": ["=Ring", "=Ring", None], "street_part": [None] * 3,
        "turn": ["left;straight", None, None], "stop_line_m": [line_m, np.nan, np.nan],
        "speed_limit_kmh": [36.0, 36.0, np.nan],
    }  # fmt: skip
    return gpd.GeoDataFrame(known, geometry=lines, crs=UTM)


def crossing():
    """Give tiles and lanes of the fork without a stop line, and of a street across the way on."""
    rows, lanes = [], fork_lanes(np.nan)
    for lane, begin, length in ((40, -40, 30), (50, -10, 20)):
        rows += strip(lane, (70, begin), 90, length, len(fork()) + len(rows))
        ends = [(EAST + 70, NORTH + begin), (EAST + 70, NORTH + begin + length)]
        row = lanes.iloc[[1]].assign(lane=lane, length_m=length, geometry=[LineString(ends)])
        lanes = pd.concat([lanes, row], ignore_index=True)
    return pd.concat([fork(), gpd.GeoDataFrame(rows, crs=UTM)], ignore_index=True), lanes


def through(vehicle, first_step, exit_lane, *, by=0.5, begin=2.0):
    """Drive a car from the approach to an exit, so many metres a step."""
    fronts = np.arange(begin, 95.0, by)
    beyond = fronts >= LINE_M
    lanes = np.where(beyond, exit_lane, APPROACH)
    states = drive(vehicle, first_step, fronts, speed=20.0 * by, lanelet_id=lanes)
    return states.assign(s_m=np.where(beyond, fronts - LINE_M, fronts))


def fork_dataset(folder, tracks, **options):
    """Write a dataset of cars on the fork."""
    return driven(folder, fork(), pd.concat(tracks), lanes=fork_lanes(), **options)
