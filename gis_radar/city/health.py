"""Health of the fleet in a month: sensors that are silent, moved, doubtful, or have a wrong clock.

It follows from the tables that outlive the exact ones: recordings, poses, the tile counts, and what
was checked. A sensor's share of the month is how long a tile was observed that no other sensor
sees; where others see all of its tiles, that of its recordings.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import STEP_S, Floats, Text, figure_text, seconds_text, tr
from gis_radar.calibration import FITS, SENSOR_STATES, WRONG, HealthState
from gis_radar.city.city import RESULTS, City, open_city
from gis_radar.city.month import CityMonth, month_of
from gis_radar.dataset import POSES, RECORDINGS, TILE_COUNTS, Dataset
from gis_radar.poses import ANGLES, POSITION
from gis_radar.products import lost_sensors, read_run

_SILENT_S = 3600.0  # without data, after which a sensor counts as silent, or as one with gaps
_LEAST_SHARE_SEEN = 0.95  # least share of the month with data of a sensor that works
_CLOCK_OFF_S = 0.025  # half of a step: a clock that is off by more is wrong
_MOVED_M, _MOVED_DEG = 0.5, 1.0  # a pose that changes by more is that of a sensor that was moved
_LEAST_STATED_M = 0.05  # a smaller move is left out of the text, which then states the turn alone
_COLUMNS = (
    "site", "sensor", "state", "since", "share", "gap_s", "gap_begin", "clock_offset_s", "reasons",
)  # fmt: skip


class _Reason(NamedTuple):
    """A reason for a state, since when (UNIX seconds), and what is known of it."""

    state: Text
    since_s: float
    words: str


def fleet_health(root: str | Path | City, month: str) -> pd.DataFrame:
    """Return the health of all sensors of a city in a month, worst first.

    The month ends with the newest hour of any site.

    Parameters
    ----------
    root : str, Path or City
        The city.
    month : str
        The month, such as `2026-10`, by the clocks of each site.

    Returns
    -------
    DataFrame
        A row a sensor: `site`, `sensor`; `state` (`no data`, `silent`, `moved`, `pose doubtful`,
        `clock off`, `gaps`, `pose not confirmed`, `works`), `since` (UTC); `share` of the month
        with data; `gap_s` and `gap_begin` of the longest gap; `clock_offset_s` (its clock is ahead
        by); `reasons` (what is known, in the current language).

    Raises
    ------
    UsageError
        If it is no month.
    InputError
        If the folder is no city, or no site has data of the month.
    """
    city = open_city(root)
    return health_of(month_of(city, month), city.sites)


def health_of(month: CityMonth, sites: Iterable[str]) -> pd.DataFrame:
    """Return the health of the sensors of some sites, as :func:`fleet_health` does."""
    rows = [row for name in sites for row in _site_rows(name, month)]
    table = pd.DataFrame(rows, columns=list(_COLUMNS))
    for name in ("since", "gap_begin"):
        table[name] = pd.to_datetime(table[name].astype(float).round(), unit="s", utc=True)
    return worst_first(table)


def worst_first(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of :func:`fleet_health` in its order."""
    rank = table["state"].map({state: place for place, state in enumerate(SENSOR_STATES)})
    order = table.assign(rank=rank).sort_values(["rank", "share", "site", "sensor"])
    return table.loc[order.index].reset_index(drop=True)


def _site_rows(site: str, month: CityMonth) -> Iterator[dict[str, Any]]:
    """Yield the rows of the sensors of a site."""
    dataset = month.city.sites[site]
    lost = _lost(month.city.root, site)
    first, last = month.span(dataset)
    last = min(last, month.last_step)
    begin_s, end_s = first * STEP_S, (last + 1) * STEP_S
    recordings = dataset.single_table(RECORDINGS).to_pandas()
    poses = _poses(dataset, recordings)
    observed = _observed_s(dataset, (first, last))
    earlier_s = month.before.span(dataset)[0] * STEP_S
    for sensor, of_sensor in recordings.groupby("sensor"):
        name = str(sensor)
        if not ((of_sensor["last_time"] >= earlier_s) & (of_sensor["first_time"] < end_s)).any():
            continue  # taken down long ago, or put up later
        gaps = _gaps(of_sensor, begin_s, end_s)
        recorded_s = end_s - begin_s - gaps[:, 1].sum()
        share = min(observed.get(name, recorded_s) / (end_s - begin_s), 1.0)
        own_poses = poses[poses["sensor"] == name]
        reasons = [
            *_silence(of_sensor, begin_s, end_s, lost.get(name)),
            *_moves(own_poses, begin_s, end_s), *_doubts(dataset, name, end_s),
            *_clocks(of_sensor, begin_s, end_s), *_missing(gaps, share),
        ]  # fmt: skip
        yield _row(site, name, reasons, share=share, gaps=gaps, recordings=of_sensor)
    for name in sorted(lost.keys() - set(recordings["sensor"])):
        yield _row(site, name, [_Reason(HealthState.NO_DATA, np.nan, tr(lost[name]))], share=0.0)


