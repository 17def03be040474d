"""The table of all benchmarks: figures from their JSON, beside peers, and what got worse."""

import json
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "bench"))

import summary

ASSIGNMENT = {
    "tiles": 1000,
    "million_points_per_s": {"grid": 30.0, "sjoin from coordinates": 1.0},
}
SIGHT = {
    "town, classes": {"wrongly_seen": 0.01, "lost": 0.002, "right": 0.99},
    "two levels, classes": {"wrongly_seen": 0.05, "lost": 0.03, "right": 0.96},
}


@pytest.fixture
def out(tmp_path):
    for name, report in (("bench-assignment", ASSIGNMENT), ("bench-sight", SIGHT)):
        (tmp_path / f"{name}.json").write_text(json.dumps(report))
    return tmp_path


def run(monkeypatch, out, *more):
    paths = ["--out", out, "--accepted", out / "accepted.json", "--json", out / "bench.json"]
    monkeypatch.setattr(sys, "argv", ["summary.py", *map(str, [*paths, *more])])
    summary.main()


def test_figures_stand_beside_peers_and_those_that_were_accepted(out, monkeypatch, capsys):
    run(monkeypatch, out, "--accept")
    assert json.loads((out / "bench.json").read_text())["sight, town, classes: lost"] == {
        "ours": pytest.approx(0.2), "peer": 3.0, "unit": "%"
    }  # fmt: skip
    rows = capsys.readouterr().out.splitlines()
    assert any("30 M points/s | 1 M points/s sjoin from coordinates | 30.00" in r for r in rows)
    assert any("right | 96 % | 95 % (target) | 1.01" in row for row in rows)


@pytest.mark.parametrize(
    ("rate", "line"),
    [(29.0, None), (60.0, None), (15.0, "15 M points/s, accepted is 30 M points/s")],
)
def test_what_got_worse_by_more_than_chance_is_named(out, monkeypatch, rate, line):
    run(monkeypatch, out, "--accept")
    slower = ASSIGNMENT | {
        "million_points_per_s": {"grid": rate, "sjoin from coordinates": rate / 30}
    }
    (out / "bench-assignment.json").write_text(json.dumps(slower))
    if line is None:
        run(monkeypatch, out)
    else:
        with pytest.raises(SystemExit, match=line):
            run(monkeypatch, out)


def test_speed_goes_into_a_page(out, monkeypatch):
    page = out / "page.md"
    page.write_text("a\n<!-- speed -->\nold\n<!-- end of speed -->\nb\n")
    run(monkeypatch, out, "--into", page)
    text = page.read_text()
    assert "30 x sjoin from coordinates" in text
    assert "sight" not in text
    assert "old" not in text


def test_without_any_figure_it_says_how_to_get_some(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="make bench"):
        run(monkeypatch, tmp_path)


def test_what_was_accepted_and_is_not_measured_any_more_is_named(out, monkeypatch):
    run(monkeypatch, out, "--accept")
    (out / "bench-sight.json").unlink()
    with pytest.raises(SystemExit, match="sight, town, classes: lost: not measured"):
        run(monkeypatch, out)


def test_a_tenth_of_a_percent_more_than_none_is_not_worse(out, monkeypatch):
    none = SIGHT | {"town, classes": {"wrongly_seen": 0.01, "lost": 0.0, "right": 0.99}}
    (out / "bench-sight.json").write_text(json.dumps(none))
    run(monkeypatch, out, "--accept")
    for lost, worse in ((0.0005, False), (0.005, True)):
        now = none | {"town, classes": {"wrongly_seen": 0.01, "lost": lost, "right": 0.99}}
        (out / "bench-sight.json").write_text(json.dumps(now))
        if worse:
            with pytest.raises(SystemExit, match=r"lost: 0\.5 %, accepted is 0 %"):
                run(monkeypatch, out)
        else:
            run(monkeypatch, out)
