"""A dataset as the modules that compute from its tables read it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, TypeAlias

import geopandas as gpd
import pandas as pd
import pyarrow as pa
import pyogrio

from gis_radar.base import (
    STEPS_PER_HOUR,
    InputError,
    UsageError,
    opened_package,
    step_at,
    zone_of,
)
from gis_radar.dataset.files.manifest import TILES_FILE, Manifest, tiles_of_dataset
from gis_radar.dataset.files.parts import MEASURE_AGAIN, hour_of_step, hour_text, single_file
from gis_radar.dataset.files.pose_book import PoseBook
from gis_radar.dataset.files.records import HourRecord, Span, hour_bounds, read_hours
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.stated_lanes import with_stated
from gis_radar.dataset.files.tables import CONTINUED, POSES, RECORDINGS, SIGHTS
from gis_radar.dataset.files.units import convert_units
from gis_radar.hdmap import LANES_LAYER, TILES_LAYER

Moment: TypeAlias = str | datetime | int | None
"""A time as ISO 8601 text or with its zone; without one by the clocks of the site; or a step."""


_BATCH = 256  # lanes read at once, for which GDAL takes memory even if there are few
_LAST_STEP = 1 << 62  # of a span without an end
# Steps of 1985 to 2128; UNIX seconds, given in place of steps, are smaller numbers.
_STEPS_TODAY = range(10_000_000_000, 100_000_000_000)


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetFiles:
    """Files of a dataset, for the modules that compute from its tables; fields as in `Dataset`."""

    folder: Path
    manifest: Manifest
    cache: dict[Any, Any] = field(default_factory=dict, repr=False)
    _layers: dict[str, gpd.GeoDataFrame] = field(default_factory=dict, repr=False)

    @property
    def crs(self) -> str:
        """Coordinate system of the map frame."""
        return self.manifest.crs

    @property
    def timezone(self) -> str:
        """Time zone of the site."""
        return self.manifest.timezone

    @property
    def has_vehicles(self) -> bool:
        """Whether vehicles were looked for, so that there are tracks and occupancy."""
        return bool(self.manifest.settings.get("vehicles"))

    def records(self, span: Span | None = None) -> dict[int, HourRecord]:
        """Read the records of the complete hours, all or those with steps of a span.

        Raises
        ------
        InputError
            If an hour was made from other tiles.
        """
        first, last = (None, None) if span is None else map(hour_of_step, span)
        records = read_hours(self.folder, first, last)
        for record in records.values():
            if record.origin.fingerprint != self.manifest.fingerprint:
                raise InputError(
                    "{}: {} was made from other tiles",
                    self.folder,
                    hour_text(record.hour),
                    hint=MEASURE_AGAIN,
                )
        return records

    def span(self, begin: Moment = None, end: Moment = None) -> Span | None:
        """Return the first and the last step from `begin` up to `end`; None for all.

        Raises
        ------
        UsageError
            If one is not a time, or the end is not after the begin.
        """
        if begin is None and end is None:
            return None
        first, after = (self._step(each, what) for each, what in ((begin, "begin"), (end, "end")))
        span = (0 if first is None else first, (_LAST_STEP if after is None else after) - 1)
        if span[0] > span[1]:
            raise UsageError("end {} is not after begin {}", end, begin)
        return span

    def batches(
        self, table: TableSchema, span: Span | None = None, columns: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """Read the rows of a table, an hour (or date) at a time."""
        raise NotImplementedError

    def continued(self) -> pd.DataFrame:
        """Read the pairs of numbers of one vehicle on either side of an hour's begin."""
        return self._read(CONTINUED, None, None)

    def poses(self) -> gpd.GeoDataFrame:
        """Read the poses of the sensors."""
        table = self._read_single(POSES)
        places = gpd.points_from_xy(table["easting"], table["northing"], table["height"])
        return gpd.GeoDataFrame(table, geometry=places, crs=self.crs)

    def sights(self) -> pd.DataFrame:
        """Read the tiles in sight of each pose."""
        return self._read_single(SIGHTS)

    def layer(self, name: str) -> gpd.GeoDataFrame:
        """Read a layer of the tiles: `tiles`, `lanes` or `stop_lines`; each is read once."""
        if name not in self._layers:
            tiles = tiles_of_dataset(self.folder, self.manifest)  # refuses a file with other tiles
            layer = tiles if name == TILES_LAYER else self._other_layer(name)
            self._layers[name] = with_stated(layer, self.folder) if name == LANES_LAYER else layer
        return self._layers[name].copy()

    def _other_layer(self, name: str) -> gpd.GeoDataFrame:
        with opened_package(self.folder / TILES_FILE, what="the tiles of a dataset") as place:
            if name not in pyogrio.list_layers(place)[:, 0]:
                require_vehicles(self)
            return pyogrio.read_dataframe(place, layer=name, use_arrow=True, batch_size=_BATCH)

    def _read(self, table: TableSchema, begin: Moment, end: Moment) -> pd.DataFrame:
        parts = list(self.batches(table, self.span(begin, end)))
        rows = pa.concat_tables(parts) if parts else table.empty()
        return convert_units(rows, self.manifest.origin)

    def _read_single(self, table: TableSchema) -> pd.DataFrame:
        return convert_units(self.single_table(table), self.manifest.origin)

    def single_table(self, table: TableSchema) -> pa.Table:
        """Read a table that is one file, with its columns: recordings, poses or sights."""
        fingerprint = self.manifest.fingerprint
        if table in (POSES, SIGHTS):  # refuses those of another run
            recordings = single_file(RECORDINGS, self.folder, fingerprint)
            PoseBook.read(self.folder, fingerprint, recordings.read(["pose", "sights", "path"]))
        return single_file(table, self.folder, fingerprint).read()

    def _step(self, value: Moment, what: str) -> int | None:
        if isinstance(value, int) and value not in _STEPS_TODAY:
            raise UsageError(
                "{} is {}, which is no step of 50 ms since 1970", what, value,
                hint="give a time such as 2026-11-20 09:00",
            )  # fmt: skip
        if value is None or isinstance(value, int):
            return value
        return step_at(value, zone_of(self.manifest.timezone), what=what)


class NoVehiclesError(InputError):
    """A dataset in which vehicles were not looked for."""


def require_vehicles(dataset: DatasetFiles) -> None:
    """Refuse a dataset in which vehicles were not looked for."""
    if not dataset.has_vehicles:
        raise NoVehiclesError(
            "{}: holds no vehicles", dataset.folder, hint="measure it again, with vehicles"
        )


class NotMeasuredError(InputError):
    """A time of which a dataset has no complete hour, or only days that do not count."""


def require_measured(dataset: DatasetFiles, span: Span | None) -> Span:
    """Return the first and the last step of the complete hours that a span touches.

    Raises
    ------
    NotMeasuredError
        If there are none.
    """
    hours = (None, None) if span is None else map(hour_of_step, span)
    if (bounds := hour_bounds(dataset.folder, *hours)) is None:
        raise NotMeasuredError(
            "{}: nothing was measured in that time", dataset.folder,
            hint="gis-radar dataset shows from when to when it was measured",
        )  # fmt: skip
    return bounds[0] * STEPS_PER_HOUR, (bounds[1] + 1) * STEPS_PER_HOUR - 1
