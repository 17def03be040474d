"""Compare the datasets of two versions: each table of each hour, row by row.

`python bench/dataset_same.py --before FOLDER`, where FOLDER is a checkout of the other version. The
sites are those of `../shared/data`, as far as they are there, and the sample. Tables of the hour
and of the day are compared by the columns that both versions have; exit code 1 where rows differ.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from dataset import Versions
from simulated import sites


def main() -> None:
    """Compare all sites."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, required=True, help="checkout of another version")
    parser.add_argument("--only", nargs="*", help="names of sites")
    options = parser.parse_args()
    differ = []
    with tempfile.TemporaryDirectory() as scratch:
        versions = Versions(Path(scratch), options.before.resolve())
        for of in sites("town01", "town02", "town04"):
            if options.only and of.name not in options.only:
                continue
            given = versions.sample if of == sites()[0] else versions.site(of)
            now, before = (
                versions.run(given, *root)[1] for root in ((), (options.before.resolve(),))
            )
            differ += [f"{of.name}: {line}" for line in differences(before, now)]
    if differ:
        sys.exit("\n".join(differ))


def differences(before: Path, now: Path) -> list[str]:
    """Return a line for each table that differs or is missing; print what each holds."""
    names = sorted({path.relative_to(of) for of in (before, now) for path in of.rglob("*.parquet")})
    lines = []
    for name in names:
        if not ((before / name).exists() and (now / name).exists()):
            lines.append(f"{name}: only {'now' if (now / name).exists() else 'before'}")
            continue
        old, new = (pq.ParquetFile(of / name).read() for of in (before, now))
        columns = [each for each in old.column_names if each in new.column_names]
        equal = _rows(old, columns).equals(_rows(new, columns))
        verdict = "equal" if equal else "DIFFER"
        print(f"{name}: before {len(old):,}, now {len(new):,} rows: {verdict}")
        if not equal:
            lines.append(f"{name}: rows differ")
    return lines


def _rows(table: pa.Table, columns: list[str]) -> pa.Table:
    return table.select(columns).replace_schema_metadata()


if __name__ == "__main__":
    main()
