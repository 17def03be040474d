"""Profiles of streets: as pandas computes them from the day tables, whatever time is asked."""

import shutil
from datetime import date

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from months import drawn_months, hour_at, roll_up

import gis_radar as gr
from gis_radar.base import InputError, UsageError

HOURS = [
    *range(hour_at("2026-10-24T20"), hour_at("2026-10-25T04")),  # the end of summer time
    *range(hour_at("2026-10-31T20"), hour_at("2026-11-01T02")),
    *range(hour_at("2026-11-08T22"), hour_at("2026-11-09T02")),
    hour_at("2026-12-02T11"),
]
DAYS = {"Mo-Fr": range(5), "Sa,Su": (5, 6), "Su-Mo": (6, 0), None: range(7)}
CELLS = {"hour": range(24), "weekday": ["Mo", "Tu", "We", "Th", "Fr", "Sa", "Su"], "month": []}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return drawn_months(tmp_path_factory.mktemp("plain") / "data", HOURS)


@pytest.fixture(scope="module")
def rolled(tmp_path_factory, plain):
    """The same with roll-ups."""
    place = tmp_path_factory.mktemp("rolled") / "data"
    shutil.copytree(plain.folder, place)
    roll_up(dataset := gr.open_dataset(place))
    return dataset


def oracle(dataset, by, days, begin, end, without):
    """Compute a profile from the quarters: lanes 11 and 12 side by side, 13 alone."""
    rows = dataset.lane_measures(begin=begin, end=end)
    local = rows["begin"].dt.tz_convert("Europe/Berlin")
    rows = rows[local.dt.day_of_week.isin(DAYS[days]) & ~local.dt.date.isin(without)]
    rows = rows.astype({n: float for n in rows if n not in ("begin", "speed_counts")})
    local = local[rows.index]
    keys = {"hour": local.dt.hour, "month": local.dt.strftime("%Y-%m")}
    keys["weekday"] = local.dt.day_of_week.map(dict(enumerate(CELLS["weekday"])))
    rows["cell"] = keys[by]
    rows["direction"] = np.where(rows["lane"] == 13, "Ring westbound", "Ring eastbound")
    found = {}
    for key, of in rows.groupby(["direction", "cell"]):
        known, road_m = of[of["volume"].notna()], of["lane"].map({11: 0.5, 12: 0.5, 13: 1.0})
        hours = (road_m[known.index] * 0.25).sum()
        area = of["visible_km_h"].sum()
        found[key] = {
            "volume_veh_h": known["volume"].sum() / hours if hours else np.nan,
            "volume_se": np.sqrt((known["volume_se"] ** 2).sum()) / hours if hours else np.nan,
            "speed_kmh": (of["flow"] * of["visible_km_h"]).sum()
            / (of["density"] * of["visible_km_h"]).sum() if area else np.nan,
            "occupancy": (of["occupancy"] * of["visible_km_h"]).sum() / area if area else np.nan,
            "days": known.groupby("lane").size().max() / (4 if by == "hour" else 96)
            if len(known) else 0.0,
        }  # fmt: skip
    return pd.DataFrame.from_dict(found, orient="index")


def assert_as_oracle(dataset, by, days, begin, end, without):
    wanted = oracle(dataset, by, days, begin, end, without)
    try:
        found = dataset.profile("ring", by=by, days=days, begin=begin, end=end, without=without)
    except InputError:  # no day is left
        if wanted.empty or not wanted["days"].any():
            return
        raise
    known = found[found["visible_share"] > 0].set_index(["direction", by])
    assert known["visible_share"].between(0.0, 1.0).all()
    for name in wanted:
        mine = known[name].to_numpy()
        theirs = wanted[name].reindex(known.index).to_numpy()
        np.testing.assert_allclose(mine, theirs, rtol=1e-5, err_msg=name)
    blind = found[found["visible_share"] == 0]
    assert blind["volume_veh_h"].isna().all()
    assert (blind["days"] == 0).all()


QUARTERS = st.integers(0, 46 * 96).map(
    lambda n: pd.Timestamp("2026-10-20", tz="Europe/Berlin") + pd.Timedelta(minutes=15 * n)
)


