"""Problem and result of a localization: sensor, map and guess; pose with evidence and picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from gis_radar.base import (
    Floats,
    NoAnswerError,
    Text,
    axes_or_new,
    card,
    figure_text,
    iso_from_step,
    label_map,
    legend_below,
    percent,
    picture_file,
    small_picture,
    step_of,
    tr,
)
from gis_radar.calibration.registration.certainty import UNFIXED, longest_m
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import Moving
from gis_radar.calibration.scan.scan_check_result import ScanCheck
from gis_radar.hdmap import LaneletMap
from gis_radar.poses import COMPONENTS, Pose, View, draw_sensor, ellipse
from gis_radar.scans import Sight, SightTiles

STAGE = "finding the pose"

_DPI = 216  # of the picture
_SIZE_IN = (6.6, 6.6)  # inches, of one panel
_WITH_ONE_IN, _WITH_TWO_IN = (7.8, 4.8), (7.8, 10.6)  # with one or two more panels: a page's width
_LETTERS_PT = 9.0
_LARGER = 1.3  # factor on the letters of a panel that is as wide as two
_LINE = 46  # most letters in a line of a title
_MARGIN_M = 12.0  # of the picture around the traces
_ROAD_POINTS = 60_000  # most points of the road that are drawn
_ARROW_EVERY_M = 12.0
# Colours; AWAY and NEAR of the traces differ in lightness, too.
_ROAD, _LANE, _AWAY, _NEAR, _PLAIN = ("#c9c5bd", "#6f7780", "#e8850c", "#1e2f97", "#7c3aed")

Extent = tuple[Floats, Floats]  # south-west and north-east, metres


@dataclass(frozen=True, kw_only=True)
class Localization:
    """Result of a localization: a pose with its evidence.

    Parameters
    ----------
    pose : Pose
        The pose; its evidence is written into the pose file.
    fitness : float
        Share of the traces that fit: on lanes whose direction agrees with the Doppler (`lane`), or
        within a voxel of the road (`icp`).
    observable : bool
        Whether the scene fixes all six components.
    recording : str
        File name of the recording that gave the pose, where several were tried.
    eigenvalues : tuple of float
        Eigenvalues of the data's information about the pose, ascending, 1/m^2.
    hypotheses : tuple of (easting, northing, yaw_deg, loss)
        The hypotheses of the search, the best first.
    vehicles, samples : int
        Number of tracks and of detections used.
    z_score : float
        Z score of the pose over the next hypothesis; infinite where there is none.
    traces : (n, 3) array
        The detections used, sensor frame, metres.
    range_rate : (n,) array
        Range rates of the traces, m/s; NaN for `icp`.
    """

    pose: Pose
    fitness: float
    observable: bool
    recording: str = ""
    eigenvalues: tuple[float, ...] = ()
    hypotheses: tuple[tuple[float, float, float, float], ...] = ()
    vehicles: int = 0
    samples: int = 0
    z_score: float = math.inf
    traces: Floats = field(repr=False, default_factory=lambda: np.empty((0, 3)))
    range_rate: Floats = field(repr=False, default_factory=lambda: np.empty(0))

    def figures(self) -> Mapping[str, Any]:
        """Return the main figures of the localization, by name."""
        sigma = self.pose.evidence.get("sigma", {})
        check = self.pose.evidence.get("scan_check")
        return {
            **{name: round(getattr(self.pose, name), 3) for name in COMPONENTS},
            **{f"sigma_{name}": float(f"{value:.2g}") for name, value in sigma.items()},
            "fitness": round(self.fitness, 3),
            "observable": self.observable,
            "vehicles": self.vehicles,
            "hypotheses": len(self.hypotheses),
            **range_scale_figures(self.pose),
            **({"scan_check": Text(check["verdict"])} if check else {}),
        }

    def with_scan_check(self, check: ScanCheck) -> Localization:
        """Return the localization with a scan check's figures in the evidence of its pose.

        A pose without a view gets one with the range of the check (99.9th percentile).
        """
        evidence = {**self.pose.evidence, "scan_check": dict(check.figures())}
        pose = replace(self.pose, evidence=evidence)
        if check.range_m > View.min_range_m:
            pose = pose.with_view(View(max_range_m=check.range_m))
        return replace(self, pose=pose)

    def left_open(self, *, scanned: bool) -> Text | None:
        """Return a line on the components of the pose that are not fixed, with advice, or None.

        Parameters
        ----------
        scanned : bool
            Whether a scan was given.
        """
        covariance = self.pose.evidence.get("covariance")
        if self.observable or covariance is None:
            return None
        matrix = np.asarray(covariance)
        sigma, place_m = np.sqrt(np.diag(matrix)), longest_m(matrix)
        parts = []
        if place_m >= UNFIXED[0]:
            parts.append(Text("{:.1f} m of its place", place_m))
        if sigma[2] >= UNFIXED[2]:
            parts.append(Text("{:.1f} m of its height", float(sigma[2])))
        parts += [
            Text("{:.1f} deg of {}", math.degrees(sigma[k]), COMPONENTS[k])
            for k in (3, 4, 5)
            if sigma[k] >= UNFIXED[k]
        ]
        advice = Text("record more traffic, on crossing lanes, too")
        if not scanned and max(place_m / UNFIXED[0], sigma[5] / UNFIXED[5]) >= 1.0:
            advice = Text("give the scan ({}): what stands fixes it", "--scan")
        return Text(
            "{}: its traffic leaves open {} (one standard deviation); {}",
            self.pose.sensor, Text(", ").join(parts), advice,
        )  # fmt: skip

    def plot(
        self, roads: LaneletMap | None = None, road_points: Floats | None = None, ax: Any = None
    ) -> Any:
        """Draw the traces with the pose, the sensor, and the 95 % ellipse of its position.

        Parameters
        ----------
        roads : LaneletMap, optional
            The lanes, drawn under the traces.
        road_points : (n, 3) array, optional
            The scanned road, drawn under the traces.
        ax : matplotlib Axes, optional
            Axes in metres of the map; by default those of a new figure.

        Returns
        -------
        matplotlib Axes
        """
        ax = axes_or_new(ax, (8.0, 8.0))
        traces, place = self.pose.to_map(self.traces), self.pose.position[:2]
        low, high = extent = _trace_extent(traces, place)
        if road_points is not None:
            _draw_road(ax, road_points, extent)
        if roads is not None:
            _draw_lanes(ax, roads, extent)
        _draw_traces(ax, traces, self.range_rate)
        covariance = self.pose.plane_covariance()
        ring = None if covariance is None else ellipse(place, covariance)
        ahead = self.pose.R_map_sensor[:2, 0] * float((high - low).max()) / 12.0
        draw_sensor(ax, place, ahead, ring, tr("sensor"))
        label_map(ax)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title=self._title())
        for handle in legend_below(ax).legend_handles:  # on the map it would cover the road
            if hasattr(handle, "set_sizes"):
                handle.set_sizes([18.0])  # the traces' points would be too small to show colours
        return ax

    def _title(self) -> str:
        sigma, share = self.pose.evidence.get("sigma"), percent(self.fitness, 0)
        parts = [tr("{share} of the vehicle paths lie on the lanes", share=share)]
        if sigma:
            across = float(np.hypot(sigma["easting"], sigma["northing"]))
            parts.append(tr(
                "position ± {across} m, yaw ± {yaw}°",
                across=figure_text(across, 2), yaw=figure_text(sigma["yaw"], 2),
            ))  # fmt: skip
        scale = self.pose.evidence.get("range_scale")
        if isinstance(scale, Mapping):
            factor, error = (figure_text(scale[each], 3) for each in ("factor", "sigma"))
            parts.append(tr("scale of range {factor} ± {error}", factor=factor, error=error))
        if not self.observable:
            parts.append(tr("the scene leaves part of it open"))
        parts[0] = f"{self.pose.sensor}: {parts[0]}"
        return ";\n".join(fill(each, _LINE) for each in parts)

    def draw(
        self,
        path: str | Path,
        roads: LaneletMap,
        road_points: Floats,
        *,
        scan_check: ScanCheck | None = None,
        sight: tuple[Sight, SightTiles] | None = None,
    ) -> None:
        """Draw the traces with the pose over lanes and scanned road, as a PNG.

        Parameters
        ----------
        path : str or Path
            The picture; appears whole or not at all.
        roads : LaneletMap
            The lanes, in the pose's CRS.
        road_points : (n, 3) array
            The scanned road.
        scan_check : ScanCheck, optional
            Comparison of the pose with a scan, drawn in a panel of its own.
        sight : (Sight, SightTiles), optional
            The sensor's sight, drawn in a panel of its own: visible and hidden tiles.
        """
        # not at the top: matplotlib is slow to load, and only pictures need it
        from matplotlib.text import Text  # noqa: PLC0415

        from gis_radar.scans import draw_sight  # noqa: PLC0415

        drawn = {"scan_check": scan_check, "sight": sight}
        beside = [name for name, each in drawn.items() if each is not None]
        size_in = (_SIZE_IN, _WITH_ONE_IN, _WITH_TWO_IN)[len(beside)]
        rows = [["traces", *beside]] if len(beside) < 2 else [["traces", "traces"], beside]
        with picture_file(path, size_in, _DPI, tight=True, font_pt=_LETTERS_PT) as figure:
            panels = figure.subplot_mosaic(rows)
            self.plot(roads, road_points, ax=panels["traces"]).set_anchor("N")
            if len(beside) == 2:  # shown as wide as the others on a phone, it needs larger letters
                for text in panels["traces"].findobj(match=Text):
                    text.set_fontsize(_LARGER * text.get_fontsize())
            if scan_check is not None:
                scan_check.plot(panels["scan_check"])
            if sight is not None:
                ax = panels["sight"]
                draw_sight(ax, *sight)
                label_map(ax)
                counts = sight[0].figures()
                share = counts["hidden"] / max(counts["in_sight"] + counts["hidden"], 1)
                text = "Lanes in its view:\n{seen} in sight, {hidden} hidden"
                ax.set_title(tr(text, seen=percent(1 - share, 0), hidden=percent(share, 0)))
                legend_below(ax)

    def __repr__(self) -> str:
        doubt = "" if self.observable else "; the scene does not fix all of the pose"
        return f"Localization({self.pose!r}; {self.fitness:.0%} of the traces fit{doubt})"

    def _repr_html_(self) -> str:
        picture = small_picture(self._small) if len(self.traces) else b""
        return card(f"Localization of {self.pose.sensor}", self.figures(), picture=picture)

    def _small(self, ax: Any) -> None:
        self.plot(ax=ax).set_title("")
        ax.get_legend().remove()
        ax.tick_params(labelsize=6)


def range_scale_figures(pose: Pose) -> dict[str, Any]:
    """Return the scale of range in a pose's evidence, and its error, by name."""
    scale = pose.evidence.get("range_scale")
    if not isinstance(scale, Mapping):
        return {} if scale is None else {"range_scale": scale}
    return {
        "range_scale": round(scale["factor"], 3),
        "sigma_range_scale": float(f"{scale['sigma']:.2g}"),
    }


