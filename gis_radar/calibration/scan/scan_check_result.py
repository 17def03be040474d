"""Result of a scan check: static cells, scan, verdict, and its picture."""

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
SHIFT_M = 10.0  # reach, ahead and to the sides, of the search for better poses

_DPI = 216  # of the picture
_SIZE_IN = (6.6, 6.6)  # inches
_MARGIN_M = 12.0  # of the picture around the static cells
_TALLEST_M = 15.0  # height from which on colours are darkest
_ON, _LEAVES, _OFF, _SENSOR = "#1e1b6b", "#0e93c9", "#dc2626", "#111827"
_BARE, _UNSEEN = "#f4f2ec", "#ffffff"
_CANOPY, _ROOF, _TALL = ("#d3e8c4", "#4f9a51"), ("#e6ddd3", "#a8927e"), ("#dfe5d3", "#83997a")
_WALL = "#6b5c4f"
_RUSTLING = 0.15  # least share of moving detections of a cell that is drawn as leaves
_FITS = 0.3  # least closeness of a cell that is drawn as fitting the scan
_LINE, _LEGEND_LINE = 46, 22  # most letters in a line of the title, and of the legend


@dataclass(frozen=True, kw_only=True)
class PoseOffset:
    """Offset from the checked pose, with its score.

    Parameters
    ----------
    ahead_m, left_m : float
        Shift ahead and to the left by the yaw of the checked pose.
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
        """Return whether the shift is at least `shift_m` or the turn at least `turn_deg`."""
        return self.shift_m >= shift_m or abs(self.turn_deg) >= turn_deg


@dataclass(frozen=True, kw_only=True, repr=False)
class ScanCheck:
    """Scan check of a pose: static cells around the sensor, compared with a scan, and the verdict.

    The score is about the share of static cells, of half a metre, that lie on canopy and walls of
    the scan. It does not measure height, roll and pitch.

    Parameters
    ----------
    pose : Pose
        The pose that was checked.
    verdict : str
        `confirms`, `doubts`, `undecided` (others may fit alike) or `nothing to compare`.
    reason : str
        The reason for the verdict, in one line.
    score : float
        Score at the pose, 0 to 1; NaN where there was nothing to compare.
    chance : float
        Mean score of all poses up to 10 m away, in all headings.
    best : PoseOffset, optional
        Offset of the highest score, up to 10 m ahead and to the sides, in all headings.
    rival : PoseOffset, optional
        Best offset of 3 m (a lane) or 3 degrees or more.
    z_score : float
        Z score of the pose over `rival`; infinite where there is no rival.
    standing : Standing
        The static cells, in the level frame of the pose.
    closeness : (n,) array
        Closeness of each static cell to a structure, 0 to 1; the score is the mean.
    covered : float
        Share of the static cells over which the scan has points.
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
        """The level frame of the static cells and the scan's structures."""
        return LevelFrame(pose=self.pose)

    def __repr__(self) -> str:
        return f"ScanCheck({self.pose.sensor}: {self.verdict}: {self.reason})"

    def figures(self) -> Mapping[str, Any]:
        """Return the figures, ready for JSON.

        `best_east_m`, `best_north_m` and `best_turn_deg` are the offset of the highest score.
        """
        values: dict[str, Any] = {
            "verdict": self.verdict,
            "reason": self.reason,
            "standing_cells": len(self.standing),
            "scan_classified": self.structure.classified,
        }
        if self.best is not None:
            beside = np.array([[self.best.ahead_m, self.best.left_m]])
            east, north = (self.level.to_map(beside)[0] - self.pose.position[:2]).tolist()
            values |= {
                "covered": round(self.covered, 3),
                "score": round(self.score, 3),
                "chance": round(self.chance, 3),
                "best_score": round(self.best.score, 3),
                "best_east_m": round(east, 2),
                "best_north_m": round(north, 2),
                "best_turn_deg": round(self.best.turn_deg, 2),
            }
        if self.rival is not None:
            values |= {"rival_score": round(self.rival.score, 3), "z_score": round(self.z_score, 2)}
        return values

    def draw(self, path: str | Path) -> None:
        """Draw static cells over the scan's canopy, roofs and walls, as a PNG.

        Parameters
        ----------
        path : str or Path
            The picture; appears whole or not at all.
        """
        with picture_file(path, _SIZE_IN, _DPI, tight=True) as figure:
            self.plot(figure.add_subplot())

    def plot(self, ax: Any = None) -> Any:
        """Draw static cells over the scan's canopy, roofs and walls.

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
        handles = [*_draw_standing(ax, self), *_structure_handles(self.structure)]
        ahead = self.pose.R_map_sensor[:2, 0]
        low, high = _map_window(self)
        tip = place + ahead * float((high - low).max()) / 12.0
        ax.plot(*np.column_stack([place, tip]), color=_SENSOR, linewidth=1.5, zorder=5)
        handles.append(
            ax.scatter(
                [place[0]],
                [place[1]],
                s=30,
                color=_SENSOR,
                marker="^",
                label=tr("sensor"),
                zorder=5,
            )
        )
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        label_map(ax)
        ax.set_title(_title(self))
        legend_below(ax, handles)
        if self.surface.size:
            _draw_surface(ax.inset_axes(_inset_corner(self, low, high)), self)
        return ax


def _title(check: ScanCheck) -> str:
    reason = ";\n".join(fill(part, _LINE) for part in tr(check.reason).split("; "))
    verdict = tr(
        "{sensor}, scan check: {verdict}", sensor=check.pose.sensor, verdict=tr(check.verdict)
    )
    return f"{verdict}\n{reason}"


def _colours(structure: Structure) -> Floats:
    """Return the colour of each cell, (n, n, 3)."""
    from matplotlib.colors import to_rgb  # noqa: PLC0415 - where it draws

    over = np.nan_to_num((structure.top - structure.ground - TALL_M) / _TALLEST_M, nan=-1.0)
    shade = np.clip(over, 0.0, 1.0)[..., None]
    image = np.where(np.isnan(structure.top)[..., None], to_rgb(_UNSEEN), to_rgb(_BARE))
    kinds: tuple[tuple[Booleans, tuple[str, str]], ...] = ((over > 0.0, _TALL),)
    if structure.classified:
        kinds = ((structure.roof, _ROOF), (structure.canopy, _CANOPY))
    for which, (light, dark) in kinds:
        colour = (1.0 - shade) * to_rgb(light) + shade * to_rgb(dark)
        image = np.where(which[..., None], colour, image)
    walls = structure.edge & ~structure.canopy
    return np.where(walls[..., None], 0.55 * image + 0.45 * np.array(to_rgb(_WALL)), image)


def _structure_handles(structure: Structure) -> list[Any]:
    from matplotlib.patches import Patch  # noqa: PLC0415 - where it draws

    shown: tuple[tuple[str, str], ...] = (
        (_TALL[1], "canopy and roofs"), (_WALL, "walls and rims of crowns"),
    )  # fmt: skip
    if structure.classified:
        shown = ((_CANOPY[1], "canopy"), (_ROOF[1], "roofs"), (_WALL, "walls"))
    return [Patch(color=colour, label=tr(label)) for colour, label in shown]


def _draw_standing(ax: Any, check: ScanCheck) -> list[Any]:
    from matplotlib.lines import Line2D  # noqa: PLC0415 - where it draws

    found = check.standing
    if len(found) == 0:
        return []
    east, north = check.level.to_map(found.points[:, :2]).T
    off = check.closeness < _FITS if len(check.closeness) else np.zeros(len(found), bool)
    leaves = ~off & (found.rustles > _RUSTLING)
    kinds: tuple[tuple[Booleans, str, str, float, str], ...] = (
        (~off & ~leaves, _ON, "o", 3.0, "stands"),
        (leaves, _LEAVES, "o", 3.0, "moves in place, as leaves do"),
        # another shape, for the colour-blind
        (off, _OFF, "x", 9.0, "stands where the scan shows nothing"),
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
                    label=fill(tr(label), _LEGEND_LINE),
                )
            )  # fmt: skip
    return handles


def _map_window(check: ScanCheck) -> tuple[Floats, Floats]:
    """Return the map corners of the picture, a square around static cells and sensor."""
    place = check.pose.position[:2]
    if len(check.standing) == 0:
        half = len(check.structure.top) // 2 * CELL_M
        return place - half, place + half
    spots = check.level.to_map(check.standing.points[:, :2])
    low = np.minimum(np.percentile(spots, 0.5, axis=0), place) - _MARGIN_M
    high = np.maximum(np.percentile(spots, 99.5, axis=0), place) + _MARGIN_M
    side = float((high - low).max())
    middle = (low + high) / 2.0
    return middle - side / 2.0, middle + side / 2.0


def _inset_corner(check: ScanCheck, low: Floats, high: Floats) -> tuple[float, float, float, float]:
    """Return x, y, width and height (axes) of the inset, in the corner with fewest cells."""
    size, gap = 0.24, 0.07  # the gap holds title and numbers of the inset
    far = 1.0 - size - gap
    corners = [(far, far), (gap, far), (far, gap)]
    spots = np.vstack([check.level.to_map(check.standing.points[:, :2]), check.pose.position[:2]])
    share = ((spots - low) / (high - low))[:, None]
    counts = ((share > corners) & (share < np.add(corners, size))).all(axis=2).sum(axis=0)
    return (*corners[int(np.argmin(counts))], size, size)


def _draw_surface(ax: Any, check: ScanCheck) -> None:
    """Draw the score over shifts, north up, with the checked pose in the middle."""
    from matplotlib.transforms import Affine2D  # noqa: PLC0415 - where it draws

    shift_m = SHIFT_M
    half = shift_m + CELL_M / 2.0
    ax.imshow(
        check.surface.T, extent=(-half, half, -half, half), origin="lower", cmap="magma", vmin=0.0,
        vmax=1.0, transform=Affine2D().rotate_deg(check.pose.yaw) + ax.transData,
    )  # fmt: skip
    ax.plot(0.0, 0.0, marker="+", color="white", markersize=10, markeredgewidth=1.2)
    span = (-shift_m, shift_m)
    ax.set(xlim=span, ylim=span, aspect="equal", xticks=(span[0], 0, span[1]), yticks=())
    ax.set_facecolor("black")
    ax.tick_params(labelsize=8, length=2, pad=1)
    ax.set_title(tr("score if moved, m"), fontsize=8, pad=4).set_bbox(
        {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
    )