def _lost(root: Path, site: str) -> dict[str, str]:
    """Return the sensors of a site without a result in the newest run, and why."""
    run = read_run(root / RESULTS / site)
    city = (read_run(root).get("sites") or {}).get(site) or {}
    failed = {each["what"]: each["message"] for each in city.get("failures") or []}
    named = {str(each["name"]) for each in (run.get("site") or {}).get("sensor") or []}
    refused = {name: Text(failed[name]).without(name) for name in named & failed.keys()}
    return refused | lost_sensors(run)


def _row(
    site: str, sensor: str, reasons: list[_Reason], *, share: float, gaps: Floats | None = None,
    recordings: pd.DataFrame | None = None,
) -> dict[str, Any]:  # fmt: skip
    worst = min(reasons, key=lambda each: SENSOR_STATES.index(each.state), default=None)
    longest = (np.nan, np.nan) if gaps is None or not len(gaps) else gaps[gaps[:, 1].argmax()]
    offset = np.nan if recordings is None else recordings["clock_offset"].iloc[-1]
    return {
        "site": site, "sensor": sensor, "state": worst.state if worst else HealthState.WORKS,
        "since": worst.since_s if worst else np.nan, "share": share, "gap_begin": longest[0],
        "gap_s": longest[1], "clock_offset_s": offset,
        "reasons": "; ".join(each.words for each in reasons if each.words),
    }  # fmt: skip


def _gaps(recordings: pd.DataFrame, begin_s: float, end_s: float) -> Floats:
    """Return begin and length of the gaps between recordings, within a time."""
    runs = recordings[["first_time", "last_time"]].clip(begin_s, end_s).to_numpy(np.float64)
    runs = runs[runs[:, 0].argsort()]
    reached = np.maximum.accumulate(np.concatenate([[begin_s], runs[:, 1]]))
    length = np.concatenate([runs[:, 0], [end_s]]) - reached
    gaps = np.column_stack([reached, length])
    return np.asarray(gaps[length > 1.0], np.float64)


def _observed_s(dataset: Dataset, span: tuple[int, int]) -> dict[str, float]:
    """Return by sensor how long a tile was observed that no other sensor sees."""
    poses = dataset.single_table(POSES).to_pandas()[["sensor", "sight"]].drop_duplicates()
    pairs = poses.merge(dataset.sights(), left_on="sight", right_on="pose")
    watchers = pairs.groupby("tile_id")["sensor"].transform("nunique")
    seen_alone = (
        pairs[watchers == 1].groupby(["sensor", "sight"], as_index=False)["tile_id"].first()
    )
    if seen_alone.empty:
        return {}
    wanted = pa.array(seen_alone["tile_id"].unique())
    columns = ["tile_id", "first_step", "observed_steps"]
    parts = [
        rows.filter(pc.is_in(rows["tile_id"], wanted)).to_pandas()
        for rows in dataset.batches(TILE_COUNTS, span, columns)
    ]
    counts = pd.concat([pd.DataFrame(columns=columns), *parts]).astype(np.int64)
    counts_of_sensor = (
        seen_alone[["sensor", "tile_id"]].drop_duplicates().merge(counts, on="tile_id", how="left")
    )
    # A sensor that was moved has a tile for each pose, and observes one of them at a time.
    longest = counts_of_sensor.groupby(["sensor", "first_step"], dropna=False)[
        "observed_steps"
    ].max()
    return {str(n): float(v) for n, v in (longest.groupby("sensor").sum() * STEP_S).items()}


