"""Measure data quality: a row for each sensor and hour, with a verdict in words.

The verdicts are those that freeway operators use for loop detectors (PeMS), adapted to radar: no
data, too few samples, never hit, hit too much, constant, and hits without motion.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from gis_radar.base import (
    CLOCK_SET_S,
    QUIET,
    InputError,
    Reporter,
    Text,
    UsageError,
    atomic_write,
    csv_for,
    in_language,
    iso_from_time,
    seconds_from_iso,
    table_card,
    tr,
    write_csv,
    zone_of,
)
from gis_radar.dataset import FRAMES, Dataset, hour_text, open_dataset
from gis_radar.products.quality.counting import HIGH, HOUR_S, count_frames, frame_times

GOOD = "good"
_DAYS = (
    Text("Monday"), Text("Tuesday"), Text("Wednesday"), Text("Thursday"), Text("Friday"),
    Text("Saturday"), Text("Sunday"),
)  # fmt: skip
_NO_DATA = "no data"
_DIGITS = 6  # of numbers in CSV: far below their errors

# Limits beyond which the hour of a sensor has a fault, after those of loop detectors (PeMS, Chen et
# al. 2003), and far from the values of simulated sites. Shares are of the frames, if not stated.
_LEAST_SHARE = 0.6  # share received of the frames expected
_HIGH_SHARE = 0.2  # share with more than `counting.HIGH` of the seen tiles hit
_LEAST_MOVING = 0.001  # moving share of the detections: a street at night has some
_MOST_DOUBLED = 0.05  # share that follows within half a cycle
_MOST_REPEATED = 0.2  # share with the positions of the frame before
_MOST_WILD = 0.02  # share of the detections faster than any vehicle: noise gives some
_FRAMES_JUDGED = 100  # with fewer frames (5 s at 20 Hz) only their number is judged


def faults_of(count: Any) -> Iterator[str]:
    """Yield the faults of a sensor in an hour, worst first.

    Parameters
    ----------
    count : row of count_frames
        Counts of its frames in that hour.
    """
    if count.frames == 0:
        yield _NO_DATA
        return
    single = count.frames - count.doubled
    expected = single + count.dropped
    if single < _LEAST_SHARE * expected:
        yield Text("{:.0f} % of the frames expected", 100 * single / expected)
    if count.hour < CLOCK_SET_S:
        yield "clock not set"
    if count.frames >= _FRAMES_JUDGED:
        yield from _faults_of_frames(count)


def _faults_of_frames(count: Any) -> Iterator[str]:
    if count.doubled > _MOST_DOUBLED * count.frames:
        yield Text("{:.0f} % of the frames come twice", 100 * count.doubled / count.frames)
    if count.repeated > _MOST_REPEATED * count.frames:
        yield Text(
            "frozen: {:.0f} % of the frames repeat the last", 100 * count.repeated / count.frames
        )
    if count.detections == 0:
        yield "all frames are empty"
        return
    if count.seen == 0:
        yield "sees no tile"
    elif count.hits == 0:
        yield "no tile is ever hit"
    elif count.high > _HIGH_SHARE * count.frames:
        yield Text(
            "over {:.0f} % of its tiles hit in {:.0f} % of the frames",
            100 * HIGH,
            100 * count.high / count.frames,
        )
    elif count.fewest == count.most:
        yield "hit share is constant"
    if count.hits and count.moving < _LEAST_MOVING * count.detections:
        yield "hits without motion"
    if count.wild > _MOST_WILD * count.detections:
        yield Text(
            "{:.0f} % of the detections are absurdly fast", 100 * count.wild / count.detections
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class Quality:
    """Data quality of a dataset, by sensor and hour.

    Parameters
    ----------
    table : DataFrame
        A row for each sensor and hour: `sensor`; `begin`, `end` (UTC); `date`, `hour`, `weekday`
        of local time; `frames_expected`, `frames`, `dropped`, `doubled`, `repeated`;
        `detections_per_frame`, `moving_share`, `wild_share`; `tiles_hit_share`, the mean share
        of the seen tiles hit in a frame; `clock_offset_s`, by which the clock was corrected;
        `pose`, `pose_age_h`; `verdict`, "good" or the faults.
    timezone : str
        Time zone of the local hours.
    without_elevation : frozenset of str
        Sensors that measure no elevation.
    verdicts : mapping
        The verdicts as texts that can be translated, by the text in the table.
    """

    table: pd.DataFrame
    timezone: str
    without_elevation: frozenset[str] = frozenset()
    verdicts: Mapping[str, str] = field(default_factory=dict)

    def verdict(self, text: str) -> str:
        """Return a verdict of the table as a text that can be translated."""
        return self.verdicts.get(text, text)

    def figures(self) -> dict[str, str]:
        """Return a line for each sensor: how many hours are good, and the faults of the others."""
        lines: dict[str, str] = {}
        for sensor, rows in self.table.groupby("sensor"):
            good = int((rows["verdict"] == GOOD).sum())
            bad = rows.loc[rows["verdict"] != GOOD, "verdict"].value_counts()
            wrong = [Text("{} ({} h)", self.verdict(str(t)), hours) for t, hours in bad.items()]
            level = ["measures no elevation"] if sensor in self.without_elevation else []
            hours_good = Text("{} of {} hours good", good, len(rows))
            lines[str(sensor)] = Text("; ").join([hours_good, *level, *wrong])
        return lines

    def warnings(self) -> list[str]:
        """Return one line for each sensor that is not good throughout."""
        bad, hours = self.table[self.table["verdict"] != GOOD], self.table["sensor"].value_counts()
        return [
            Text(
                "{}: {} in the hour from {}; {} of its {} hours are not good",
                sensor,
                self.verdict(rows["verdict"].iloc[0]),
                f"{rows['begin'].iloc[0]:%Y-%m-%dT%H:%MZ}",
                len(rows),
                hours[sensor],
            )
            for sensor, rows in bad.groupby("sensor")
        ]

    def write(self, path: str | Path, *, csv_locale: str = "en") -> Path:
        """Write the table as CSV (times as ISO 8601 with Z) or Parquet, by the file's ending.

        Parameters
        ----------
        path : str or Path
            The file.
        csv_locale : str
            `de` writes CSV for German spreadsheets: semicolons, decimal commas, the byte order mark
            of UTF-8, and weekday and verdict in German.

        Raises
        ------
        UsageError
            If the ending is another, or there is no such locale.
        OutputError
            If the place cannot be written.
        """
        path = Path(path)
        require_table_name(path)
        language = "de" if csv_locale == "de" else "en"  # not that of the terminal
        with csv_for(csv_locale), in_language(language), atomic_write(path) as part:
            if path.suffix.lower() == ".csv":
                self.write_rows(part)
            else:
                self.table.to_parquet(part, index=False)
        return path

    def write_rows(self, path: Path) -> None:
        """Write the table as CSV in the format of a report's tables, its words in its language."""
        shown = {name: self.table[name].map(iso_from_time) for name in ("begin", "end")}
        shown["weekday"] = self.table["weekday"].map(tr)
        shown["verdict"] = self.table["verdict"].map(lambda text: tr(self.verdict(text)))
        write_csv(path, self.table.assign(**shown).round(_DIGITS))

    def _repr_html_(self) -> str:
        columns = ["sensor", "date", "hour", "frames", "frames_expected", "verdict"]
        title = f"Quality by sensor and hour ({self.timezone})"
        return table_card(title, columns, self.table[columns].to_numpy(object).tolist())

    def __repr__(self) -> str:
        lines = "; ".join(f"{sensor}: {text}" for sensor, text in self.figures().items())
        return f"Quality({lines})"


