"""All benchmarks in one table: ours, the peer's, the ratio; and what got worse.

Figures are read from the JSON that each benchmark leaves in `out`, set beside the peer of the same
run or a target, and compared with those of `bench/accepted.json`. Exit code 1 where one that a
user relies on got worse by more than it changes by chance.

Example: ``python bench/summary.py``; with ``--accept`` the figures become the accepted ones, with
``--into docs/speed.md`` those of speed and memory go between that page's marks *speed*.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pages
from dataset import TARGETS
from simulated import ROOT

ACCEPTED = ROOT / "bench" / "accepted.json"
MARK = "speed"
TARGET = "(target)"  # what stands for a peer where there is none
# By so much do figures differ from run to run: processor times of shared machines most.
TIMES, SHARES, SAME = 0.25, 0.05, 0.02
LEAST_PERCENT, LEAST_M, LEAST_DEG = 0.1, 0.02, 0.02  # smaller differences tell nothing


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of a benchmark.

    Parameters
    ----------
    what : str
        What is measured.
    ours : float
        The figure.
    unit : str
        Its unit.
    peer, peer_name : float or None, str
        What it is set beside: a peer in the same run, or a target.
    more_is_better : bool
        Whether a higher figure is a better one.
    chance, least : float
        By which part of it the figure differs from run to run, and by how much at least.
    size : str
        How large the work was.
    """

    what: str
    ours: float
    unit: str = ""
    peer: float | None = None
    peer_name: str = ""
    more_is_better: bool = False
    chance: float = SHARES
    least: float = 0.0
    size: str = ""

    @property
    def ratio(self) -> float | None:
        """Ours over the peer's."""
        return None if not self.peer else self.ours / self.peer

    @property
    def name(self) -> str:
        """What is measured, with the size of the work."""
        return f"{self.what}, {self.size}" if self.size else self.what

    def change(self, accepted: float) -> float:
        """Return by how much more than chance the figure got worse; negative where better, or 0."""
        more = accepted - self.ours if self.more_is_better else self.ours - accepted
        within = max(self.chance * abs(accepted), self.least)
        return float(np.sign(more) * max(abs(more) - within, 0.0))


def main() -> None:
    """Print the table of all that was measured, and what got worse."""
    arguments = _arguments()
    figures = list(collected(arguments.out))
    if not figures:
        sys.exit(f"{arguments.out}: no benchmark left its figures here: `make bench` runs all")
    accepted = json.loads(arguments.accepted.read_text()) if arguments.accepted.exists() else {}
    text = table(figures, accepted)
    print(text)
    kept = {
        each.what: {"ours": each.ours, "peer": each.peer, "unit": each.unit} for each in figures
    }
    arguments.json.write_text(json.dumps(kept, indent=1) + "\n")
    if arguments.into is not None:
        pages.put(arguments.into, {MARK: speed(figures)})
    if arguments.accept:
        known = accepted | {each.what: round(each.ours, 6) for each in figures}
        arguments.accepted.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
    elif lines := worse(figures, accepted):
        sys.exit("\n".join(lines))


def table(figures: Sequence[Figure], accepted: Mapping[str, float]) -> str:
    """Return the figures as Markdown, beside peers and the accepted ones."""
    lines = ["| what | ours | beside | ratio | accepted | change |", "|---|---|---|---|---|---|"]
    for each in figures:
        beside = "" if each.peer is None else f"{_short(each.peer, each.unit)} {each.peer_name}"
        ratio = "" if each.ratio is None else f"{each.ratio:.2f}"
        before, change = "", ""
        if each.what in accepted:
            before = _short(accepted[each.what], each.unit)
            more = each.change(accepted[each.what])
            change = "" if more == 0.0 else ("worse" if more > 0.0 else "better")
        ours = _short(each.ours, each.unit)
        lines.append(f"| {each.name} | {ours} | {beside} | {ratio} | {before} | {change} |")
    return "\n".join(lines)


