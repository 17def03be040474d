"""A sensor in the site file: what it recorded, where it stands, what it sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gis_radar.site.kinds import (
    BEARING,
    CYCLE,
    FILE,
    PAIRS,
    POSITION,
    RECORDINGS,
    SENSOR_NAME,
    TEXT,
    Unfit,
    choice,
    number,
)
from gis_radar.site.schema import key, optional_table

READ_AS_THEY_ARE = (".parquet", ".csv")


@dataclass(frozen=True, kw_only=True)
class ViewPart:
    """What a sensor sees: full opening angles about its x axis, and a range."""

    azimuth_deg: float = key(
        number("degrees, 0 to 360", 1e-3, 360.0), "Full azimuth.", example="120.0", default=120.0
    )
    elevation_deg: float = key(
        number("degrees, 0 to 180", 1e-3, 180.0), "Full elevation.", example="30.0", default=30.0
    )
    min_range_m: float = key(
        number("metres, 0 or more", 0.0, 1e5), "Least slant range.", example="1.0", default=1.0
    )
    max_range_m: float = key(
        number("metres, over 0", 1e-3, 1e5), "Greatest slant range.", example="300.0", default=300.0
    )

    def __post_init__(self) -> None:
        if not self.min_range_m < self.max_range_m:
            raise Unfit(
                f"min_range_m is {self.min_range_m:g} and max_range_m {self.max_range_m:g}, "
                "expected ascending"
            )


@dataclass(frozen=True, kw_only=True)
class ConvertPart:
    """How its recordings are read, where they are not ours: as `gis-radar convert` takes it."""

    sensor: str | None = key(
        TEXT, "Which sensor, where the files have several.",
        example='"10.13.1.113"', default=None, shown="the only one",
    )  # fmt: skip
    columns: Mapping[str, str] | None = key(
        PAIRS, "Our columns and the fields of a table or cloud; a minus turns the sign.",
        example='{ x = "X", range_rate = "-doppler" }', default=None, shown="known by name",
    )  # fmt: skip
    time_unit: str = key(
        choice("s", "ms", "us", "ns"), "Of the times in a table, since 1970.",
        example='"ms"', default="s",
    )  # fmt: skip
    clock: str = key(
        choice("auto", "sensor", "recorder"),
        "Whose times count; auto takes the sensor's where they are right.",
        example='"auto"', default="auto",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A radar: what it recorded, and its pose or a rough guess of it."""

    name: str = key(SENSOR_NAME, "Its name, also that of its folders.", example='"R1"')
    recordings: tuple[Path, ...] = key(
        RECORDINGS, "What it recorded, in one piece or many; other formats are converted.",
        example='["R1_*.parquet"]',
    )  # fmt: skip
    guess: tuple[float, ...] | None = key(
        POSITION, "Where it stands, within 15 m, in the map frame: its pose is found.",
        example="[690356.0, 5336183.0]", default=None, shown="none",
    )  # fmt: skip
    heading: float | None = key(
        number("degrees"), "Yaw within 25 deg: from grid east, anticlockwise.",
        example="20.0", default=None, shown="searched",
    )  # fmt: skip
    compass: float | None = key(
        BEARING, "The same as a bearing, clockwise from true north.",
        example='"north-east"', default=None, shown="searched",
    )  # fmt: skip
    method: str = key(
        choice("lane", "icp"), "How the pose is found: lanes and Doppler, or the paper's ICP.",
        example='"lane"', default="lane",
    )  # fmt: skip
    pose: Path | None = key(
        FILE, "Its pose (JSON) or pose track (CSV), instead of a guess.",
        example='"R2.json"', default=None, shown="none",
    )  # fmt: skip
    cycle: float | Literal["auto"] | None = key(
        CYCLE, "Of a sensor under 20 Hz, the time from frame to frame: a frame covers it.",
        example='"57ms"', default=None, shown="a frame covers its step",
    )  # fmt: skip
    view: ViewPart | None = optional_table(
        ViewPart, "What it sees, where its pose does not say; without it 120 by 30 deg, 1 to 300 m."
    )

    convert: ConvertPart | None = optional_table(
        ConvertPart, "How recordings are converted; with it, Parquet and CSV files are, too."
    )

    @property
    def foreign(self) -> tuple[Path, ...]:
        """The recordings that must be converted."""
        return tuple(
            path
            for path in self.recordings
            if self.convert is not None or path.suffix.lower() not in READ_AS_THEY_ARE
        )

    def __post_init__(self) -> None:
        if self.guess is None and self.pose is None:
            raise Unfit(
                "has neither guess nor pose",
                hint="guess = [E, N] within 15 m, in the map frame, or pose = a pose file",
            )
        if self.guess is not None and self.pose is not None:
            raise Unfit("has both guess and pose", hint="a pose needs no guess: keep one of them")
        if self.heading is not None and self.compass is not None:
            raise Unfit("has both heading and compass", hint="keep one of them")
        if self.pose is not None and (self.heading is not None or self.compass is not None):
            raise Unfit("has a pose and a heading", hint="a heading helps a guess only")