def require_table_name(path: str | Path) -> None:
    """Refuse a file name whose suffix is neither that of CSV nor of Parquet."""
    if Path(path).suffix.lower() not in {".csv", ".parquet"}:
        raise UsageError("{}: not a known table format", path, hint="use .csv or .parquet")


def measure_quality(
    dataset: Dataset | str | Path,
    *,
    timezone: str | None = None,
    reporter: Reporter = QUIET,
) -> Quality:
    """Measure the quality of a dataset's frames by sensor and hour, and judge it.

    Parameters
    ----------
    dataset : Dataset, str or Path
        From :func:`gis_radar.open_dataset`, or its folder.
    timezone : str, optional
        Time zone of hours, days and weekdays, such as Europe/Berlin; by default the dataset's.
    reporter : Reporter
        Receives the progress.

    Raises
    ------
    UsageError
        If there is no such time zone.
    InputError
        If the dataset holds no frame.

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    >>> pose = gr.read_pose(sample / "R1.json")
    >>> ds = gr.measure([sample / "R1.parquet"], [pose], tiles, sample / "junction.osm", "site")
    >>> gr.measure_quality(ds)
    Quality(R1: 1 of 1 hours good)
    """
    dataset = open_dataset(dataset, reporter=reporter)
    timezone = timezone or dataset.timezone
    zone = zone_of(timezone)
    times = frame_times(dataset)
    dropped_hours = [
        hour for hour, each in dataset.records().items() if FRAMES.name in each.dropped
    ]
    hint = Text("measuring was interrupted, or recordings are empty")
    if dropped_hours:
        hint = Text(
            "frames up to {} were deleted after the time to keep", hour_text(max(dropped_hours) + 1)
        )
    if not times:
        raise InputError("{}: holds no frame", dataset.folder, hint=hint)
    if dropped_hours:
        reporter.warn("{}: {}, and are not judged", dataset.folder, hint)
    counts = count_frames(dataset, times, zone, reporter)
    poses = _poses_by_sensor(dataset.poses())
    # Hours before the first frame of a sensor have no row.
    since_first_frame = counts["frames"].gt(0).groupby(counts["sensor"]).cummax()
    rows = [_row(each, poses, zone) for each in counts[since_first_frame].itertuples()]
    recordings = dataset.recordings()
    without_elevation = set(recordings.loc[~recordings["has_elevation"], "sensor"])
    verdicts = {row["verdict"]: row["verdict"] for row in rows}
    return Quality(
        table=pd.DataFrame(rows), timezone=timezone,
        without_elevation=frozenset(without_elevation), verdicts=verdicts,
    )  # fmt: skip