def speed(figures: Sequence[Figure]) -> str:
    """Return what takes time or memory as Markdown."""
    lines = ["| work | figure | beside |", "|---|---|---|"]
    for each in (figure for figure in figures if figure.chance == TIMES):
        beside = ""
        if each.peer is not None and each.peer_name == TARGET:
            beside = f"{_short(each.peer, each.unit)} {TARGET}"
        elif each.ratio is not None:
            beside = f"{each.ratio:.3g} x {each.peer_name}"
        lines.append(f"| {each.name} | {_short(each.ours, each.unit)} | {beside} |")
    return "\n".join(lines)


def worse(figures: Sequence[Figure], accepted: Mapping[str, float]) -> list[str]:
    """Return a line for each figure that got worse by more than chance, or was not measured."""
    measured = {each.what for each in figures}
    return [f"{what}: not measured" for what in accepted if what not in measured] + [
        f"{each.what}: {_short(each.ours, each.unit)}, accepted is "
        f"{_short(accepted[each.what], each.unit)}"
        for each in figures
        if each.what in accepted and each.change(accepted[each.what]) > 0.0
    ]


def collected(out: Path) -> Iterator[Figure]:
    """Yield the figures of all benchmarks that left some."""
    for name, read in READERS.items():
        path = out / name
        if path.exists():
            yield from read(json.loads(path.read_text()))


def _assignment(report: Mapping[str, Any]) -> Iterator[Figure]:
    rates = report["million_points_per_s"]
    for peer in (each for each in rates if each != "grid"):
        yield Figure(
            what=f"points to tiles in one thread, beside {peer}", ours=rates["grid"],
            unit="M points/s", peer=rates[peer], peer_name=peer, more_is_better=True,
            chance=TIMES, size=f"{report['tiles']:,} tiles",
        )  # fmt: skip


def _tiles(report: Mapping[str, Any]) -> Iterator[Figure]:
    yield Figure(
        what="a million tiles, made and written as GeoPackage", ours=report["total_s"], unit="s",
        peer=report["bare_writing_s"], peer_name="the bare writing of the polygons", chance=TIMES,
    )  # fmt: skip


def _dataset(report: Mapping[str, Any]) -> Iterator[Figure]:
    for what, (sense, bound) in TARGETS.items():
        if what in report:
            yield Figure(
                what=what, ours=report[what], unit="", peer=bound, peer_name=TARGET,
                more_is_better=sense == ">=", chance=SHARES if "byte" in what else TIMES,
            )  # fmt: skip
    for name, value in report.items():
        what, _, version = name.rpartition(", ")
        if version == "now" and what not in TARGETS:
            yield Figure(
                what=what, ours=value, unit="", peer=report.get(f"{what}, before"),
                peer_name="before", more_is_better="real time" in what, chance=TIMES,
            )  # fmt: skip


def _mask(report: Mapping[str, Any]) -> Iterator[Figure]:
    time, memory = report["time"], report["memory"]
    yield Figure(
        what="road mask, built-in engine, a scan of 2 M points", ours=time["laspy_s"], unit="s",
        peer=time["reading_s"], peer_name="the bare reading by laspy and lazrs", chance=TIMES,
    )  # fmt: skip
    yield Figure(
        what="memory of the road mask of 20 M points", ours=memory["all_tiles_mib"], unit="MiB",
        peer=memory["one_tile_mib"], peer_name="that of 2 M points", chance=TIMES,
    )  # fmt: skip


def _convert(report: Mapping[str, Any]) -> Iterator[Figure]:
    yield Figure(
        what="capture of a 20 Hz radar with 500 detections a frame to a recording",
        ours=report["long_real_time_ratio"], unit="x real time", more_is_better=True, chance=TIMES,
    )  # fmt: skip
    yield Figure(
        what="memory of `convert` of 600 s", ours=report["long_mib"], unit="MiB",
        peer=report["short_mib"], peer_name="that of 60 s", chance=TIMES,
    )  # fmt: skip


def _clocks(report: Sequence[Mapping[str, Any]]) -> Iterator[Figure]:
    errors = [1000.0 * abs(each["error_s"]) for each in report]
    yield Figure(what="clocks, median error", ours=float(np.median(errors)), unit="ms")


