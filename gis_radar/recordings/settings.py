"""Settings of the readers: how much an input may ask for before it is refused."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ReaderSettings:
    """Limits of the readers: an input beyond them is damaged, or made to fill the memory.

    All are far over what radars deliver; a file within them takes under 4 GiB.

    Parameters
    ----------
    most_columns : int
        Columns of a table; those of known radars have under 40, and each takes time in each batch.
    most_rows_of_frame : int
        Detections of one time, 100 MiB of our columns: radars deliver some hundred.
    longest_text : int
        Bytes of a text in a row: twice a screen.
    most_text_bytes : int
        Bytes of texts or lists in one column of one row group, as they are unpacked: a million
        rows of 500 bytes.
    most_frame_bytes : int
        Bytes of one cloud in a file of its own: `most_rows_of_frame` of 128 bytes each.
    most_chunk_bytes : int
        Bytes of one chunk of a bag when unpacked: writers close chunks at 1 to 4 MiB.
    most_expansion : int
        Largest ratio of unpacked to packed size. Packets of a capture have times of their own, so
        that even empty ones reach 100 at most; files that are made to explode reach 1000.
    free_expansion_bytes : int
        Unpacked bytes up to which the ratio is not checked: a second of a radar.
    """

    most_columns: int = 1000
    most_rows_of_frame: int = 1 << 21
    longest_text: int = 4096
    most_text_bytes: int = 1 << 29
    most_frame_bytes: int = 1 << 28
    most_chunk_bytes: int = 1 << 30
    most_expansion: int = 200
    free_expansion_bytes: int = 1 << 24


DEFAULTS = ReaderSettings()