Poses = list[tuple[float, str]]


def _poses_by_sensor(table: pd.DataFrame) -> dict[str, Poses]:
    """Return by sensor the times (s) at which its poses were found, or NaN, and their texts."""
    by_sensor: dict[str, set[tuple[float, str]]] = {}
    for document in table["document"]:
        pose = json.loads(document)
        text = ", ".join(
            f"{pose[name]:.2f} {unit}"
            for name, unit in (("easting", "E"), ("northing", "N"), ("height", "m"))
        )
        angles = " ".join(f"{name} {pose[name]:.2f}" for name in ("yaw", "pitch", "roll"))
        by_sensor.setdefault(pose["sensor"], set()).add((_time_of(pose), f"{text}, {angles}"))
    return {  # those of known times first; two NaN do not compare
        sensor: sorted(poses, key=lambda pose: (np.isnan(pose[0]), np.nan_to_num(pose[0]), pose[1]))
        for sensor, poses in by_sensor.items()
    }


def _time_of(pose: dict[str, Any]) -> float:
    try:
        return seconds_from_iso(str(pose["time"]), what=Text("time of a pose"))
    except (KeyError, InputError):
        return float("nan")


def _pose_at(poses: Poses, second: int) -> tuple[str, float]:
    """Return the pose that was in force, and its age in hours."""
    if not poses:
        return "", float("nan")
    begun = [pose for pose in poses if pose[0] < second + HOUR_S] or poses[:1]
    since, text = begun[-1]
    return text, (second - since) / HOUR_S


def _row(count: Any, poses: Mapping[str, Poses], zone: ZoneInfo) -> dict[str, Any]:
    begin = pd.Timestamp(count.hour, unit="s", tz=UTC)
    local = begin.tz_convert(zone)
    pose, age_h = _pose_at(poses.get(count.sensor, []), count.hour)
    frames, detections = max(count.frames, 1), max(count.detections, 1)
    nothing = count.frames == 0
    return {
        "sensor": count.sensor,
        "begin": begin,
        "end": pd.Timestamp(count.hour + HOUR_S, unit="s", tz=UTC),
        "date": f"{local:%Y-%m-%d}",
        "hour": local.hour,
        "weekday": _DAYS[local.weekday()],
        "frames_expected": count.frames - count.doubled + count.dropped,
        "frames": count.frames,
        "dropped": count.dropped,
        "doubled": count.doubled,
        "repeated": count.repeated,
        "detections_per_frame": np.nan if nothing else count.detections / frames,
        "moving_share": np.nan if count.detections == 0 else count.moving / detections,
        "wild_share": np.nan if count.detections == 0 else count.wild / detections,
        "tiles_hit_share": np.nan if nothing or count.seen == 0 else count.share / frames,
        "clock_offset_s": np.nan if nothing else -count.shift_us / frames / 1e6,
        "pose": pose,
        "pose_age_h": age_h,
        "verdict": Text("; ").join(faults_of(count)) or GOOD,
    }
