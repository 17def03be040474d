"""Poses by traffic and by what stands: both together are nearer to the truth, and say how near."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_scan_check import POSE, R2, SAMPLE, SCAN, moved

import gis_radar as gr
from gis_radar.calibration import Localization
from gis_radar.calibration.registration.certainty import stated
from gis_radar.calibration.registration.state import along_arc, from_arc, rotation
from gis_radar.calibration.scan.pose_update import (
    fix_open_direction,
    offset_covariance,
    updated_by_scan,
)
from gis_radar.calibration.scan.scan_check import Alignment
from gis_radar.calibration.scan.surroundings import Standing
from gis_radar.calibration.single import localization as localizing

SIGMAS = (0.3, 0.3, 0.2, 0.003, 0.003, 0.005)


def by_traffic(pose, sigmas=SIGMAS, open_m=0.0):
    """Give a pose as localization does, with its covariance, open towards the truth or not."""
    covariance, gap = np.diag(np.square(sigmas)), (POSE.position - pose.position)[:2]
    if open_m:
        covariance[:2, :2] += open_m**2 * np.outer(gap, gap) / (gap @ gap)
    evidence = {"method": "lane", "observable": open_m < 1.0, **stated(covariance)}
    return replace(pose, evidence=evidence)


def away(pose):
    return float(np.hypot(*(pose.position - POSE.position)[:2]))


def test_both_are_nearer_to_the_truth_than_traffic_alone():
    given = by_traffic(moved(POSE, ahead=0.4, left=-0.3, turn=0.3))
    found = updated_by_scan(given, gr.check_against_scan(R2, given, [SCAN]))
    assert away(found) < 0.8 * away(given)
    assert abs(found.yaw - POSE.yaw) < 0.3
    before, after = given.evidence["sigma"], found.evidence["sigma"]
    for name in ("easting", "northing", "yaw"):
        assert after[name] < before[name]
        assert abs(getattr(found, name) - getattr(POSE, name)) < 3.0 * after[name]
    assert found.height == given.height  # nothing relates it to the place here


def test_what_it_contradicts_or_cannot_measure_stays_as_it_is():
    elsewhere = by_traffic(moved(POSE, left=1.5), (0.1, 0.1, *SIGMAS[2:]))
    look = gr.check_against_scan(R2, elsewhere, [SCAN])
    assert look.verdict == "confirms"
    assert updated_by_scan(elsewhere, look) is None
    assert fix_open_direction(elsewhere, look) == (elsewhere, elsewhere)  # nothing is open
    assert updated_by_scan(POSE, look) is POSE  # without a covariance
    given = by_traffic(POSE)
    assert updated_by_scan(given, replace(look, verdict="undecided")) is given


def test_a_direction_that_traffic_leaves_open_is_closed(monkeypatch):
    """As on a straight road: 5 m off along it, which the stated covariance allows."""
    given = by_traffic(moved(POSE, ahead=4.0, left=3.0), open_m=6.0)
    answer = Localization(pose=given, fitness=0.95, observable=False)
    monkeypatch.setattr(localizing, "localize_one", lambda *_, **__: answer)
    files = (R2, SAMPLE / "junction.osm", SCAN)
    assert not gr.localize(*files, guess=POSE.position[:2]).observable
    found = gr.localize(*files, guess=POSE.position[:2], scans=[SCAN])
    assert away(given) == pytest.approx(5.0, abs=0.01)
    assert away(found.pose) < 0.5
    assert found.observable
    assert found.pose.evidence["observable"]
    assert found.pose.evidence["scan_check"]["verdict"] == "confirms"


def test_a_direction_round_a_bend_is_closed_along_its_circle():
    """17 m off round a circle of 60 m, where a straight line would end 2.4 m beside it."""
    turn, way = math.radians(16.0), np.array([math.cos(2.0), math.sin(2.0)])
    gap = np.array(along_arc(*(-60.0 * turn * way), -turn))
    there = np.array(from_arc(*(60.0 * turn * (rotation(-turn) @ way)), 0.0))
    assert np.array(along_arc(*there, turn)) == pytest.approx(-gap)  # back to the truth
    given = replace(
        POSE,
        easting=POSE.easting + gap[0],
        northing=POSE.northing + gap[1],
        yaw=math.remainder(POSE.yaw - math.degrees(turn), 360.0),
    )
    covariance, along = np.diag(np.square(SIGMAS)), np.zeros(6)
    along[[0, 1, 5]] = [*(rotation(-turn) @ way), 1.0 / 60.0]
    along[2] = 0.05  # the road climbs
    covariance += 10.0**2 * np.outer(along, along)
    given = replace(given, evidence={"method": "lane", "observable": False, **stated(covariance)})
    moved, closed = fix_open_direction(given, gr.check_against_scan(R2, given, [SCAN]))
    assert away(given) > 16.0
    assert away(closed) < 0.5
    assert abs(closed.yaw - POSE.yaw) < 1.0
    assert closed.evidence["observable"]
    assert moved.position == pytest.approx(closed.position)
    assert closed.height - given.height == pytest.approx(0.05 * 60.0 * turn, abs=0.05)
    assert moved.evidence["sigma"]["yaw"] == pytest.approx(given.evidence["sigma"]["yaw"])


def test_the_paper_s_method_is_kept_as_it_is(monkeypatch):
    given = by_traffic(moved(POSE, ahead=0.5))
    given = replace(given, evidence={**given.evidence, "method": "icp"})
    answer = Localization(pose=given, fitness=0.95, observable=True)
    monkeypatch.setattr(localizing, "localize_one", lambda *_, **__: answer)
    found = gr.localize(
        R2, SAMPLE / "junction.osm", SCAN, guess=POSE.position[:2], scans=[SCAN], method="icp"
    )
    assert found.pose.easting == given.easting


def test_a_long_wall_measures_nothing_along_it():
    """A second wall across it does."""
    size = 240
    wall = np.zeros((size, size))
    ahead = (np.arange(size) - size // 2 + 0.5) * 0.5
    wall[:] = np.exp(-0.5 * ((ahead - 20.0) / 0.75) ** 2)[:, None]  # 20 m ahead, from left to right
    left = np.arange(-30.0, 30.0, 0.5)
    points = np.column_stack([np.full(len(left), 20.0), left, np.full(len(left), 2.0)])
    standing = Standing(points=points, rustles=np.zeros(len(left)))
    alignment = Alignment(standing=standing, closeness=wall)
    assert offset_covariance(alignment, alignment.here) is None
    corner = np.maximum(wall, wall.T)
    points = np.vstack([points, points[:, [1, 0, 2]]])
    standing = Standing(points=points, rustles=np.zeros(len(points)))
    alignment = Alignment(standing=standing, closeness=corner)
    covariance = offset_covariance(alignment, alignment.here)
    assert covariance is not None
    assert np.sqrt(np.diag(covariance)).max() < 0.5
