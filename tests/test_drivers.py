"""Drivers as recorded and vehicles that bend, on traces written by hand instead of by SUMO."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from simulation import traffic
from simulation.demand import ALL_KINDS, KINDS
from simulation.network import Lane, RoadNetwork, Turn
from simulation.presets import DRIVERS
from simulation.terrain import Terrain

LEVEL = Terrain(origin=(0.0, 0.0))
WIDTH_M, RADIUS_M = 3.25, 12.0
PACE_M = 0.7  # a step at 50 km/h


def band(kind, name, line, **more):
    """A lane or a turn along a line."""
    along = np.gradient(line, axis=0)
    along = along / np.hypot(*along.T)[:, None]
    left = WIDTH_M / 2.0 * np.column_stack([-along[:, 1], along[:, 0]])
    return band_of(kind, name, line, left, **more)


def band_of(kind, name, line, left, **more):
    return kind(id=name, centre=line, left=line + left, right=line - left, speed_limit=14.0, **more)


def streets(count: int) -> RoadNetwork:
    """Streets of two lanes eastward; the left one turns left, by a quarter circle, to the north."""
    lanes, turns = [], []
    quarter = np.linspace(0.0, np.pi / 2.0, 40)
    bend = RADIUS_M * np.column_stack([np.sin(quarter), 1.0 - np.cos(quarter)])
    for k in range(count):
        for index in (0, 1):
            y = 60.0 * k + WIDTH_M * index
            line = np.column_stack([np.arange(0.0, 121.0, 3.0), np.full(41, y)])
            lanes.append(band(Lane, f"s{k}_{index}", line, edge=f"s{k}", index=index))
        start = np.array([120.0, 60.0 * k + WIDTH_M])
        away = np.column_stack([np.full(11, RADIUS_M), RADIUS_M + np.arange(0.0, 31.0, 3.0)])
        lanes.append(band(Lane, f"n{k}_0", start + away, edge=f"n{k}", index=0))
        ends = {"source": f"s{k}_1", "target": f"n{k}_0", "signal": "", "direction": "l"}
        turns.append(band(Turn, f"t{k}_0", start + bend, **ends))
    bands = [*lanes, *turns]
    return RoadNetwork(
        lanes={b.id: b for b in lanes},
        turns={b.id: b for b in turns},
        spans={b.id: (b.id, 0.0, 1.0) for b in bands},
        lengths={b.id: float(np.hypot(*np.diff(b.centre, axis=0).T).sum()) for b in bands},
    )


def trace(network: RoadNetwork, ways: list[tuple[str, tuple[str, ...]]]) -> str:
    """SUMO's floating-car data of vehicles, each a kind and the lanes it drives, at 50 km/h."""
    steps: dict[int, list[str]] = {}
    for number, (kind, lanes) in enumerate(ways):
        ends = np.cumsum([0.0, *(network.lengths[name] for name in lanes)])
        for step, s in enumerate(np.arange(0.1, ends[-1], PACE_M)):
            k = int(np.searchsorted(ends, s)) - 1
            steps.setdefault(step, []).append(
                f'<vehicle id="{number}" type="{kind}" lane="{lanes[k]}" pos="{s - ends[k]:.3f}" '
                f'speed="{PACE_M / 0.05}"/>'
            )
    rows = (f'<timestep time="{0.05 * k:.2f}">{"".join(v)}</timestep>' for k, v in steps.items())
    return f"<fcd>{''.join(rows)}</fcd>"


def drive(monkeypatch, tmp_path, network, ways, keeping, kinds=KINDS):
    """The traffic of a hand-written trace."""
    text = trace(network, ways)
    monkeypatch.setattr(
        traffic, "run_demand", lambda _, path, **__: path.write_text(text, encoding="utf-8")
    )
    return traffic.simulate_traffic(
        tmp_path / "none.net.xml", network, flows=[], kinds=kinds, start=0.0, duration_s=16.0,
        warm_up_s=0.0, seed=4, keeping=keeping,
    )  # fmt: skip


STREETS, CARS = 14, 10


@pytest.fixture(scope="module")
def offsets(tmp_path_factory) -> pd.DataFrame:
    """How far left of their lanes' middles cars drive: lane, car, place along it, offset."""
    network = streets(STREETS)
    ways = [
        ("car", lanes)
        for k in range(STREETS)
        for lanes in ((f"s{k}_0",), (f"s{k}_1", f"t{k}_0", f"n{k}_0"))
        for _ in range(CARS)
    ]
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("trace")
        made = drive(patch, folder, network, ways, DRIVERS["as recorded"])
    parts = []
    for car, (_, lanes) in enumerate(ways):
        place = made.centre[:, car]
        place = place[np.isfinite(place[:, 0])]
        for name in lanes:
            centre = network.bands[name].centre
            near = np.hypot(*np.moveaxis(place[:, None] - centre, -1, 0))
            vertex = near.argmin(axis=1)
            along = np.gradient(centre, axis=0)[vertex]
            gap = place - centre[vertex]
            aside = (along[:, 0] * gap[:, 1] - along[:, 1] * gap[:, 0]) / np.hypot(*along.T)
            inner = (vertex > 3) & (vertex < len(centre) - 4) & (near.min(axis=1) < 4.0)
            parts.append(pd.DataFrame({"lane": name, "car": car, "off": aside})[inner])
    return pd.concat(parts)


