"""Tile counts against sets of steps, and how a date is kept up to date."""

from dataclasses import replace

import numpy as np
import pytest
from datasets import BEGIN, HOUR, write_dataset
from hypothesis import given, settings
from hypothesis import strategies as st

from gis_radar.base import STEPS_PER_HOUR, InputError
from gis_radar.dataset import (
    STEPS_PER_QUARTER,
    TILE_COUNTS,
    HourWriter,
    Origin,
    TileCounts,
    open_dataset,
    part_path,
    read_hour,
    record_path,
    run_variance,
    write_record,
)
from gis_radar.dataset.files.tables import HITS, HOUR_TABLES, OBSERVED

RUNS = ("observed", "visible", "occupied")
COUNTS = [name for name in TILE_COUNTS.names if name.endswith("steps")]


def runs_of(draw, tile, within=None):
    """Draw disjoint runs of a tile around the quarters' edges, in steps of the hour."""
    edges = [0, STEPS_PER_QUARTER - 3, 3 * STEPS_PER_QUARTER, STEPS_PER_HOUR - 9]
    rows = []
    for edge in edges:
        cuts = sorted(draw(st.sets(st.integers(0, 8), max_size=4)))
        for low, high in zip(cuts[::2], cuts[1::2], strict=False):
            rows.append((tile, edge + low, edge + high - 1, draw(st.booleans())))
    return [row for row in rows if within is None or set(steps([row])) <= within]


def steps(rows):
    return [step for _, first, last, _ in rows for step in range(first, last + 1)]


@st.composite
def hours(draw):
    tables = {name: [] for name in ("hits", "observed", "visible", "occupied")}
    for tile in range(draw(st.integers(0, 12))):
        observed = runs_of(draw, tile)
        tables["observed"] += observed
        tables["visible"] += runs_of(draw, tile, set(steps(observed)))
        tables["occupied"] += runs_of(draw, tile)
        some = draw(st.sets(st.sampled_from(range(STEPS_PER_QUARTER - 3, STEPS_PER_QUARTER + 6))))
        tables["hits"] += [(tile, step) for step in sorted(some)]
    return tables


def written(folder, tables):
    rows = {"hits": {n: [row[i] for row in tables["hits"]] for i, n in enumerate(HITS.names)}}
    for name in RUNS:
        names = ["tile_id", "first_step", "last_step", "seen"]
        rows[name] = {n: [row[i] for row in tables[name]] for i, n in enumerate(names)}
    rows["observed"].pop("seen")
    for table in rows.values():
        for name in table:
            if "step" in name:
                table[name] = [step + BEGIN for step in table[name]]
    return write_dataset(folder, rows, hours=[HOUR])


def expected(tables):
    found = {}
    for tile in {row[0] for row in tables["observed"]}:
        of = {
            n: [r for r in tables[n] if r[0] == tile] for n in ("observed", "visible", "occupied")
        }
        observed, visible, occupied = (
            set(steps(of[n])) for n in ("observed", "visible", "occupied")
        )
        hit = {step for at, step in tables["hits"] if at == tile}
        inferred = set(steps([row for row in of["visible"] if not row[3]]))
        sets = {
            "hit_steps": hit & observed, "observed_steps": observed, "visible_steps": visible,
            "occupied_steps": occupied & visible, "hidden_steps": observed - visible,
            "inferred_steps": inferred,
        }  # fmt: skip
        for quarter in range(4):
            inside = range(quarter * STEPS_PER_QUARTER, (quarter + 1) * STEPS_PER_QUARTER)
            if observed & set(inside):
                row = {name: len(each & set(inside)) for name, each in sets.items()}
                found[tile, 88 + quarter] = [row[name] for name in COUNTS]
    return found


@given(hours())
@settings(max_examples=10)  # of tiles that know nothing of each other
def test_counts_are_those_of_sets_of_steps(tmp_path_factory, tables):
    dataset = written(tmp_path_factory.mktemp("counts") / "data", tables)
    counts = dataset.tile_counts()
    found = dict(
        zip(
            zip(counts["tile_id"], counts["interval"], strict=True),
            counts[COUNTS].to_numpy().tolist(),
            strict=True,
        )
    )
    assert found == expected(tables)


