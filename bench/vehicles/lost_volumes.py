"""Why volumes by lane are off: each front too many or missing at a lane's line, by its cause.

    python bench/vehicles/lost_volumes.py --scene town-781,tee-783

Lines within 100 m of a radar, in steps in which they truly are visible; true poses. A true front
and a found one are one where they cross a line within 2 s. Of the others each has a cause, and a
table says how far volumes by lane would be off without it (what is missing added, what is too much
taken away).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from ablation import Kept
from lane_volumes import near_lines, true_crossings
from passages import lanes_of
from scenes import SceneFiles, scene
from scipy.optimize import linear_sum_assignment
from tracks import COLUMNS, Scored, by_step, compared, similarity

import gis_radar as gr
from gis_radar.base import Integers, step_of
from gis_radar.measures import FrontStates, LaneNetwork, StepGrid
from gis_radar.measures.lane_fronts import crossings

WITHIN_STEPS = 40  # 2 s
HALF = 10  # steps between states that are compared
OVERLAPS = 0.1  # intersection over union, above which a track is on a vehicle
BESIDE_M, BESIDE_RAD = 9.0, 0.5  # lines of the lanes of one approach
HEAVY_M = 7.0
NEAR_M, BEFORE_END_M = 100.0, 1.0  # of a radar; of a lane's end
NEAR_S = 2.5  # detections count so long before and after a line


@dataclass(kw_only=True, eq=False)
class Lost:
    """What was found in a scene beside what is true."""

    site: SceneFiles
    found: list[Any]
    points: Any = field(repr=False)  # easting, northing, step of all detections

    @cached_property
    def network(self) -> LaneNetwork:
        """The lanes, with their stop lines."""
        table = gr.read_map(self.site.map).lanes()
        stops = dict(zip(table["lane"], table["stop_line_m"], strict=True))
        network = LaneNetwork.of(self.site.tiles(), stops)
        lines = self._lines(network)
        return replace(network, line_m=lines)

    def _lines(self, network: LaneNetwork) -> Any:
        """Return the lines: where a map has none, within the stretch in sight near a radar.

        At its end before a junction, else in its middle; that of a lane of some hundred metres
        is not near a radar.
        """
        tiles = self.site.tiles().set_index("tile_id").geometry
        middle = tiles.centroid.loc[network.tile_id]
        place = np.column_stack([middle.x, middle.y])
        eyes = np.array([pose.position[:2] for pose in self.site.poses])
        far = np.hypot(*np.moveaxis(place[:, None] - eyes, -1, 0)).min(axis=1)
        seen = np.isin(network.tile_id, self.site.truth().tile_id) & (far < NEAR_M)
        seen &= network.tile_m < network.length_m[network.tile_lane] - BEFORE_END_M
        lines = network.line_m.copy()
        for k in np.flatnonzero(~network.has_stop_line):
            mine = network.tile_m[seen & (network.tile_lane == k)]
            ahead = any(network.connector[each] for each in network.after[int(k)])
            lines[k] = np.quantile(mine, 1.0 if ahead else 0.5) if len(mine) else lines[k]
        return lines

    @cached_property
    def states(self) -> Any:
        """States of the tracks, `COLUMNS` and the lane."""
        tracks = pd.concat([each.tracks for each in self.found], ignore_index=True)
        length = pd.concat([each.vehicles for each in self.found]).set_index("vehicle")
        ref = tracks["lanelet_id"].fillna(-1).to_numpy(np.int64)
        lane, along = self.network.place(ref, tracks["s_m"].to_numpy(float))
        return tracks.assign(
            length=tracks["vehicle"].map(length["length_m"]),
            heading=np.radians(tracks["heading"]), lane=lane, along=along,
        )  # fmt: skip

    @cached_property
    def scored(self) -> Scored:
        """States each half second, matched by overlap: `match` is the other side's row."""
        site = self.site
        both = compared(site.tiles(), site.truth(), site.traffic(), self.states)
        true, given = both.true.assign(match=-1), both.given.assign(match=-1, on=-1)
        for one, other in by_step(both):
            if len(one) and len(other):
                alike = similarity(one[list(COLUMNS)], other[list(COLUMNS)])
                row, column = linear_sum_assignment(-alike)
                good = alike[row, column] > OVERLAPS
                row, column = row[good], column[good]
                true.loc[one.index[row], "match"] = other.index[column].to_numpy()
                given.loc[other.index[column], "match"] = one.index[row].to_numpy()
                on = alike.argmax(axis=0)
                touch = alike.max(axis=0) > 0.02
                given.loc[other.index[touch], "on"] = one.index[on[touch]].to_numpy()
        return Scored(true=true, given=given)

    def visible(self, lane: Integers, step: Integers) -> Any:
        """Tell whether the lines of lanes are truly visible in steps."""
        truth, network = self.site.truth(), self.network
        tile = network.tile_id[network.tile_at(np.arange(len(network.lane)), network.line_m)]
        row = np.minimum(np.searchsorted(truth.tile_id, tile[lane]), len(truth.tile_id) - 1)
        column = step - truth.first_step
        inside = (column >= 0) & (column < truth.visible.shape[1])
        shown = truth.visible[row, np.clip(column, 0, truth.visible.shape[1] - 1)]
        return inside & shown & (truth.tile_id[row] == tile[lane])

    @cached_property
    def fronts(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return true and found fronts over near lines: `lane vehicle step`, matched by `pair`."""
        network = self.network
        near = [k for k in near_lines(self.site, network) if not network.connector[k]]
        true = true_crossings(self.site, network)
        since = true["time"] - pd.Timestamp(0, tz="UTC")
        step = step_of(np.asarray(since / pd.Timedelta(seconds=1), np.float64) + 1e-6)
        lane = np.searchsorted(network.lane, true["lane"].to_numpy())
        true = pd.DataFrame({"lane": lane, "vehicle": true["vehicle"], "step": step})
        t = self.states.sort_values(["vehicle", "step"], ignore_index=True)
        fronts = FrontStates(
            vehicle=t["vehicle"].to_numpy(),
            step=t["step"].to_numpy(),
            lane=t["lane"].to_numpy(),
            along_m=t["along"].to_numpy(),
            speed=t["speed"].to_numpy(),
            seen=t["seen"].to_numpy(),
        )
        truth = self.site.truth()
        grid = StepGrid(begin=truth.first_step, steps=truth.visible.shape[1], count=1)
        crossed = crossings(fronts, fronts.moves(network), network, grid)
        given = pd.DataFrame(
            {"lane": crossed.lane, "vehicle": crossed.vehicle, "step": crossed.step}
        )
        sides = []
        for table in (true, given):
            mine = table["lane"].isin(near) & self.visible(
                table["lane"].to_numpy(), table["step"].to_numpy()
            )
            sides.append(table[mine].reset_index(drop=True).assign(pair=-1, cause=""))
        same = sides[0]["lane"].to_numpy()[:, None] == sides[1]["lane"].to_numpy()
        one, other = sides
        _pair(one, other, same, WITHIN_STEPS)
        return one, other

    def beside(self) -> Any:
        """Return which lines are of lanes side by side."""
        network = self.network
        tile = network.tile_id[network.tile_at(np.arange(len(network.lane)), network.line_m)]
        table = lanes_of(self.site.tiles(), gr.read_map(self.site.map))
        at = np.argsort(table.tile_id)[np.searchsorted(np.sort(table.tile_id), tile)]
        apart = np.hypot(*np.moveaxis(table.middle[at][:, None] - table.middle[at], -1, 0))
        turn = np.angle(np.exp(1j * (table.heading[at][:, None] - table.heading[at])))
        return (apart < BESIDE_M) & (np.abs(turn) < BESIDE_RAD)

    def causes(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return the fronts with their causes."""
        true, given = self.fronts
        beside = self.beside()
        also = beside[true["lane"].to_numpy()[:, None], given["lane"].to_numpy()]
        free = (true["pair"].to_numpy() < 0)[:, None] & (given["pair"].to_numpy() < 0)
        before = true["pair"].to_numpy().copy(), given["pair"].to_numpy().copy()
        _pair(true, given, also & free, WITHIN_STEPS)
        for table, was in ((true, before[0]), (given, before[1])):
            table.loc[(table["pair"] >= 0) & (was < 0), "cause"] = "lane"
        for k in np.flatnonzero(true["pair"] < 0):
            true.loc[k, "cause"] = self._why_missing(int(true["vehicle"][k]), int(true["step"][k]))
        for k in np.flatnonzero(given["pair"] < 0):
            given.loc[k, "cause"] = self._why_false(int(given["vehicle"][k]), int(given["step"][k]))
        return true, given

    def _why_missing(self, vehicle: int, step: int) -> str:
        rows = self._of_true(vehicle)
        found = rows["step"].to_numpy()[rows["match"].to_numpy() >= 0]
        hit = self.detections(vehicle, step)
        few = " (unseen)" if hit < 3 else " (seen)"
        if len(found) == 0:
            return "never" + few
        if np.abs(found - step).min() <= 2 * HALF:
            return "there"
        if (found > step).all():
            return "late" + few
        return ("early" if (found < step).all() else "gap") + few

    def _why_false(self, vehicle: int, step: int) -> str:
        given, true = self.scored.given, self.scored.true
        rows = self._of_given(vehicle)
        at = rows.iloc[np.abs(rows["step"].to_numpy() - step).argmin()] if len(rows) else None
        if at is None or at["on"] < 0:
            return "nobody" if len(rows) == 0 or (rows["match"] >= 0).mean() < 0.3 else "runs on"
        on = true.loc[at["on"]]
        if on["match"] >= 0 and given.loc[on["match"], "vehicle"] != vehicle:
            return "lorry as two" if on["length"] > HEAVY_M else "double"
        return "place"

    @cached_property
    def _by_true(self) -> Any:
        return dict(list(self.scored.true.groupby("vehicle")))

    @cached_property
    def _by_given(self) -> Any:
        return dict(list(self.scored.given.groupby("vehicle")))

    def _of_true(self, vehicle: int) -> Any:
        return self._by_true.get(vehicle, self.scored.true.iloc[:0])

    def _of_given(self, vehicle: int) -> Any:
        return self._by_given.get(vehicle, self.scored.given.iloc[:0])

    def detections(self, vehicle: int, step: int) -> int:
        """Return how many detections lie on a true vehicle around a step."""
        points, steps = self.points
        rows = self._traffic.get(vehicle)
        reach = int(NEAR_S * 20)
        rows = rows[(rows["step"] - step).abs() <= reach]
        low, high = np.searchsorted(steps, [step - reach, step + reach + 1])
        at = np.searchsorted(rows["step"].to_numpy(), steps[low:high])
        at = np.minimum(at, len(rows) - 1)
        near = rows.iloc[at]
        away = points[low:high] - near[["easting", "northing"]].to_numpy()
        c, s = np.cos(near["heading"].to_numpy()), np.sin(near["heading"].to_numpy())
        along, aside = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
        on = np.abs(along) < near["length"].to_numpy() / 2.0 + 0.5
        return int((on & (np.abs(aside) < near["width"].to_numpy() / 2.0 + 0.4)
                    & (near["step"].to_numpy() == steps[low:high])).sum())  # fmt: skip

    @cached_property
    def _traffic(self) -> Any:
        return dict(list(self.site.traffic().states.groupby("vehicle")))

    def volumes(self) -> pd.DataFrame:
        """Return causes with their numbers, and how far volumes are off without them."""
        true, given = self.causes()
        rows = [("all", 0, 0, *self._off(true, given))]
        for cause in sorted({*true["cause"], *given["cause"]} - {""}):
            missing, false = true["cause"] == cause, given["cause"] == cause
            off = self._off(true[~missing], given[~false])
            rows.append((cause, int(missing.sum()), int(false.sum()), *off))
        return pd.DataFrame(rows, columns=["cause", "missing", "false", "off", "bias"])

    def _off(self, true: pd.DataFrame, given: pd.DataFrame) -> tuple[float, float]:
        count = max(len(self.fronts[0]), 1)
        one, other = (
            np.bincount(t["lane"], minlength=len(self.network.lane)) for t in (true, given)
        )
        return float(np.abs(one - other).sum()) / count, float((other - one).sum()) / count


def _pair(true: pd.DataFrame, given: pd.DataFrame, may: Any, within: int) -> None:
    """Pair what may be one, by least difference in time."""
    if len(true) == 0 or len(given) == 0:
        return
    apart = np.abs(true["step"].to_numpy()[:, None] - given["step"].to_numpy()).astype(float)
    apart = np.where(may & (apart <= within), apart, 1e6)
    row, column = linear_sum_assignment(apart)
    good = apart[row, column] < 1e6
    true.loc[true.index[row[good]], "pair"] = given.index[column[good]].to_numpy()
    given.loc[given.index[column[good]], "pair"] = true.index[row[good]].to_numpy()


def detections_of(kept: Kept) -> Any:
    """Return (easting, northing) and steps of all detections."""
    blocks = [block for hour in kept.blocks for _, block in hour]
    points = np.concatenate([each.detections.points[:, :2] for each in blocks])
    points = points + kept.hours[0][1]["graph"].origin
    steps = np.concatenate([step_of(each.detections.time) for each in blocks])
    once = np.unique(np.column_stack([steps, points]), axis=0)  # blocks overlap
    return once[:, 1:], once[:, 0].astype(np.int64)


def main() -> None:
    """Print the table of each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", required=True)
    for name in parser.parse_args().scene.split(","):
        site = scene(name)
        kept = Kept.of(site)
        found, _ = kept.vehicles("as-is")
        lost = Lost(site=site, found=found, points=detections_of(kept))
        print(name, len(lost.fronts[0]), "fronts")
        print(lost.volumes().to_string(index=False, float_format="{:.3f}".format), flush=True)


if __name__ == "__main__":
    main()
