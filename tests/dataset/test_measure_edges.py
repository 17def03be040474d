"""An hour's edge within a recording: vehicles go on over it, and passages are counted once."""

import numpy as np
import pandas as pd
import pytest
from measured import EDGE_S, cut, measured

import gis_radar as gr

FIRST_S, LAST_S = 24.0, 34.0
EDGE_AT_S = 28.35
WHOLE_S = -971.65  # no edge, and steps that begin alike
NEAR_S = 0.5  # as the tracker may see one passage from another window


@pytest.fixture(scope="module")
def hours(once):
    """The same seconds of the sample: without an edge, and with one."""

    def measure(folder):
        places = {edge_s: folder / f"{edge_s}" for edge_s in (EDGE_AT_S, WHOLE_S)}
        for edge_s, place in places.items():
            files = [
                (sensor, cut(place / f"{sensor}.parquet", sensor, FIRST_S, LAST_S, edge_s=edge_s))
                for sensor in ("R1", "R2")
            ]
            measured(place / "site", *files)
        return places

    places = once("edges of hours", measure)
    return {edge_s: gr.open_dataset(place / "site") for edge_s, place in places.items()}


def seconds(times, edge_s):
    """Times as seconds of the sample."""
    micros = times.astype("datetime64[us, UTC]").astype("int64")
    return micros.to_numpy() / 1e6 - EDGE_S + edge_s


def passages(ds, edge_s):
    table = ds.passages()
    return table.assign(at_s=seconds(table["time"], edge_s))


def test_passages_are_those_without_an_edge(hours):
    whole, parted = passages(hours[WHOLE_S], WHOLE_S), passages(hours[EDGE_AT_S], EDGE_AT_S)
    matched = pd.merge_asof(
        parted.sort_values("at_s"), whole.sort_values("at_s").assign(known=True),
        on="at_s", by="lanelet_id", tolerance=NEAR_S, direction="nearest",
    )  # fmt: skip
    changed = int(matched["known"].isna().sum())
    assert len(whole) > 15
    assert abs(len(parted) - len(whole)) <= 1
    assert changed <= 2  # which the tracker itself sees otherwise from other blocks
    continued = hours[EDGE_AT_S].continued()
    number = parted["vehicle"].replace(dict(continued[["next", "vehicle"]].to_numpy()))
    assert not pd.DataFrame({"v": number, "l": parted["lanelet_id"]}).duplicated().any()


def test_a_vehicle_on_one_side_of_the_edge_is_on_the_other(hours):
    ds = hours[EDGE_AT_S]
    tracks, edge = ds.tracks(), pd.Timestamp(EDGE_S, unit="s", tz="UTC")
    continued = ds.continued()
    before = tracks[tracks["vehicle"].isin(continued["vehicle"])].groupby("vehicle").last()
    after = tracks[tracks["vehicle"].isin(continued["next"])].groupby("vehicle").first()
    assert len(continued) > 8
    assert continued["vehicle"].is_unique
    assert continued["next"].is_unique
    assert (before["time"] == edge - pd.Timedelta("50ms")).all()
    assert (after["time"] == edge).all()
    one, other = before.loc[continued["vehicle"]], after.loc[continued["next"]]
    apart = np.hypot(*(one[["easting", "northing"]].to_numpy()
                       - other[["easting", "northing"]].to_numpy()).T)  # fmt: skip
    assert (apart <= 0.05 * one["speed"].to_numpy() + 0.05).all()
    ended = tracks.groupby("vehicle")["time"].agg(["first", "last"])
    over = set(ended.index[ended["first"] == edge]) - set(continued["next"])
    assert not over  # who is there at the hour's begin was there before


def test_hits_and_times_are_those_without_an_edge(hours):
    whole, parted = hours[WHOLE_S], hours[EDGE_AT_S]
    shift = pd.Timedelta(seconds=EDGE_AT_S - WHOLE_S)
    known = whole.hits()
    known = known.assign(time=(known["time"] - shift).astype(known["time"].dtype))
    found = parted.hits()
    order = ["tile_id", "time"]
    pd.testing.assert_frame_equal(
        known.sort_values(order, ignore_index=True), found.sort_values(order, ignore_index=True)
    )
    for table in ("observed", "visible", "occupied"):
        lengths = [
            (rows["end"] - rows["begin"]).sum().total_seconds()
            for rows in (getattr(ds, table)() for ds in (whole, parted))
        ]
        assert lengths[0] == pytest.approx(lengths[1], rel=0.005), table


def test_states_are_kept_every_fourth_step_and_at_both_ends(hours):
    tracks = hours[EDGE_AT_S].tracks()
    step = (seconds(tracks["time"], EDGE_S) * 20).round().astype(int)
    ends = tracks["vehicle"].ne(tracks["vehicle"].shift()) | tracks["vehicle"].ne(
        tracks["vehicle"].shift(-1)
    )
    assert set(np.unique(step[~ends.to_numpy()] % 4)) == {0}
    inner = pd.Series(step).groupby(tracks["vehicle"].to_numpy()).diff().dropna()
    assert inner.max() <= 4