def _silence(
    recordings: pd.DataFrame, begin_s: float, end_s: float, why: str | None
) -> Iterator[_Reason]:
    last_s = float(recordings.loc[recordings["first_time"] < end_s, "last_time"].max())
    if end_s - last_s > _SILENT_S:
        text = tr("silent all month") if last_s < begin_s else tr("silent up to the end")
        yield _Reason(
            HealthState.SILENT, last_s, f"{text} ({seconds_text(end_s - max(last_s, begin_s))})"
        )
        if why is not None:  # recordings came, but were refused
            yield _Reason(HealthState.SILENT, last_s, tr(why))


def _poses(dataset: Dataset, recordings: pd.DataFrame) -> pd.DataFrame:
    """Return the poses with `begin_s`, from when each counts; of single ones, their first frame."""
    poses = dataset.single_table(POSES).to_pandas()
    first = recordings.groupby("pose")["first_time"].min()
    begin = poses["since"].astype(float).fillna(poses["track"].map(first))
    event = [json.loads(each).get("event", "") for each in poses["document"]]
    by_time: pd.DataFrame = poses.assign(begin_s=begin, event=event).sort_values("begin_s")
    return by_time


def _moves(poses: pd.DataFrame, begin_s: float, end_s: float) -> Iterator[_Reason]:
    """Yield the moves: events of pose tracks, and poses that differ from the one before."""
    place, angles = (poses[list(names)].to_numpy(np.float64) for names in (POSITION, ANGLES))
    begin = poses["begin_s"].to_numpy(np.float64)
    step_m = np.linalg.norm(np.diff(place, axis=0), axis=1)
    turn_deg = np.abs((np.diff(angles, axis=0) + 180.0) % 360.0 - 180.0).max(axis=1)
    moved = (
        (poses["event"].to_numpy()[1:] == "moved") | (step_m > _MOVED_M) | (turn_deg > _MOVED_DEG)
    )
    for k in np.flatnonzero(moved & (begin[1:] > begin_s) & (begin[1:] < end_s)):
        text = "moved by {m} m and {deg}°" if step_m[k] >= _LEAST_STATED_M else "turned by {deg}°"
        words = tr(text, m=figure_text(step_m[k], 1), deg=figure_text(turn_deg[k], 1))
        yield _Reason(HealthState.MOVED, float(begin[k + 1]), words)


def _doubts(dataset: Dataset, sensor: str, end_s: float) -> Iterator[_Reason]:
    """Yield the doubt of the check of pose and recordings, unless it rests on later recordings."""
    finding = dataset.manifest.findings.get(sensor)
    if finding is None or not finding.doubt:
        return
    since = pd.to_datetime(finding.since, utc=True, errors="coerce")
    since_s = np.nan if pd.isna(since) else since.timestamp()
    if not since_s >= end_s:
        state = (
            HealthState.DOUBTFUL if finding.verdict in (WRONG, FITS) else HealthState.NOT_CONFIRMED
        )
        yield _Reason(
            HealthState.CLOCK_OFF if finding.is_of_clocks else state, since_s, tr(finding.text)
        )


def _clocks(recordings: pd.DataFrame, begin_s: float, end_s: float) -> Iterator[_Reason]:
    """Yield the largest clock offset that recordings of the month were corrected by."""
    inside = (recordings["last_time"] >= begin_s) & (recordings["first_time"] < end_s)
    off = recordings[inside & (recordings["clock_offset"].abs() > _CLOCK_OFF_S)]
    if len(off):
        offsets = off["clock_offset"].to_numpy(np.float64)
        most = float(offsets[np.abs(offsets).argmax()])
        words = tr("clock ahead by {s} s, corrected", s=figure_text(most, 3))
        yield _Reason(HealthState.CLOCK_OFF, float(off["first_time"].min()), words)


def _missing(gaps: Floats, share: float) -> Iterator[_Reason]:
    longest_s = gaps[:, 1].max(initial=0.0)
    if share < _LEAST_SHARE_SEEN or longest_s > _SILENT_S:
        yield _Reason(HealthState.GAPS, np.nan, "")  # the longest gap has columns of its own
