"""Pictures: starts and ends on the plan as in the paper's Fig. 3, curves, calibration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from curves import CURVES, WAYS
from places import ORIGIN, read_ground
from scipy.stats import chi2
from table import PAPER, SENSORS
from trials import METHODS, Result

import gis_radar as gr

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

INK, SOFT, ROAD, PAVED = "#22262b", "#8a929c", "#c3c9d1", "#eceff2"
COLOURS = {"lane": "#1766b0", "icp": "#d9641a"}
WAY_COLOURS = dict(zip(WAYS, ("#1766b0", "#63a6d8", "#d9641a"), strict=True))
NAMES = {"lane": "ours (lane)", "icp": "the paper's (icp)"}
LOW_M, HIGH_M, CLOSE_M = 12.0, 22.0, 1.6  # room for the close-up
DPI = 130

plt.rcParams.update(
    {
        "font.size": 9, "axes.edgecolor": SOFT, "axes.labelcolor": INK, "text.color": INK,
        "xtick.color": SOFT, "ytick.color": SOFT, "axes.spines.top": False,
        "axes.spines.right": False, "legend.frameon": False, "axes.titlesize": 10,
    }
)  # fmt: skip


def draw_town(folder: Path, path: Path) -> None:
    """Draw the town with its sensors, both sets."""
    fig, ax = plt.subplots(figsize=(8.6, 7.4), layout="constrained")
    _roads(ax, folder)
    for set_name, colour, reach in (("DY", COLOURS["lane"], 55.0), ("DO", COLOURS["icp"], 45.0)):
        for sensor in SENSORS:
            pose = gr.read_pose(folder / f"{set_name}_{sensor}.json")
            x, y = pose.position[:2] - ORIGIN
            turn = np.radians(pose.yaw + np.linspace(-60.0, 60.0, 30))
            fan = np.column_stack([x + reach * np.cos(turn), y + reach * np.sin(turn)])
            ax.fill(*np.vstack([[x, y], fan]).T, color=colour, alpha=0.22, lw=0)
            ax.plot(x, y, "o", ms=4, color=INK)
            if set_name == "DY":
                ax.annotate(sensor, (x, y), (5, 6), textcoords="offset points", weight="bold")
    handles = [Rectangle((0, 0), 1, 1, color=COLOURS[m], alpha=0.3) for m in METHODS]
    labels = ["DY: alike, other yaw", "DO: free roll, pitch, yaw"]
    ax.legend(handles, labels, loc="lower right")
    ax.set(xlabel="m east", ylabel="m north", title="The town and what its sensors see")
    _save(fig, path)


def draw_starts(folder: Path, set_name: str, results: Sequence[Result], path: Path) -> None:
    """Draw starts, ends and truth of every sensor of a set, and the ends once more, close up."""
    fig, axes = plt.subplots(2, 3, figsize=(12.6, 8.8), layout="constrained")
    for ax, sensor in zip(axes.flat, SENSORS, strict=True):
        pose = gr.read_pose(folder / f"{set_name}_{sensor}.json")
        mine = [r for r in results if r.trial.name == f"{set_name}_{sensor}"]
        _panel(ax, folder, pose, mine)
    handles = [
        Line2D([], [], marker="*", ms=12, ls="", color=INK, label="truth"),
        Line2D([], [], marker="o", ms=5, ls="", mfc="none", mec=SOFT, label="starts"),
        *(
            Line2D([], [], marker="o", ms=6, ls="", color=COLOURS[m], label=f"ends, {NAMES[m]}")
            for m in METHODS
        ),
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=4)
    fig.suptitle(f"Set {set_name}: where localization starts and where it ends", weight="bold")
    _save(fig, path)


def _panel(ax: Axes, folder: Path, pose: gr.Pose, results: Sequence[Result]) -> None:
    here = pose.position[:2]
    _roads(ax, folder, here, 2.0 * HIGH_M)
    close = ax.inset_axes((0.66, 0.66, 0.34, 0.34))
    close.set_facecolor("white")
    parts = []
    for method in METHODS:
        mine = [r for r in results if r.trial.method == method]
        starts = np.array([r.trial.offset for r in mine]).reshape(-1, 2)
        ends = np.array([r.error[:2] for r in mine if not r.refused]).reshape(-1, 2)
        for begin, result in zip(starts, mine, strict=True):
            if method == "lane" and not result.refused:
                ax.plot(*np.array([begin, result.error[:2]]).T, color=SOFT, lw=0.35, alpha=0.5)
        ax.plot(*starts.T, "o", ms=3.4, mfc="none", mec=SOFT, mew=0.7)
        for where, size in ((ax, 4.0), (close, 4.5)):
            # on top: whichever has the smaller spread hides least
            order = 5 if method == "lane" else 4
            where.plot(
                *ends.T, "o", ms=size, color=COLOURS[method], alpha=0.55, mew=0, zorder=order
            )
        right = sum(r.right for r in mine)
        parts.append(f"{method} {right} of {len(mine)} right")
    for where, size in ((ax, 12), (close, 8)):
        where.plot(0, 0, "*", ms=size, color=INK, mec="white", mew=0.8, zorder=6)
    turn = np.radians(pose.yaw)
    ax.annotate("", (7 * np.cos(turn), 7 * np.sin(turn)), (0, 0),
                arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.0})  # fmt: skip
    ax.set(xlim=(-LOW_M, HIGH_M), ylim=(-LOW_M, HIGH_M), aspect="equal")
    ax.set_title(f"{pose.sensor}: {', '.join(parts)}")
    ax.set(xlabel="m east of the truth", ylabel="m north of the truth")
    close.set(xlim=(-CLOSE_M, CLOSE_M), ylim=(-CLOSE_M, CLOSE_M), aspect="equal")
    close.set(xticks=(-1, 0, 1), yticks=(-1, 0, 1))
    close.tick_params(labelsize=6, length=2, pad=1)
    close.spines[["top", "right"]].set_visible(True)
    close.add_patch(Circle((0, 0), 1.0, fill=False, color=SOFT, lw=0.6, ls=":"))


def _roads(
    ax: Axes, folder: Path, middle: Sequence[float] | np.ndarray = ORIGIN, within_m: float = 1e9
) -> None:
    """Draw the lanes around a place, which becomes (0, 0)."""
    for outline in read_ground(folder).roads.lanelets.geometry:
        ring = np.array(outline.exterior.coords)[:, :2] - np.asarray(middle)
        if (np.hypot(*ring.T) < within_m).any():
            ax.fill(*ring.T, color=PAVED, lw=0, zorder=0)
            ax.plot(*ring.T, color=ROAD, lw=0.6, zorder=1)
    ax.set_aspect("equal")


def draw_curves(made: dict[str, Any], path: Path) -> None:
    """Draw for each curve the shares of right and wrong answers, and the median error."""
    fig, axes = plt.subplots(
        2, len(made), figsize=(4.1 * len(made), 6.2), layout="constrained", squeeze=False
    )
    for column, (curve, ways) in enumerate(made.items()):
        top, below = axes[:, column]
        for way, by_value in ways.items():
            x = [float(value) for value in by_value]
            results = list(by_value.values())
            line = {"color": WAY_COLOURS[way], "marker": "o", "ms": 3.5}
            top.plot(x, [100.0 * f["right"] for f in results], lw=1.8, label=way, **line)
            top.plot(x, [100.0 * f["wrong"] for f in results], lw=1.0, ls=":", **line | {"ms": 0})
            below.plot(x, [f["flat_median"] for f in results], lw=1.8, **line)
        below.axhline(PAPER["real site"].flat_mean, color=SOFT, lw=0.8, ls="--")
        top.set(ylim=(-3, 103), ylabel="% of starts" if column == 0 else "")
        below.set(yscale="log", xlabel=CURVES[curve][0], ylim=(0.03, 40.0))
        below.set(ylabel="median 2D error of the answers, m" if column == 0 else "")
        for ax in (top, below):
            ax.grid(color=PAVED, lw=0.8)
    ways_shown = [way for way in WAYS if any(way in ways for ways in made.values())]
    handles = [Line2D([], [], color=WAY_COLOURS[w], lw=1.8, label=w) for w in ways_shown]
    handles += [
        Line2D([], [], color=INK, lw=1.8, label="right"),
        Line2D(
            [],
            [],
            color=INK,
            lw=1.0,
            ls=":",
            label="wrong (the rest: no answer, or said not to be fixed)",
        ),
        Line2D([], [], color=SOFT, lw=0.8, ls="--", label="the paper's mean at its real site"),
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=6)
    _save(fig, path)


def draw_calibration(nees: Iterable[float], path: Path) -> None:
    """Draw how squared errors in units of the covariance are spread, and how they should be."""
    found = np.sort(np.fromiter((v for v in nees if np.isfinite(v)), dtype=np.float64))
    fig, ax = plt.subplots(figsize=(5.2, 3.8), layout="constrained")
    x = np.geomspace(0.3, 200.0, 300)
    ax.plot(x, 100.0 * chi2.cdf(x, 6), color=SOFT, lw=1.4, label="chi-squared, 6 dof")
    share = 100.0 * (np.arange(len(found)) + 0.5) / len(found)
    ax.step(found, share, color=COLOURS["lane"], lw=1.8, label=f"{len(found)} answers")
    ax.set(xscale="log", xlim=(0.3, 200.0), ylim=(0, 100))
    ax.set(xlabel="squared error in units of the covariance (NEES)", ylabel="% below")
    ax.grid(color=PAVED, lw=0.8)
    ax.legend(loc="lower right")
    _save(fig, path)


def _save(fig: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=DPI)
    plt.close(fig)