def test_drivers_are_off_the_middle_as_recorded(offsets):
    cars = offsets.groupby(["lane", "car"])["off"].mean().reset_index()
    straight = cars[cars["lane"].str.startswith("s")].groupby("lane")["off"]
    turning = cars[cars["lane"].str.startswith("t")].groupby("lane")["off"]
    low, middle, high = straight.mean().quantile([0.1, 0.5, 0.9])
    assert -0.35 < low < -0.05
    assert -0.1 < middle < 0.2
    assert 0.1 < high < 0.55
    assert 0.2 < turning.mean().std() < 0.45
    assert 0.3 < np.sqrt(straight.var().mean()) < 0.5
    assert 0.25 < np.sqrt(turning.var().mean()) < 0.5
    assert 0.05 < (offsets["off"].abs() > 1.0).mean() < 0.15


def test_bends_are_cut(offsets):
    means = offsets.groupby("lane")["off"].mean()
    turning = means[means.index.str.startswith("t")].mean()
    assert turning - means[means.index.str.startswith("s")].mean() > 0.15


def test_some_drive_on_the_line_between_two_lanes(monkeypatch, tmp_path):
    network = streets(1)
    ways = [("car", (name,)) for name in ("s0_0", "s0_1", "n0_0")]
    keeping = replace(DRIVERS["textbook"], driver_m=0.0, wander_m=0.0)
    plain, astride = (
        drive(monkeypatch, tmp_path, network, ways, k)
        for k in (keeping, replace(keeping, straddling=1.0))
    )
    right, left, alone = np.nanmean(astride.centre - plain.centre, axis=0)
    assert right == pytest.approx([0.0, WIDTH_M / 2.0], abs=0.02)
    assert left == pytest.approx([0.0, -WIDTH_M / 2.0], abs=0.02)
    assert alone == pytest.approx([0.0, 0.0], abs=0.02)


def test_drivers_go_round_what_stands_and_come_back(monkeypatch, tmp_path):
    network = streets(1)
    keeping = replace(
        DRIVERS["textbook"], driver_m=0.0, wander_m=0.0, round_m=1.2, round_every_m=10.0
    )
    made = drive(monkeypatch, tmp_path, network, [("car", ("s0_0",))] * 40, keeping)
    off = made.centre[..., 1]
    farthest = np.nanmax(np.abs(off), axis=0)
    assert np.median(farthest) == pytest.approx(1.2, abs=0.3)
    assert np.nanmean(np.abs(off) < 0.1) > 0.05
    assert np.nanmax(np.abs(np.diff(off, axis=0))) < 0.15 * PACE_M  # no jump aside


# vehicles that bend


def test_a_trailer_follows_the_way_of_its_tractor(monkeypatch, tmp_path):
    network, keeping = streets(1), replace(DRIVERS["textbook"], driver_m=0.0, wander_m=0.0)
    way = ("s0_1", "t0_0", "n0_0")
    made = drive(
        monkeypatch, tmp_path, network, [("articulated", way), ("car", way)], keeping, ALL_KINDS
    )
    assert made.kind == ("articulated", "articulated", "car")
    assert list(made.couplings) == [1]
    assert made.couplings[1].drawn_by == 0
    table = made.table(LEVEL)
    truck = table[table["kind"] == "articulated"]
    assert set(table["id"]) == {0, 2}
    assert (truck.groupby("t")["part"].apply(list).map(tuple) == (0, 1)).all()
    assert set(truck["whole_length"]) == {16.5}
    assert set(table.loc[table["id"] == 2, "whole_length"]) == {4.5}
    bend = made.heading[:, 0] - made.heading[:, 1]
    assert np.nanmax(bend) > np.radians(25.0)
    assert np.nanmin(bend) > -1e-6  # the trailer is always behind in a left turn
    straight = truck[truck["easting"] < 100.0]
    tractor, trailer = (straight[straight["part"] == k] for k in (0, 1))
    front = tractor["easting"].to_numpy() + 3.0
    rear = trailer.loc[trailer["t"].isin(tractor["t"]), "easting"].to_numpy() - 13.6 / 2.0
    assert front[:100] - rear[:100] == pytest.approx(16.5, abs=0.01)


def test_a_radar_knows_all_bodies_and_kinds(monkeypatch, tmp_path):
    made = drive(
        monkeypatch, tmp_path, streets(1), [("road_train", ("s0_0",)), ("motorcycle", ("s0_1",))],
        DRIVERS["textbook"], ALL_KINDS,
    )  # fmt: skip
    now = made.at(3.0)
    assert now.kind.tolist() == ["road_train", "road_train", "motorcycle"]
    assert now.size[:, 0].tolist() == [9.3, 7.5, 2.2]
    assert now.where(now.kind == "motorcycle").number.tolist() == [2]
