"""Questions to a city are those to its sites, put together."""

import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pandas as pd
import pytest
from datasets import write_dataset
from maps import EAST, NORTH
from months import drawn_months, hour_at, roll_up

import gis_radar as gr
from gis_radar.base import CrsError, InputError, UsageError
from gis_radar.dataset import UnknownStreetError

OCTOBER = range(hour_at("2026-10-30T20"), hour_at("2026-10-31T02"))
NOVEMBER = range(hour_at("2026-11-02T20"), hour_at("2026-11-03T02"))


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """Two sites, of which one was measured in October, too."""
    root = tmp_path_factory.mktemp("it's a") / "city"
    roll_up(drawn_months(root / "site=east", [*OCTOBER, *NOVEMBER], seed=1))
    drawn_months(root / "site=west", NOVEMBER, seed=2, at=(EAST + 500.0, NORTH))
    return gr.open_city(root)


def test_a_profile_is_that_of_each_site(city):
    asked = {"by": "weekday", "month": "2026-11", "days": "Mo-Fr"}
    found = city.profile("Ring", **asked)
    assert found.columns[0] == "site"
    for name, dataset in city.sites.items():
        mine = found[found["site"] == name].drop(columns="site").reset_index(drop=True)
        pd.testing.assert_frame_equal(mine, dataset.profile("Ring", **asked))
    assert city.profile(month="2026-10")["site"].unique().tolist() == ["east"]
    with pytest.raises(InputError, match="nothing was measured in that time"):
        city.profile(month="2027-01")
    for left_out in ({"without": "1970-01-01/2069-12-31"}, {"month": "2026-11", "days": "We"}):
        with pytest.raises(InputError, match="no day is left of those that were measured"):
            city.profile(**left_out)
    with pytest.raises(UsageError, match="there is no street 'Allee'"):
        city.profile("Allee")
    with pytest.raises(TypeError, match=r"City.profile\(\) got .* 'holidays'"):
        city.profile(holidays="2026-11-02")
    with pytest.raises(UsageError, match="names no days of the week"):
        city.profile(days="Mon")


def test_sites_elsewhere_than_on_a_street_are_no_warning(tmp_path, city, caplog):
    """A street is at few of hundreds of sites: a line for each of the others says nothing."""
    elsewhere = Mock(**{"profile.side_effect": UnknownStreetError("there is no street 'Ring'")})
    both = gr.City(root=tmp_path, sites={"east": city.sites["east"], "far": elsewhere})
    assert both.profile("Ring", month="2026-11")["site"].unique().tolist() == ["east"]
    assert caplog.text == ""


def test_sites_without_vehicles_are_left_out_of_profiles(tmp_path, city):
    shutil.copytree(city.root / "site=east", tmp_path / "site=east")
    write_dataset(tmp_path / "site=hits", hours=[hour_at("2026-11-02T20")], vehicles=False)
    both = gr.open_city(tmp_path)
    assert both.profile(month="2026-11")["site"].unique().tolist() == ["east"]
    alone = gr.City(root=tmp_path, sites={"hits": both.sites["hits"]})
    with pytest.raises(InputError, match="holds no vehicles"):
        alone.profile()


def test_sites_without_vehicles_add_no_lanes_in_sql(tmp_path, city):
    shutil.copytree(city.root / "site=east", tmp_path / "site=east")
    write_dataset(tmp_path / "site=hits", hours=[hour_at("2026-11-02T20")], vehicles=False)
    both = gr.open_city(tmp_path)
    lanes = both.query("SELECT site, lane, name, turn FROM lanes ORDER BY lane")
    mine = city.query("SELECT site, lane, name, turn FROM lanes WHERE site = 'east' ORDER BY lane")
    pd.testing.assert_frame_equal(lanes, mine)
    assert set(both.query("FROM tiles")["site"]) == {"east", "hits"}
    with pytest.raises(InputError, match="holds no vehicles"):
        both.sites["hits"].query("FROM lanes")


def test_the_catalogue_opens_in_duckdb_from_any_folder(city, tmp_path, run):
    code, *_ = run("query", city.root, "--catalogue", tmp_path / "catalogue.sql")
    assert code == 0
    sql = "SELECT site, count(*) AS rows FROM lane_months WHERE month = '2026-10' GROUP BY ALL"
    program = shutil.which("duckdb", path=Path(sys.executable).parent)
    words = [program, "-csv", "-init", tmp_path / "catalogue.sql", "-c", sql]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path)
    rows = len(city.sites["east"].lane_months(month="2026-10"))
    assert done.stdout.split() == ["site,rows", f"east,{rows}"]
    code, _, text = run("query", city.root / "site=east", "--catalogue", tmp_path / "c.sql")
    assert (code, "is of a city" in text) == (2, True)


