"""Result of a scan check: what stands around a sensor, the verdict, and its picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from gis_radar.base import (
    CELL_M,
    Booleans,
    Floats,
    Text,
    axes_or_new,
    label_map,
    legend_below,
    picture_file,
    tr,
)
from gis_radar.calibration.scan.surroundings import TALL_M, LevelFrame, Standing, Structure
from gis_radar.poses import Pose

CONFIRMS, DOUBTS = Text("confirms"), Text("doubts")
UNCLEAR, UNDECIDED = Text("nothing to compare"), Text("undecided")
SHIFT_M = 10.0  # reach, ahead and aside, of the search for better poses

DPI = 216
SIZE_IN = (6.6, 6.6)
MARGIN_M = 12.0
TALLEST_M = 15.0
ON, LEAVES, OFF, SENSOR = "#1e1b6b", "#0e93c9", "#dc2626", "#111827"
BARE, UNSEEN = "#f4f2ec", "#ffffff"
CANOPY, ROOF, TALL = ("#d3e8c4", "#4f9a51"), ("#e6ddd3", "#a8927e"), ("#dfe5d3", "#83997a")
WALL = "#6b5c4f"
RUSTLING = 0.15  # share of a cell's detections that move like leaves, from which on it is leaves
FITS = 0.3  # closeness from which on a cell fits the scan
LINE, LEGEND_LINE = 46, 22  # letters in a line of the title, and of the legend in two columns


@dataclass(frozen=True, kw_only=True)
class PoseOffset:
    """Offset of a pose from the answer, and how well it fits there.

    Parameters
    ----------
    ahead_m, left_m : float
        Shift ahead and to the left, in the direction in which the sensor looks.
    turn_deg : float
        Turn about the sensor, counter-clockwise, -180 to 180.
    score : float
        0 to 1; see :class:`Alignment`.
    """

    ahead_m: float
    left_m: float
    turn_deg: float
    score: float

    @property
    def place(self) -> tuple[float, float, float]:
        """The offset as (ahead in m, left in m, turn in degrees)."""
        return self.ahead_m, self.left_m, self.turn_deg

    @property
    def shift_m(self) -> float:
        """Distance by which the pose is moved, metres."""
        return float(np.hypot(self.ahead_m, self.left_m))

    def words(self) -> str:
        """Return shift and turn as text."""
        return Text("{:.1f} m and {:.1f} deg away", self.shift_m, abs(self.turn_deg))

    def beyond(self, shift_m: float, turn_deg: float) -> bool:
        """Return whether it is moved by `shift_m` or turned by `turn_deg`, or more."""
        return self.shift_m >= shift_m or abs(self.turn_deg) >= turn_deg


@dataclass(frozen=True, kw_only=True, repr=False)
class ScanCheck:
    """Scan check of a pose: what stands around the sensor, compared with a scan, and the verdict.

    The score is the share of what stands (cells of half a metre) that is on canopy and walls of
    the scan. It does not measure height, roll and pitch.

    Parameters
    ----------
    pose : Pose
        The pose that was checked.
    verdict : str
        `confirms`, `doubts`, `undecided` (two places fit alike) or `nothing to compare`.
    reason : str
        The reason for the verdict, in one line.
    score : float
        Score at the pose, 0 to 1; NaN where there was nothing to compare.
    chance : float
        Mean score of all poses up to 10 m away, in all headings.
    best : PoseOffset, optional
        Where the score is highest, near the pose or up to 10 m ahead and aside, in all headings.
    rival : PoseOffset, optional
        The best offset a lane (3 m) or 3 degrees or more away from the pose.
    z_score : float
        By how many standard deviations what stands prefers the pose to `rival`; negative where it
        prefers the rival, infinite where there is none.
    standing : Standing
        What stands, in the level frame of the pose.
    closeness : (n,) array
        Closeness of each standing cell to a structure, 0 to 1; the score is the mean.
    covered : float
        Share of the standing cells over which the scan has points.
    structure : Structure
        The structures of the scan.
    surface : (k, k) array
        Scores at the pose's heading, (ahead, left) every 0.5 m from -10 to 10 m.
    range_m : float
        Slant range of 99.9 % of the recording's detections, metres; 0 without any.
    """

    pose: Pose
    verdict: str
    reason: str
    score: float = float("nan")
    chance: float = float("nan")
    best: PoseOffset | None = None
    rival: PoseOffset | None = None
    z_score: float = float("nan")
    standing: Standing
    closeness: Floats = field(default_factory=lambda: np.empty(0))
    covered: float = float("nan")
    structure: Structure
    surface: Floats = field(default_factory=lambda: np.empty((0, 0)))
    range_m: float

    @property
    def level(self) -> LevelFrame:
        """The frame of the cells and the structure."""
        return LevelFrame(pose=self.pose)

    def __repr__(self) -> str:
        return f"ScanCheck({self.pose.sensor}: {self.verdict}: {self.reason})"

    def figures(self) -> Mapping[str, Any]:
        """Return the figures, ready for JSON.

        `best_east_m`, `best_north_m` and `best_turn_deg` lead from the pose to where the score is
        highest.
        """
        found: dict[str, Any] = {
            "verdict": self.verdict,
            "reason": self.reason,
            "standing_cells": len(self.standing),
            "scan_classified": self.structure.classified,
        }
        if self.best is not None:
            beside = np.array([[self.best.ahead_m, self.best.left_m]])
            east, north = (self.level.to_map(beside)[0] - self.pose.position[:2]).tolist()
            found |= {
                "covered": round(self.covered, 3),
                "score": round(self.score, 3),
                "chance": round(self.chance, 3),
                "best_score": round(self.best.score, 3),
                "best_east_m": round(east, 2),
                "best_north_m": round(north, 2),
                "best_turn_deg": round(self.best.turn_deg, 2),
            }
        if self.rival is not None:
            found |= {"rival_score": round(self.rival.score, 3), "z_score": round(self.z_score, 2)}
        return found

    def draw(self, path: str | Path) -> None:
        """Draw what stands around the pose over the scan's canopy, roofs and walls (PNG).

        Parameters
        ----------
        path : str or Path
            The picture; appears whole or not at all.
        """
        with picture_file(path, SIZE_IN, DPI, tight=True) as figure:
            self.plot(figure.add_subplot())

    def plot(self, ax: Any = None) -> Any:
        """Draw the same into axes.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes in metres of the map; by default those of a new figure.

        Returns
        -------
        matplotlib Axes
        """
        from matplotlib.transforms import Affine2D  # noqa: PLC0415 - where it draws

        ax = axes_or_new(ax, (8.0, 8.0))
        half = len(self.structure.top) // 2 * CELL_M
        place = self.pose.position[:2]
        into_map = Affine2D().rotate_deg(self.pose.yaw).translate(*place)
        ax.imshow(
            _colours(self.structure).transpose(1, 0, 2), origin="lower",
            extent=(-half, half, -half, half), interpolation="nearest",
            transform=into_map + ax.transData,
        )  # fmt: skip
        handles = [*_draw_standing(ax, self), *_kinds(self.structure)]
        ahead = self.pose.R_map_sensor[:2, 0]
        low, high = _window(self)
        tip = place + ahead * float((high - low).max()) / 12.0
        ax.plot(*np.column_stack([place, tip]), color=SENSOR, linewidth=1.5, zorder=5)
        handles.append(
            ax.scatter(
                [place[0]], [place[1]], s=30, color=SENSOR, marker="^", label=tr("sensor"), zorder=5
            )
        )
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        label_map(ax)
        ax.set_title(_title(self))
        legend_below(ax, handles)
        if self.surface.size:
            _draw_surface(ax.inset_axes(_corner(self, low, high)), self)
        return ax


def _title(look: ScanCheck) -> str:
    reason = ";\n".join(fill(part, LINE) for part in tr(look.reason).split("; "))
    verdict = tr(
        "{sensor}, scan check: {verdict}", sensor=look.pose.sensor, verdict=tr(look.verdict)
    )
    return f"{verdict}\n{reason}"


def _colours(structure: Structure) -> Floats:
    """Return the colour of each cell, (n, n, 3)."""
    from matplotlib.colors import to_rgb  # noqa: PLC0415 - where it draws

    over = np.nan_to_num((structure.top - structure.ground - TALL_M) / TALLEST_M, nan=-1.0)
    shade = np.clip(over, 0.0, 1.0)[..., None]
    image = np.where(np.isnan(structure.top)[..., None], to_rgb(UNSEEN), to_rgb(BARE))
    kinds: tuple[tuple[Booleans, tuple[str, str]], ...] = ((over > 0.0, TALL),)
    if structure.classified:
        kinds = ((structure.roof, ROOF), (structure.canopy, CANOPY))
    for which, (light, dark) in kinds:
        colour = (1.0 - shade) * to_rgb(light) + shade * to_rgb(dark)
        image = np.where(which[..., None], colour, image)
    walls = structure.edge & ~structure.canopy
    return np.where(walls[..., None], 0.55 * image + 0.45 * np.array(to_rgb(WALL)), image)


def _kinds(structure: Structure) -> list[Any]:
    from matplotlib.patches import Patch  # noqa: PLC0415 - where it draws

    shown: tuple[tuple[str, str], ...] = (
        (TALL[1], "canopy and roofs"), (WALL, "walls and rims of crowns"),
    )  # fmt: skip
    if structure.classified:
        shown = ((CANOPY[1], "canopy"), (ROOF[1], "roofs"), (WALL, "walls"))
    return [Patch(color=colour, label=tr(label)) for colour, label in shown]


def _draw_standing(ax: Any, look: ScanCheck) -> list[Any]:
    from matplotlib.lines import Line2D  # noqa: PLC0415 - where it draws

    found = look.standing
    if len(found) == 0:
        return []
    east, north = look.level.to_map(found.points[:, :2]).T
    off = look.closeness < FITS if len(look.closeness) else np.zeros(len(found), bool)
    leaves = ~off & (found.rustles > RUSTLING)
    kinds: tuple[tuple[Booleans, str, str, float, str], ...] = (
        (~off & ~leaves, ON, "o", 3.0, "stands"),
        (leaves, LEAVES, "o", 3.0, "moves in place, as leaves do"),
        (off, OFF, "x", 9.0, "stands where the scan shows nothing"),  # a shape for the colour-blind
    )
    handles = []
    for which, colour, marker, size, label in kinds:
        if which.any():
            thin = 0.7 if marker == "x" else 0.0
            ax.scatter(
                east[which], north[which], s=size, color=colour, marker=marker, linewidths=thin,
                zorder=3,
            )  # fmt: skip
            handles.append(
                Line2D(
                    [], [], color=colour, marker=marker, markersize=4, linestyle="",
                    label=fill(tr(label), LEGEND_LINE),
                )
            )  # fmt: skip
    return handles


def _window(look: ScanCheck) -> tuple[Floats, Floats]:
    """Return the corners of the picture, a square around what stands and the sensor."""
    place = look.pose.position[:2]
    if len(look.standing) == 0:
        half = len(look.structure.top) // 2 * CELL_M
        return place - half, place + half
    spots = look.level.to_map(look.standing.points[:, :2])
    low = np.minimum(np.percentile(spots, 0.5, axis=0), place) - MARGIN_M
    high = np.maximum(np.percentile(spots, 99.5, axis=0), place) + MARGIN_M
    side = float((high - low).max())
    middle = (low + high) / 2.0
    return middle - side / 2.0, middle + side / 2.0


def _corner(look: ScanCheck, low: Floats, high: Floats) -> tuple[float, float, float, float]:
    """Choose the emptiest corner, other than the legend's, for the inset."""
    size, gap = 0.24, 0.07  # the gap holds title and numbers of the inset
    far = 1.0 - size - gap
    corners = [(far, far), (gap, far), (far, gap)]
    spots = np.vstack([look.level.to_map(look.standing.points[:, :2]), look.pose.position[:2]])
    share = ((spots - low) / (high - low))[:, None]
    counts = ((share > corners) & (share < np.add(corners, size))).all(axis=2).sum(axis=0)
    return (*corners[int(np.argmin(counts))], size, size)


def _draw_surface(ax: Any, look: ScanCheck) -> None:
    """Draw the score over offsets, north up, with the answer in the middle."""
    from matplotlib.transforms import Affine2D  # noqa: PLC0415 - where it draws

    shift_m = SHIFT_M
    half = shift_m + CELL_M / 2.0
    ax.imshow(
        look.surface.T, extent=(-half, half, -half, half), origin="lower", cmap="magma", vmin=0.0,
        vmax=1.0, transform=Affine2D().rotate_deg(look.pose.yaw) + ax.transData,
    )  # fmt: skip
    ax.plot(0.0, 0.0, marker="+", color="white", markersize=10, markeredgewidth=1.2)
    span = (-shift_m, shift_m)
    ax.set(xlim=span, ylim=span, aspect="equal", xticks=(span[0], 0, span[1]), yticks=())
    ax.set_facecolor("black")
    ax.tick_params(labelsize=8, length=2, pad=1)
    ax.set_title(tr("score if moved, m"), fontsize=8, pad=4).set_bbox(
        {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
    )
