"""A city's file: what is refused before a site of it is read."""

import pytest

import gis_radar as gr
from gis_radar.city.settings import read_city_file


def stated(folder, **sites):
    tables = [f'[[site]]\nname = "{name}"\nfile = "{file}"\n' for name, file in sites.items()]
    (folder / "CITY.toml").write_text('title = "x"\n' + "".join(tables), encoding="utf-8")
    return folder / "CITY.toml"


@pytest.mark.parametrize("other", ["SITE.toml", "./x/../SITE.toml", "link.toml"])
def test_two_sites_of_one_file_are_refused(tmp_path, other):
    (tmp_path / "SITE.toml").touch()
    (tmp_path / "link.toml").symlink_to("SITE.toml")
    with pytest.raises(gr.InputError, match="sites 'a' and 'b' have one file"):
        read_city_file(stated(tmp_path, a="SITE.toml", b=other))


def test_links_in_a_circle_are_told_when_the_site_is_read(tmp_path):
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    city = read_city_file(stated(tmp_path, a="loop.toml", b="SITE.toml"))
    assert [each.name for each in city.site] == ["a", "b"]
