"""Recordings of a simulated radar: times of frames, their detections, compact Parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.base import Floats, atomic_write
from simulation.movement import Traffic
from simulation.radar import Radar

COLUMNS = ("x", "y", "z", "range_rate", "rcs")


def frame_times(
    start: float,
    duration_s: float,
    *,
    rng: np.random.Generator,
    cycle_s: Sequence[float] = (0.05,),
    jitter_s: float = 0.001,
    dropped: float = 0.0,
    doubled: float = 0.0,
) -> Floats:
    """Return the times of a radar's frames, UNIX seconds to the microsecond, ascending.

    Parameters
    ----------
    start : float
        UNIX seconds of the first frame, or before it where the cycle has several times.
    duration_s : float
        Frames begin within this time.
    rng : Generator
        Random numbers.
    cycle_s : sequence of float
        Times between frames, in turn; with several the recording begins anywhere in the cycle.
    jitter_s : float
        Standard deviation of each time.
    dropped, doubled : float
        Shares of frames that are missing, and that are followed by another after 5-15 ms.
    """
    whole_s, turns = float(np.sum(cycle_s)), len(cycle_s)
    entered_s = rng.uniform(0.0, whole_s) if turns > 1 else 0.0
    count = int(np.ceil((duration_s + entered_s) / whole_s)) * turns
    jitter = np.clip(rng.normal(0.0, jitter_s, count), -3 * jitter_s, 3 * jitter_s)
    jitter[0] = 0.0
    within = np.concatenate([[0.0], np.cumsum(cycle_s)[:-1]])
    round_, turn = np.divmod(np.arange(count), turns)
    offset = round_ * whole_s + within[turn] - entered_s + jitter
    kept = offset[(rng.random(count) >= dropped) | (np.arange(count) == 0)]
    again = kept[rng.random(len(kept)) < doubled]
    times = np.sort(np.concatenate([kept, again + rng.uniform(0.005, 0.015, len(again))]))
    inside = times[(times >= 0.0) & (times < duration_s)]
    return np.round(start + inside, 6)


def simulate_recording(
    radar: Radar,
    traffic: Traffic,
    times: Floats,
    *,
    rng: np.random.Generator,
    blank_frames: int = 0,
) -> pd.DataFrame:
    """Return a recording: the frames of a radar at the given times.

    Parameters
    ----------
    radar : Radar
        The sensor in its scene.
    traffic : Traffic
        The road users.
    times : (n,) array
        UNIX seconds, ascending.
    rng : Generator
        Random numbers.
    blank_frames : int
        Number of random frames without detections.

    Returns
    -------
    DataFrame
        ``time`` float64; ``x y z`` (m, sensor frame), ``range_rate`` (m/s), ``rcs`` (dBm2)
        float32. A frame without detections is one row of NaN.
    """
    blank = set(rng.choice(len(times), blank_frames, replace=False).tolist())
    nothing, quantum = np.full((1, len(COLUMNS)), np.nan), np.array(radar.model.quantum)
    frames = []
    for number, time in enumerate(times):
        frame = radar.frame(traffic.at(float(time)), rng)
        frame = np.rint(frame / quantum) * quantum
        empty = number in blank or len(frame) == 0
        frames.append(nothing if empty else frame[np.lexsort(frame[:, ::-1].T)])
    values = np.vstack(frames).astype(np.float32)
    stamps = np.repeat(times, [len(frame) for frame in frames])
    return pd.DataFrame({"time": stamps, **dict(zip(COLUMNS, values.T, strict=True))})


def write_recording(recording: pd.DataFrame, path: Path) -> None:
    """Write a recording as Parquet, small and with page checksums, whole or not at all."""
    write_packed(recording, path, repeated=("time",))


def write_packed(table: pd.DataFrame, path: Path, *, repeated: tuple[str, ...]) -> None:
    """Write a table of numbers as small Parquet with page checksums, whole or not at all.

    Parameters
    ----------
    table : DataFrame
        The table; columns of text must be in `repeated`.
    path : Path
        The file.
    repeated : tuple of str
        Columns with few distinct values, written as a dictionary.
    """
    split = [name for name in table.columns if name not in repeated]
    with atomic_write(path) as part:
        pq.write_table(
            pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(None),
            part,
            compression="zstd",
            compression_level=19,
            use_dictionary=list(repeated),
            column_encoding=dict.fromkeys(split, "BYTE_STREAM_SPLIT"),
            write_page_checksum=True,
        )
