"""Roll-ups hold the sums of the day tables, as pandas sums them, and are kept up to date."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from months import draw_days, drawn_months, hour_at, roll_up

from gis_radar.base import InputError, UsageError
from gis_radar.dataset import HourWriter, Origin, open_dataset, read_hours
from gis_radar.dataset.files.tables import HOUR_TABLES, LANE_MONTHS, MONTH_TABLES, TILE_MONTHS

# Around the end of a month and of summer time, with gaps.
HOURS = [
    *range(hour_at("2026-10-24T20"), hour_at("2026-10-25T04")),
    *range(hour_at("2026-10-31T20"), hour_at("2026-11-01T02")),
    *range(hour_at("2026-11-08T22"), hour_at("2026-11-09T02")),
]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return drawn_months(tmp_path_factory.mktemp("months") / "data", HOURS)


@pytest.fixture
def dataset(tmp_path, drawn):
    shutil.copytree(drawn.folder, tmp_path / "data")
    return open_dataset(tmp_path / "data")


def lane_oracle(dataset):
    rows = dataset.lane_measures()
    local = rows["begin"].dt.tz_convert(dataset.timezone)
    rows = rows.assign(month=local.dt.strftime("%Y-%m"), weekday=local.dt.day_of_week)
    rows = rows.assign(hour=local.dt.hour, quarters=rows["volume"].notna())
    area, share = rows["visible_km_h"], rows["visible_share"]
    rows["visible_s"] = share.astype(float) * 900
    rows["volume_variance"] = rows["volume_se"].astype(float) ** 2
    rows["occupied_km_h"] = rows["occupancy"] * area.astype(float)
    rows["occupied_variance"] = (rows["occupancy_se"] * area.astype(float)) ** 2
    rows["vehicle_km"] = rows["flow"] * area.astype(float)
    rows["vehicle_h"] = rows["density"] * area.astype(float)
    rows["delay_h"] = rows["delay_s"] * rows["volume"].astype(float) / 3600
    rows["queue_m_s"] = rows["queue_mean_m"] * share.astype(float) * 900
    keys = ["month", *LANE_MONTHS.order]
    rows = rows[rows["visible_s"] > 0]
    groups = rows.groupby(keys)
    summed = [
        name for name in LANE_MONTHS.names
        if name not in (*keys, "queue_max_m", "speed_counts")
    ]  # fmt: skip
    found = groups[summed].sum().astype(float)
    found["queue_max_m"] = groups["queue_max_m"].max()
    found["speed_counts"] = groups["speed_counts"].apply(
        lambda lists: np.sum(lists.tolist(), axis=0)
    )
    return found.reset_index()[["month", *LANE_MONTHS.names]]


def tile_oracle(dataset):
    rows = dataset.tile_counts()
    local = rows["begin"].dt.tz_convert(dataset.timezone)
    rows = rows.assign(month=local.dt.strftime("%Y-%m"), hour=local.dt.hour)
    keys = ["month", *TILE_MONTHS.order]
    names = [name for name in TILE_MONTHS.names if name not in keys]
    return rows.groupby(keys)[names].sum().reset_index()


def assert_same(found, wanted):
    lists = [name for name in found if name == "speed_counts"]
    for name in lists:
        assert [list(each) for each in found[name]] == [list(each) for each in wanted[name]]
    pd.testing.assert_frame_equal(
        found.drop(columns=lists), wanted.drop(columns=lists), check_dtype=False, rtol=1e-6
    )


@pytest.mark.parametrize("timezone", ["Europe/Berlin", "UTC", "Asia/Kathmandu", "America/St_Johns"])
def test_they_are_the_sums_of_the_day_tables(dataset, timezone):
    replace(dataset.manifest, timezone=timezone).write(dataset.folder)
    dataset = open_dataset(dataset.folder)
    for _ in range(2):
        assert_same(dataset.lane_months(), lane_oracle(dataset))
        assert_same(dataset.tile_months(), tile_oracle(dataset))
        roll_up(dataset)


def test_one_month_is_read_alone(drawn):
    whole = drawn.lane_months()
    assert whole["month"].unique().tolist() == ["2026-10", "2026-11"]
    mine = drawn.lane_months(month="2026-11")
    pd.testing.assert_frame_equal(mine, whole[whole["month"] == "2026-11"].reset_index(drop=True))
    assert drawn.lane_months(month="2026-12").empty
    for month in ("2026-13", "October", "2026-1"):
        with pytest.raises(UsageError, match="is no month"):
            drawn.lane_months(month=month)


def files(dataset):
    found = {
        path: path.read_bytes()
        for table in MONTH_TABLES for path in (dataset.folder / table.name).rglob("*.parquet")
    }  # fmt: skip
    return {path.relative_to(dataset.folder).as_posix(): each for path, each in found.items()}


def test_date_by_date_gives_the_same_bytes(tmp_path, dataset):
    records = dataset.folder / "hours"
    records.rename(tmp_path / "aside")
    for date in sorted((tmp_path / "aside").iterdir()):
        shutil.copytree(date, records / date.name)
        roll_up(dataset)
    grown = files(dataset)
    for table in MONTH_TABLES:
        shutil.rmtree(dataset.folder / table.name)
    roll_up(dataset)
    assert len(grown) == 4
    assert files(dataset) == grown


def test_a_month_of_which_an_hour_is_made_again_is_summed_again(dataset):
    roll_up(dataset)
    before = files(dataset)
    again = hour_at("2026-11-08T22")
    origin = Origin(fingerprint=dataset.manifest.fingerprint, method=1, inputs="other")
    with HourWriter(folder=dataset.folder, hour=again, origin=origin) as writer:
        for table in HOUR_TABLES:
            writer.write(table, table.empty())
    draw_days(dataset, seed=9)
    november = lane_oracle(dataset)
    november = november[november["month"] == "2026-11"].reset_index(drop=True)
    assert_same(dataset.lane_months(month="2026-11"), november)
    assert files(dataset) == before  # readers write nothing
    roll_up(dataset)
    changed = {path for path, each in files(dataset).items() if each != before[path]}
    assert changed == {f"{t.name}/month=2026-11/month.parquet" for t in MONTH_TABLES}
    assert_same(dataset.lane_months(month="2026-11"), november)


def test_a_month_without_hours_has_no_file(dataset):
    roll_up(dataset)
    for date in ("2026-10-31", "2026-11-01", "2026-11-08", "2026-11-09"):
        shutil.rmtree(dataset.folder / "hours" / date)
    records = read_hours(dataset.folder)
    rolled = roll_up(dataset)
    rolled.update([hour_at("2026-11-08T22")], records)
    assert {path.partition("/")[2] for path in files(dataset)} == {"month=2026-10/month.parquet"}
    assert dataset.lane_months()["month"].unique().tolist() == ["2026-10"]


def test_a_damaged_file_is_found_and_summed_anew(dataset):
    whole, rolled = dataset.lane_months(), roll_up(dataset)
    path = rolled.file(LANE_MONTHS, "2026-10").path
    good = path.read_bytes()
    path.write_bytes(good[:-20])
    pd.testing.assert_frame_equal(dataset.lane_months(), whole)
    with pytest.raises(InputError, match=r"month.parquet: damaged"):
        dataset.check()
    roll_up(dataset)
    assert path.read_bytes() == good
    dataset.check()