@settings(max_examples=25)
@given(
    by=st.sampled_from([*CELLS]), days=st.sampled_from([*DAYS]), one=QUARTERS, other=QUARTERS,
    without=st.lists(st.dates(date(2026, 10, 24), date(2026, 11, 9)), max_size=3),
)  # fmt: skip
def test_any_time_is_exact(plain, rolled, by, days, one, other, without):
    begin, end = min(one, other), max(one, other)
    if not plain.records(plain.span(begin, end + pd.Timedelta(minutes=15))):
        return
    end += pd.Timedelta(minutes=15)
    for dataset in (plain, rolled):
        assert_as_oracle(dataset, by, days, begin, end, without)


@pytest.mark.parametrize("by", CELLS)
def test_whole_months_come_from_the_roll_up(plain, rolled, by):
    for days in DAYS:
        assert_as_oracle(rolled, by, days, None, None, [])
    pd.testing.assert_frame_equal(plain.profile(by=by), rolled.profile(by=by))
    one, whole = rolled.profile(by=by, month="2026-11"), ("2026-11-01", "2026-12-01")
    pd.testing.assert_frame_equal(one, rolled.profile(by=by, begin=whole[0], end=whole[1]))


def test_a_street_has_names_and_all_are_taken_without_one(rolled):
    assert rolled.profile("RING")["direction"].unique().tolist() == [
        "Ring eastbound", "Ring westbound",
    ]  # fmt: skip
    assert rolled.profile(language="de")["direction"].iloc[0].startswith("Ring nach Ost")
    with pytest.raises(UsageError, match="there is no street 'Allee'") as refused:
        rolled.profile("Allee")
    assert refused.value.hint == "streets here: Ring"


def test_holidays_from_a_file_are_as_those_named(rolled, tmp_path):
    asked = {"by": "weekday"}
    named = rolled.profile(**asked, without=["2026-10-24/2026-10-25", date(2026, 11, 9)])
    files = {
        "a.csv": "name,begin,end\nAutumn,2026-10-24,2026-10-25\n,2026-11-09,\n",
        "b.csv": "begin;end\n24.10.2026;25.10.2026\n9.11.2026;9.11.2026\n",
        "c.csv": "date\n2026-10-24\n2026-10-25\n2026-11-09\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        pd.testing.assert_frame_equal(rolled.profile(**asked, without=tmp_path / name), named)
    text = "2026-10-24/2026-10-25,2026-11-09"
    pd.testing.assert_frame_equal(rolled.profile(**asked, without=text), named)
    assert not named.equals(rolled.profile(**asked))


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        ({"by": "day"}, UsageError, "by is 'day', expected hour, weekday or month"),
        ({"days": "Mon"}, UsageError, "'Mon' names no days of the week"),
        ({"month": "2026"}, UsageError, "'2026' is no month"),
        ({"month": "0000-01"}, UsageError, "'0000-01' is no month"),
        ({"month": "9999-12"}, UsageError, "'9999-12' is no month"),
        ({"month": "2026-10", "begin": "2026-10-02"}, UsageError, "do not go together"),
        ({"begin": "2026-10-24 22:07"}, UsageError, "begin lies within a quarter of an hour"),
        ({"end": "2026-10-24 22:07"}, UsageError, "end lies within a quarter of an hour"),
        ({"without": "Easter"}, UsageError, "'Easter' is no date"),
        ({"without": "2026-11-02/2026-11-01"}, UsageError, "before they begin"),
        ({"without": "missing.csv"}, InputError, r"missing\.csv: cannot be read"),
        ({"month": "2027-01"}, InputError, "nothing was measured in that time"),
    ],
)
def test_what_cannot_be_asked_is_refused_by_name(plain, asked, error, message):
    with pytest.raises(error, match=message):
        plain.profile(**asked)


def test_a_file_of_holidays_that_is_none_is_named_with_its_line(plain, tmp_path):
    (tmp_path / "a.csv").write_text("begin,end\n2026-10-24,2026-13-25\n")
    with pytest.raises(InputError, match=r"a\.csv, line 2: '2026-13-25' is no date"):
        plain.profile(without=tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("day\n2026-10-24\n")
    with pytest.raises(InputError, match=r"b\.csv: is no table of holidays"):
        plain.profile(without=str(tmp_path / "b.csv"))
