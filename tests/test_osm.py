"""OSM XML: what is read, and what is refused before it can do harm."""

import numpy as np
import pytest
from maps import write_osm, write_road

from gis_radar.base import InputError
from gis_radar.hdmap import read_osm
from gis_radar.hdmap.osm import Member


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def refused(path):
    with pytest.raises(InputError) as caught:
        read_osm(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_elements_are_read_with_their_tags(tmp_path):
    nodes = {1: (0.0, 0.0, 5.5), -2: (1.0, 0.0), 2**62: (2.0, 1.0)}
    ways = {7: ([1, -2, 2**62], {"type": "line_thin"})}
    rule = ({"subtype": "speed_limit"}, [("way", 7, "refers")])
    osm = read_osm(write_osm(tmp_path / "a.osm", nodes, ways, {9: (7, 7)}, {11: rule}))
    assert osm.node_ids.tolist() == [1, -2, 2**62]
    assert osm.node_index[2**62] == 2
    np.testing.assert_array_equal(osm.elevation, [5.5, np.nan, np.nan])
    assert np.isnan(osm.local).all()
    assert osm.ways[7].nodes == (1, -2, 2**62)
    assert osm.ways[7].tags == {"type": "line_thin"}
    assert osm.relations[9].refs("way", "left") == (7,)
    assert osm.relations[11].members == (Member("way", 7, "refers"),)
    assert [ref for ref, _ in osm.relations_of("lanelet")] == [9]


@pytest.mark.parametrize("bad", ["NaN", "inf", "-Infinity", "1e400", "north", "", "91", "0x10"])
def test_impossible_coordinates_become_unknown(tmp_path, bad):
    node = {"lat": bad, "lon": "11.0", "tags": {"local_x": bad if bad != "91" else "", "ele": "x"}}
    osm = read_osm(write_osm(tmp_path / "a.osm", {1: node}, {}, {}))
    assert np.isnan(osm.geographic).all()
    assert np.isnan(osm.local).all()
    assert np.isnan(osm.elevation).all()


def test_the_first_of_two_equal_ids_counts(tmp_path):
    extra = '<node id="1" lat="1" lon="1"/><way id="5"/><relation id="6"/><relation id="6"/>'
    osm = read_osm(write_osm(tmp_path / "a.osm", {1: (0.0, 0.0)}, {5: [1]}, {}, extra=extra))
    assert osm.duplicates == (("node", 1), ("way", 5), ("relation", 6))
    assert osm.ways[5].nodes == (1,)
    assert osm.geographic[0, 0] > 10.0


def test_deleted_elements_are_left_out(tmp_path):
    extra = '<node id="8" lat="1" lon="1" action="delete"/><way id="9" visible="false"/>'
    osm = read_osm(write_osm(tmp_path / "a.osm", {1: (0.0, 0.0)}, {}, {}, extra=extra))
    assert osm.node_ids.tolist() == [1]
    assert not osm.ways


def test_other_encodings_are_read(tmp_path):
    text = '<?xml version="1.0" encoding="ISO-8859-1"?><osm><way id="1"><tag k="n" v="Straße"/>'
    text += "</way></osm>"
    path = tmp_path / "latin.osm"
    path.write_bytes(text.encode("latin-1"))
    assert read_osm(path).ways[1].tags == {"n": "Straße"}


BOMB = """<?xml version="1.0"?>
<!DOCTYPE osm [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;"><!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;&c;&c;">]>
<osm><way id="1"><tag k="name" v="&d;"/></way></osm>"""


@pytest.mark.parametrize(
    "text",
    [
        BOMB,
        '<!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/hostname">]><osm>&x;</osm>',
        '<!DOCTYPE osm SYSTEM "osm.dtd"><osm/>',
        "<!DOCTYPE osm><osm/>",
    ],
)
def test_document_types_and_entities_are_refused(tmp_path, text):
    assert "document types and entities are refused" in refused(written(tmp_path / "a.osm", text))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "the file is empty"),
        ("lanes, not XML", "line 1: not XML"),
        ("<osm><a></b></osm>", "line 1: not XML: mismatched tag"),
        ("<osm>&amp;&undefined;</osm>", "not XML: undefined entity"),
        ('<osm>\n<node id="1"', "line 2: the file ends early: truncated XML"),
        ('<osm>\n<node id="1"/>\n', "the file ends early: truncated XML"),
        ("<gpx/>", "not OSM: its root is <gpx>"),
        ('<osm>\n<way id="one"/></osm>', "line 2: <way> has the id 'one'"),
        ("<osm><way/></osm>", "<way> has the id None"),
        (f'<osm><way id="{2**63}"/></osm>', "expected an integer of 64 bits"),
        ('<osm><way id="1"><nd ref="1.5"/></way></osm>', "<nd> has the id '1.5'"),
        ('<?xml version="1.0" encoding="no-such"?><osm/>', "not XML: unknown encoding"),
    ],
)
def test_what_is_no_osm_is_refused_in_one_line(tmp_path, text, reason):
    assert reason in refused(written(tmp_path / "a.osm", text))


@pytest.mark.parametrize("text", ["lanes, not XML", "<gpx/>", ""])
def test_another_kind_of_file_is_told_what_is_wanted(tmp_path, text):
    with pytest.raises(InputError) as refusal:
        read_osm(written(tmp_path / "a.osm", text))
    assert refusal.value.hint == "a Lanelet2 map in OSM XML is needed"


@pytest.mark.parametrize(
    "content", [b"\x89PNG\r\n\x1a\n\x00\x00", b"\xff\xfe\x00", b"<osm>\xff</osm>"]
)
def test_binary_files_are_refused(tmp_path, content):
    path = tmp_path / "a.osm"
    path.write_bytes(content)
    refused(path)


def test_every_cut_of_a_file_is_refused(tmp_path):
    whole = write_road(tmp_path / "whole.osm").read_bytes()
    for size in range(0, len(whole) - 6, 97):
        path = tmp_path / "cut.osm"
        path.write_bytes(whole[:size])
        refused(path)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    assert "cannot be read" in refused(tmp_path / "absent.osm")
    assert "cannot be read" in refused(tmp_path)
