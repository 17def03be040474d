"""The simulated city: the files of a site; days that are drawn are those of notebook 7."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import pytest

import gis_radar as gr
from gis_radar.poses import as_tracks
from simulation.city import LEVELS, city_sites, make_site, write_city_file


@pytest.mark.usefixtures("sumo_installed")
def test_a_site_is_written_as_files_that_a_run_reads(tmp_path):
    sites = city_sites(tmp_path, 20)
    site = next(each for each in sites if len(each.crossing.streets) == 2)
    site = replace(site, sensors=("R1",), levels=LEVELS[1:2], knocked="R1")
    make_site(site, minutes=0.05, seed=3)
    read = gr.read_site(site.site_file)
    assert [each.name for each in read.sensor] == ["R1"]
    (track,) = as_tracks([site.pose_file("R1")])
    assert track.poses[1].yaw - track.poses[0].yaw == pytest.approx(4.0, abs=1e-3)
    names = set(gr.read_map(site.folder / "map.osm").lanes()["street"].dropna())
    assert names == {street.name for street in site.crossing.streets}
    path = write_city_file(tmp_path, [site])
    known = tomllib.loads(path.read_text(encoding="utf-8"))
    assert (tmp_path / known["site"][0]["file"]).is_file()
