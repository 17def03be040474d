"""Limits of the readers: an input beyond them is damaged, or made to fill the memory.

All are far over what radars deliver; a file within them takes under 4 GiB.
"""

MOST_COLUMNS = 1000  # of a table; known radars have under 40, and each takes time in each batch
MOST_ROWS_OF_FRAME = 1 << 21  # of one time, 100 MiB of our columns: radars deliver some hundred
LONGEST_TEXT = 4096  # bytes of a text in a row: twice a screen
# Bytes of texts or lists in one column of one row group, as they are unpacked: a million rows of
# 500 bytes.
MOST_TEXT_BYTES = 1 << 29
# Of a cloud in a file of its own: `MOST_ROWS_OF_FRAME` of 128 bytes each.
MOST_FRAME_BYTES = 1 << 28
# Of one chunk of a bag when unpacked: writers close chunks at 1 to 4 MiB.
MOST_CHUNK_BYTES = 1 << 30
# Largest ratio of unpacked to packed size. Packets of a capture have times of their own, so that
# even empty ones reach 100 at most; files that are made to explode reach 1000.
MOST_EXPANSION = 200
FREE_EXPANSION_BYTES = 1 << 24  # up to which the ratio is not checked: a second of a radar