def test_the_command_line_asks_a_city(city, tmp_path, run):
    code, text, _ = run("query", city.root, "SELECT DISTINCT site FROM lane_measures ORDER BY site")
    assert code == 0
    assert text.split()[-3:] == ["site", "east", "west"]
    asked = ["--by", "weekday", "--days", "Mo-Fr", "--month", "2026-11", "--without", "2026-11-03"]
    table = tmp_path / "profile.csv"
    code, *_ = run("profile", city.root, "--street", "Ring", *asked, "-o", table)
    assert code == 0
    by_method = city.profile(
        "Ring", by="weekday", days="Mo-Fr", month="2026-11", without="2026-11-03"
    ).round(4)
    pd.testing.assert_frame_equal(pd.read_csv(table), by_method, check_dtype=False, rtol=1e-12)
    code, text, _ = run("profile", city.root / "site=west", "--month", "2026-11", "--days", "Mo")
    assert code == 0
    assert "Ring westbound" in text
    assert run("query", city.root)[0] == 2


def test_a_profile_is_no_workbook(city, tmp_path, run):
    code, _, text = run("profile", city.root, "-o", tmp_path / "profile.xlsx")
    assert (code, "written as .csv" in text, [*tmp_path.iterdir()]) == (2, True, [])


def test_the_map_of_a_month_holds_the_tiles_of_all_sites(city):
    found = city.map("2026-11")
    assert found["site"].value_counts().to_dict() == {"east": 60, "west": 60}
    counts = city.sites["west"].tile_counts(begin="2026-11-01", end="2026-12-01")
    sums = counts.groupby("tile_id")[["occupied_steps", "visible_steps"]].sum()
    mine = found[found["site"] == "west"].set_index("tile_id")
    expected = (sums["occupied_steps"] / sums["visible_steps"]).reindex(mine.index)
    assert mine["occupancy"].to_numpy() == pytest.approx(expected.to_numpy(), rel=1e-6)
    assert city.map("2026-10")["site"].unique().tolist() == ["east"]


def test_sites_in_two_zones_need_a_system_for_the_map(tmp_path, city):
    shutil.copytree(city.root / "site=west", tmp_path / "site=west")
    drawn_months(tmp_path / "site=far", NOVEMBER, crs="EPSG:25833", at=(230_000.0, NORTH))
    both = gr.open_city(tmp_path)
    with pytest.raises(CrsError, match="site far lies in EPSG:25833, site west in EPSG:25832"):
        both.map("2026-11")
    found = both.map("2026-11", crs="EPSG:25832")
    assert found.crs == "EPSG:25832"
    assert len(found) == 120


def test_sql_over_all_sites(city):
    found = city.query("SELECT site, sum(hit_steps) AS hits FROM tile_counts GROUP BY site")
    hits = dict(zip(found["site"], found["hits"], strict=True))
    assert hits == {name: of.tile_counts()["hit_steps"].sum() for name, of in city.sites.items()}
    rows = city.query(
        "SELECT site, street, sum(volume) AS volume FROM lane_months JOIN lanes USING (site, lane) "
        "WHERE month = '2026-11' GROUP BY ALL ORDER BY site"
    )
    assert rows["site"].tolist() == ["east", "west"]
    east = city.sites["east"].lane_months(month="2026-11")["volume"].sum()
    assert rows["volume"].iloc[0] == pytest.approx(east)
    assert next(iter(city.query("FROM passages"))) == "site"


def test_lanes_in_sql_have_the_names_that_traffic_gives_them(city):
    names = city.query("SELECT site, lane, name FROM lanes ORDER BY ALL")
    assert names["site"].unique().tolist() == ["east", "west"]
    for site, of_site in names.groupby("site"):
        traffic = city.sites[site].traffic("1h")
        wanted = traffic.drop_duplicates("lane").set_index("lane")["name"].to_dict()
        found = of_site.set_index("lane")["name"].to_dict()
        assert found == wanted
        assert all(found.values())


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("SELECT * FROM _0_hits", "names '_0_hits', which is no table here"),
        ("SELECT * FROM read_csv('/etc/passwd')", "calls read_csv"),
        ("COPY hits TO 'x.csv'", "is no SELECT"),
    ],
)
def test_sql_over_all_sites_has_the_guards_of_one(city, sql, message):
    with pytest.raises(UsageError, match=message):
        city.query(sql)


def test_two_periods_are_compared_site_by_site(city):
    with pytest.raises(gr.GisRadarError, match=r"no lane|too few intervals|no whole interval"):
        city.compare(before="2026-10-30/2026-10-31", after="2026-11-02/2026-11-03")
