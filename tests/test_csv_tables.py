import numpy as np
import pytest

from gis_radar.base import InputError
from gis_radar.recordings import open_recording

HEADER = "time,x,y,z,range_rate,rcs,note"
ROWS = [f"1700000000.{i},{i + 1},2,-5,0.5,7,word" for i in range(5)]


@pytest.fixture
def made(tmp_path):
    def write(text, encoding="utf-8"):
        path = tmp_path / "r.csv"
        path.write_bytes(text.encode(encoding))
        return path

    return write


def lines(header=HEADER, rows=ROWS, end="\n"):
    return end.join([header, *rows]) + end


def read(path):
    return list(open_recording(path).read(further=True))


@pytest.mark.parametrize(
    "text",
    [
        lines(),
        "\ufeff" + lines(),
        lines(end="\r\n"),
        lines().replace(",", ", "),
        lines(HEADER.replace(",", " , ")),
        lines('"' + HEADER.replace(",", '", "') + '"'),
        "\n\n" + lines(),
        lines(end="\n\n"),
    ],
    ids=["plain", "bom", "crlf", "spaces", "wide header", "quoted header", "late", "blank lines"],
)
def test_ways_to_write_the_same_table(made, text):
    (found,) = read(made(text))
    np.testing.assert_array_equal(found.points[:, 0], [1, 2, 3, 4, 5])
    assert found.further.schema.names == ["note"]
    assert [text.strip() for text in found.further["note"].to_pylist()] == ["word"] * 5


@pytest.mark.parametrize(("mark", "called"), [(";", "semicolons"), ("\t", "tabs"), ("|", "bars")])
@pytest.mark.parametrize("decimal", [".", ","])
def test_other_delimiters_are_named(made, mark, called, decimal):
    text = lines().replace(",", mark).replace(".", decimal)
    with pytest.raises(InputError, match=f"separated by {called}, expected commas"):
        open_recording(made(text))


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_header_in_another_encoding(made, encoding):
    path = made(lines(HEADER.replace("note", "größe")), encoding)
    with pytest.raises(InputError, match=r"r\.csv: cannot be read: the header is not UTF-8"):
        open_recording(path)


def test_text_in_another_encoding_does_not_end_in_a_traceback(made):
    rows = [*ROWS, *[row.replace("word", "größe") for row in ROWS]]
    path = made(lines(rows=sorted(rows)), "latin-1")
    np.testing.assert_array_equal(len(read(path)[0]), 10)


@pytest.mark.parametrize("top", ["", "\n\n", "\ufeff"])
def test_rows_are_counted_below_the_header(made, top):
    cases = {
        "1700000000.2,three,2,-5,0.5,7,word": "invalid value 'three'",
        "1700000000.2,3,2,-5,0.5,7,word,more": "Expected 7 columns, got 8",
        "1700000000.2,inf,2,-5,0.5,7,word": "position is not finite",
        "1600000000.2,3,2,-5,0.5,7,word": "time goes back",
    }
    for row, reason in cases.items():
        with pytest.raises(InputError, match=reason) as caught:
            read(made(top + lines(rows=[*ROWS[:2], row, *ROWS[3:]])))
        assert "row 3" in caught.value.message.lower()
        assert "#" not in caught.value.message.partition("CSV")[0]


def test_bytes_that_are_no_table(made):
    with pytest.raises(InputError, match=r"r\.csv"):
        open_recording(made("\x00\x01" * 500))


def test_a_header_without_an_end_is_refused(made):
    with pytest.raises(InputError, match=r"r\.csv: damaged: field larger than field limit"):
        open_recording(made("[" * 200_000 + "\n"))


def test_a_value_that_is_long_is_shown_by_its_begin(made):
    with pytest.raises(InputError, match="invalid value") as caught:
        read(made(lines(rows=[ROWS[0].replace("1700000000", "17000" + "\0" * 4096)])))
    assert len(caught.value.message) < 300
    assert "'17000" in caught.value.message
