"""A heat map as GeoParquet."""

from __future__ import annotations

from pathlib import Path

from gis_radar.heatmap.layers import wide_layer
from gis_radar.heatmap.tally import Tally
from gis_radar.progress import Reporter


def write_table(tally: Tally, path: Path, _reporter: Reporter) -> None:
    """Write the layer `heatmap` as GeoParquet 1.1 with a box for each row.

    Parameters
    ----------
    tally : Tally
        What to write.
    path : Path
        The file.
    """
    frame = wide_layer(tally)
    frame.attrs = tally.metadata
    frame.to_parquet(
        path,
        index=False,
        compression="zstd",
        schema_version="1.1.0",
        write_covering_bbox=True,
        write_page_checksum=True,  # a flipped bit is found on reading
    )