def _sight(report: Mapping[str, Any]) -> Iterator[Figure]:
    for place, row in report.items():
        if place.startswith("two levels"):
            yield Figure(
                what=f"sight, {place}: right", ours=100.0 * row["right"], unit="%", peer=95.0,
                peer_name=TARGET, more_is_better=True, chance=SAME,
            )  # fmt: skip
            continue
        for name, target in (("wrongly_seen", 2.0), ("lost", 3.0)):
            yield Figure(
                what=f"sight, {place}: {name.replace('_', ' ')}", ours=100.0 * row[name], unit="%",
                peer=target, peer_name=TARGET, least=LEAST_PERCENT,
            )  # fmt: skip


def _sizes(report: Mapping[str, Any]) -> Iterator[Figure]:
    size = f"{report['tiles']:,} tiles, {report['intervals']} intervals"
    for what, size_mb in report["heatmap_mb"].items():
        yield Figure(
            what=f"`heatmap.gpkg` of a day, {what}", ours=size_mb, unit="MB", peer=40.0,
            peer_name=TARGET, chance=SAME, size=size,
        )  # fmt: skip
    for site, times in report["projected_times"].items():
        yield Figure(
            what=f"`project` in GeoParquet with lanes, {site}", ours=times, unit="x the recording",
            peer=2.0, peer_name=TARGET, chance=SAME,
        )  # fmt: skip


def _alarm(report: Mapping[str, Any]) -> Iterator[Figure]:
    yield Figure(
        what="false alarms of a sensor at rest, a month, 95 % below",
        ours=report["false, all, whole"]["monthly_95"][1], peer=1.0, peer_name=TARGET,
        chance=SHARES, least=0.1,
    )  # fmt: skip


def _localization(kind: str) -> Any:
    def read(report: Mapping[str, Any]) -> Iterator[Figure]:
        for group, row in report["figures"]["groups"].items():
            if group.endswith(" lane"):
                where = f"pose, {kind}, {group.removesuffix(' lane')}"
                yield Figure(
                    what=f"{where}: 2D mean", ours=row["flat_mean"], unit="m", least=LEAST_M
                )
                yield Figure(
                    what=f"{where}: yaw mean", ours=row["yaw"], unit="deg", least=LEAST_DEG
                )
                yield Figure(
                    what=f"{where}: right", ours=100.0 * row["right"], unit="%",
                    more_is_better=True, chance=SAME,
                )  # fmt: skip

    return read


def _vehicles(report: Mapping[str, Any]) -> Iterator[Figure]:
    for scene, methods in report["scenes"].items():
        found = methods.get("vehicles, found poses", {}).get("occupancy")
        peers = [methods[name]["occupancy"] for name in methods if "Stone Soup" in name]
        if found is None:
            continue
        peer = peers[0] if peers else {}
        yield Figure(
            what=f"occupancy, {scene}: rank", ours=found["rank"], peer=peer.get("rank"),
            peer_name="Stone Soup", more_is_better=True, chance=SAME,
        )  # fmt: skip
        yield Figure(
            what=f"occupancy, {scene}: mean error", ours=found["mae_percent"], unit="% of the time",
            peer=peer.get("mae_percent"), peer_name="Stone Soup",
        )  # fmt: skip


READERS: Mapping[str, Any] = {
    "bench-assignment.json": _assignment,
    "bench-tiles.json": _tiles,
    "bench-dataset.json": _dataset,
    "bench-mask.json": _mask,
    "bench-convert.json": _convert,
    "bench-clocks.json": _clocks,
    "bench-sight.json": _sight,
    "bench-sizes.json": _sizes,
    "bench-alarm.json": _alarm,
    "bench-localization/report_radar_as_recorded_walkers/table-lane.json": _localization(
        "radar as recorded, walkers"
    ),
    "bench-localization/report_drivers_as_recorded/table-lane.json": _localization(
        "drivers as recorded"
    ),
    "bench-vehicles/bench.json": _vehicles,
}


def _short(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".strip() if abs(value) < 1000.0 else f"{value:,.0f} {unit}".strip()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out")
    parser.add_argument("--accepted", type=Path, default=ACCEPTED)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench.json")
    parser.add_argument("--accept", action="store_true", help="take the figures as accepted")
    parser.add_argument("--into", type=Path, metavar="MD", help="page that gets the table")
    return parser.parse_args()


if __name__ == "__main__":
    main()
