"""Draw the scan check: what stands, over canopy, roofs and walls."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D

from gis_radar.base import CELL_M, Booleans, Floats, label_map, legend_below, picture_file, tr
from gis_radar.calibration.scan_check import SHIFT_M, ScanCheck
from gis_radar.calibration.surroundings import TALL_M, Structure

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


def draw_scan_check(look: ScanCheck, path: str | Path) -> None:
    """Draw what stands around the pose over the scan's canopy, roofs and walls (PNG).

    Parameters
    ----------
    look : ScanCheck
        The scan check.
    path : str or Path
        The picture; appears whole or not at all.
    """
    with picture_file(path, SIZE_IN, DPI, tight=True) as figure:
        draw_surroundings(figure.add_subplot(), look)


def draw_surroundings(ax: Axes, look: ScanCheck) -> None:
    """Draw a scan check into axes of the map's coordinates."""
    half = len(look.structure.top) // 2 * CELL_M
    place = look.pose.position[:2]
    into_map = Affine2D().rotate_deg(look.pose.yaw).translate(*place)
    ax.imshow(
        _colours(look.structure).transpose(1, 0, 2), origin="lower",
        extent=(-half, half, -half, half), interpolation="nearest",
        transform=into_map + ax.transData,
    )  # fmt: skip
    handles = [*_draw_standing(ax, look), *_kinds(look.structure)]
    ahead = look.pose.R_map_sensor[:2, 0]
    low, high = _window(look)
    tip = place + ahead * float((high - low).max()) / 12.0
    ax.plot(*np.column_stack([place, tip]), color=SENSOR, linewidth=1.5, zorder=5)
    handles.append(
        ax.scatter(
            [place[0]], [place[1]], s=30, color=SENSOR, marker="^", label=tr("sensor"), zorder=5
        )
    )
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    label_map(ax)
    ax.set_title(_title(look))
    legend_below(ax, handles)
    if look.surface.size:
        _draw_surface(ax.inset_axes(_corner(look, low, high)), look)


def _title(look: ScanCheck) -> str:
    reason = ";\n".join(fill(part, LINE) for part in tr(look.reason).split("; "))
    verdict = tr(
        "{sensor}, scan check: {verdict}", sensor=look.pose.sensor, verdict=tr(look.verdict)
    )
    return f"{verdict}\n{reason}"


def _colours(structure: Structure) -> Floats:
    """Return the colour of each cell, (n, n, 3)."""
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


def _kinds(structure: Structure) -> list[Patch]:
    shown: tuple[tuple[str, str], ...] = (
        (TALL[1], "canopy and roofs"), (WALL, "walls and rims of crowns"),
    )  # fmt: skip
    if structure.classified:
        shown = ((CANOPY[1], "canopy"), (ROOF[1], "roofs"), (WALL, "walls"))
    return [Patch(color=colour, label=tr(label)) for colour, label in shown]


def _draw_standing(ax: Axes, look: ScanCheck) -> list[Line2D]:
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
    size, gap = 0.24, 0.02
    corners = [(1.0 - size - gap, 1.0 - size - 2 * gap), (gap, 1.0 - size - 2 * gap),
               (1.0 - size - gap, 2 * gap)]  # fmt: skip
    spots = np.vstack([look.level.to_map(look.standing.points[:, :2]), look.pose.position[:2]])
    share = ((spots - low) / (high - low))[:, None]
    counts = ((share > corners) & (share < np.add(corners, size))).all(axis=2).sum(axis=0)
    return (*corners[int(np.argmin(counts))], size, size)


def _draw_surface(ax: Axes, look: ScanCheck) -> None:
    """Draw the score over offsets, north up, with the answer in the middle."""
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
