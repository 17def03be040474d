"""A small site that tests write as files: two streets that meet, scanned, with two radars."""

from __future__ import annotations

import numpy as np
from maps import write_osm
from scans import write_points
from streets import WIDTH_M, Street

FRAMES = 600
SCAN_BOX = (-95.0, -95.0, 95.0, 12.0)

SITE = """\
title = "Small site"
timezone = "Europe/Berlin"

[map]
file = "map.osm"
crs = "EPSG:25832"

[scan]
files = ["scan*.laz"]
engine = "laspy"

[measure]
clearance = [-0.5, 4.5]

[heatmap]
intervals = ["10s"]

[[sensor]]
name = "R1"
recordings = ["R1.parquet"]
guess = [{east:.1f}, {north:.1f}]
compass = 130.0
view = {{ max_range_m = 150.0, elevation_deg = 60.0 }}

[[sensor]]
name = "R2"
recordings = ["R2_*.parquet"]
pose = "R2.json"
"""


def write_site(folder):
    """Write map, scan, recordings, a pose and the site file; return the file and the true poses."""
    street = Street()
    write_map(street, folder / "map.osm")
    rng = np.random.default_rng(1)
    west, south, east, north = SCAN_BOX
    plan = np.column_stack([rng.uniform(west, east, 60_000), rng.uniform(south, north, 60_000)])
    height = street.ground(plan) + rng.normal(0.0, 0.02, len(plan))
    write_points(folder / "scan_1.laz", np.column_stack([plan, height]), category=2)
    poses = {"R1": street.pose(), "R2": street.pose(place=(12.0, 9.0), yaw=-120.0)}
    street.record(folder / "R1.parquet", poses["R1"], frames=FRAMES)
    street.record(folder / "R2_0.parquet", poses["R2"], frames=200, vehicles=10, seed=2)
    poses["R2"].write(folder / "R2.json")
    true = poses["R1"]
    text = SITE.format(east=true.easting + 4.0, north=true.northing - 3.0)
    (folder / "SITE.toml").write_text(text, encoding="utf-8")
    return folder / "SITE.toml", poses


def write_map(street, path):
    nodes, ways, lanelets, number = {}, {}, {}, 1
    for lane_id, lane in enumerate(street.lanes, start=1):
        begin, end = np.asarray(lane, float)
        along = (end - begin) / np.linalg.norm(end - begin)
        left = np.array([-along[1], along[0]]) * WIDTH_M / 2
        for side, shift in enumerate((left, -left)):
            refs = []
            for place in np.linspace(begin, end, 20) + shift:
                turned = street.placed(place) - street.middle
                nodes[number] = (*turned, float(street.ground(place)))
                refs.append(number)
                number += 1
            ways[10_000 + 10 * lane_id + side] = refs
        tags = {"subtype": "road", "location": "urban", "one_way": "yes"}
        lanelets[lane_id] = (10_000 + 10 * lane_id, 10_001 + 10 * lane_id, tags)
    write_osm(path, nodes, ways, lanelets)