def test_the_variance_is_that_of_runs_cut_at_the_quarter(tmp_path):
    runs = {
        "observed": [(0, 0, STEPS_PER_HOUR - 1, True)], "hits": [],
        "visible": [(0, 0, 99, True), (0, 100, STEPS_PER_HOUR - 1, False)],
        "occupied": [(0, STEPS_PER_QUARTER - 30, STEPS_PER_QUARTER + 99, True)],
    }  # fmt: skip
    counts = written(tmp_path / "data", runs).tile_counts()
    lengths, seen = np.array([30, 100]), np.ones(2, np.bool_)
    wanted = run_variance(lengths, seen)
    assert counts["occupied_variance"].tolist() == pytest.approx([*wanted, 0, 0])
    assert wanted[0] == pytest.approx((0.16 * 30) ** 2 + 13.5**2)
    assert wanted[1] == pytest.approx(10**2 + 45.0**2)


def day_of(dataset):
    return part_path(dataset.folder, TILE_COUNTS, HOUR)


def make_again(dataset, hour, inputs, last=99):
    origin = Origin(fingerprint=dataset.manifest.fingerprint, method=1, inputs=inputs)
    begin = hour * STEPS_PER_HOUR
    run = {"tile_id": [3], "first_step": [begin], "last_step": [begin + last]}
    with HourWriter(folder=dataset.folder, hour=hour, origin=origin) as writer:
        for table in HOUR_TABLES:
            writer.write(table, run if table is OBSERVED else table.empty())


def update(dataset):
    TileCounts(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint).update(HOUR)


def test_rows_of_other_hours_are_carried_over(tmp_path):
    one, both = (write_dataset(tmp_path / name) for name in ("one", "both"))
    for dataset in (one, both):
        make_again(dataset, HOUR, "a")
        if dataset is one:
            update(one)
            record_path(one.folder, HOUR).rename(tmp_path / "record")
            part_path(one.folder, OBSERVED, HOUR).rename(tmp_path / "part")
            (tmp_path / "record").rename(record_path(one.folder, HOUR))
        make_again(dataset, HOUR + 1, "b")
        update(dataset)  # of one, without the exact table of the first hour
    assert day_of(one).read_bytes() == day_of(both).read_bytes()
    assert both.tile_counts()["interval"].tolist() == [88, 92]


def test_hours_whose_counts_are_old_are_counted_when_they_are_read(tmp_path):
    dataset = write_dataset(tmp_path / "data")
    make_again(dataset, HOUR, "a")
    update(dataset)
    make_again(dataset, HOUR, "b", last=49)
    make_again(dataset, HOUR + 1, "b")
    assert dataset.tile_counts()["observed_steps"].tolist() == [50, 100]
    day_of(dataset).write_bytes(b"PAR1")
    assert dataset.tile_counts()["observed_steps"].tolist() == [50, 100]
    update(dataset)
    assert dataset.tile_counts(begin="2023-11-14T23:00Z")["interval"].tolist() == [92]


def test_a_date_without_hours_has_no_counts(tmp_path):
    dataset = write_dataset(tmp_path / "data", hours=[HOUR])
    assert day_of(dataset).exists()
    record_path(dataset.folder, HOUR).unlink()
    update(dataset)
    assert not day_of(dataset).exists()
    assert open_dataset(dataset.folder).tile_counts().empty


def test_counts_stay_when_exact_tables_are_deleted(tmp_path):
    dataset = write_dataset(tmp_path / "data")
    make_again(dataset, HOUR, "a")
    update(dataset)
    record = read_hour(dataset.folder, HOUR)
    write_record(dataset.folder, replace(record, dropped=tuple(record.parts)))
    for table in HOUR_TABLES:
        part_path(dataset.folder, table, HOUR).unlink()
    make_again(dataset, HOUR + 1, "b")
    update(dataset)
    assert dataset.tile_counts()["observed_steps"].tolist() == [100, 100]
    dataset.check()
    with pytest.raises(InputError, match="deleted after the time to keep exact tables") as refused:
        dataset.hits()
    assert "tile_counts" in refused.value.hint
    assert len(dataset.hits(begin="2023-11-14T23:00Z")) == 0