class AmbiguousError(NoAnswerError):
    """Error of a localization in which several poses fit, none significantly better.

    Parameters
    ----------
    template, *values, hint
        As for every error.
    answers : tuple of Localization
        A localization for each pose, the best first.
    """

    def __init__(  # callable with the message alone: that is how errors are unpickled
        self, template: str, /, *values: Any, hint: str = "",
        answers: tuple[Localization, ...] = (),
    ) -> None:  # fmt: skip
        super().__init__(template, *values, hint=hint)
        self.answers = answers


def _trace_extent(traces: Floats, place: Floats) -> Extent:
    """Return the extent of a picture: nearly all traces and the sensor, with a margin."""
    low = np.minimum(np.percentile(traces[:, :2], 0.5, axis=0), place) - _MARGIN_M
    high = np.maximum(np.percentile(traces[:, :2], 99.5, axis=0), place) + _MARGIN_M
    return low, high


def _draw_road(ax: Any, road: Floats, extent: Extent) -> None:
    """Draw the points of the scanned road within an extent."""
    low, high = extent
    inside = road[((road[:, :2] > low) & (road[:, :2] < high)).all(axis=1)]
    shown = inside[:: max(len(inside) // _ROAD_POINTS, 1)]
    ax.scatter(shown[:, 0], shown[:, 1], s=0.6, color=_ROAD, linewidths=0, label=tr("scanned road"))


def _draw_lanes(ax: Any, roads: LaneletMap, extent: Extent) -> None:
    """Draw the bounds of the lanes within an extent, with arrows where they are one-way."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - only pictures need it

    low, high = extent
    near = roads.lanelets.cx[low[0] : high[0], low[1] : high[1]]
    bounds = [np.asarray(line.coords)[:, :2] for side in ("left", "right") for line in near[side]]
    ax.add_collection(LineCollection(bounds, colors=_LANE, linewidths=0.5))
    centres = near.loc[near["one_way"].to_numpy(bool), "centre"]
    for line in centres:
        for at in np.arange(_ARROW_EVERY_M / 2, line.length, _ARROW_EVERY_M):
            here, ahead = line.interpolate(at), line.interpolate(min(at + 2.0, line.length))
            ax.annotate(
                "",
                (ahead.x, ahead.y),
                (here.x, here.y),
                arrowprops={"arrowstyle": "->", "color": _LANE, "linewidth": 0.5},
                annotation_clip=True,
            )


def _draw_traces(ax: Any, traces: Floats, rate: Floats) -> None:
    """Draw traces, receding and approaching ones in different colours."""
    kinds = (
        (rate > 0.0, _AWAY, "recedes"),
        (rate < 0.0, _NEAR, "comes near"),
        (np.isnan(rate), _PLAIN, "moves"),
    )
    for which, colour, label in kinds:
        if which.any():
            x, y = traces[which, :2].T
            ax.scatter(x, y, s=1.5, color=colour, linewidths=0, label=tr(label))


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Problem of a localization: sensor, map, road and guess.

    Parameters
    ----------
    name : str
        Name of the sensor.
    roads : LaneletMap
        The lanes.
    road : (n, 3) array
        Points of the road's surface in the map's CRS, metres.
    guess : (2,) or (3,) array
        Easting, northing and optionally height, metres.
    heading : float or None
        Guess of the yaw, radians.
    evidence : dict
        Evidence that is added to that of every pose.
    """

    name: str
    roads: LaneletMap
    road: Floats
    guess: Floats
    heading: float | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def pose(self, state: State, evidence: Mapping[str, Any]) -> Pose:
        """Convert a state in local coordinates to a pose in the map."""
        yaw, pitch, roll = (float(angle) for angle in np.degrees(state.yaw_pitch_roll))
        easting, northing = (float(v) for v in state.position[:2] + self.guess[:2])
        return Pose(
            sensor=self.name,
            crs=self.roads.crs,
            easting=easting,
            northing=northing,
            height=float(state.position[2]),
            yaw=yaw,
            pitch=pitch,
            roll=roll,
            evidence={**evidence, **self.evidence},
        )


def common(moving: Moving, method: str) -> dict[str, Any]:
    """Return the evidence that all methods have in common: time, method and frames."""
    return {
        "time": iso_from_step(int(step_of(np.array(moving.end)))),
        "method": method,
        "frames": moving.frames,
    }
