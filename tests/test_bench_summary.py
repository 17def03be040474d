"""The table of all benchmarks: figures as they are kept, beside peers, and what got worse."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "bench"))

import figures
import summary
from figures import TARGET, TIMES, Figure

SPEED = Figure(
    what="points to tiles", ours=30.0, unit="M points/s", peer=1.0, peer_name="sjoin",
    more_is_better=True, chance=TIMES, size="1,000 tiles",
)  # fmt: skip
LOST = Figure(what="sight: lost", ours=0.2, unit="%", peer=3.0, peer_name=TARGET, least=0.1)


@pytest.fixture
def out(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "OUT", tmp_path / "out")
    figures.keep("assignment", [SPEED])
    figures.keep("sight", [LOST])
    return tmp_path


def run(monkeypatch, out, *more):
    paths = ["--out", out / "out", "--accepted", out / "accepted.json"]
    monkeypatch.setattr(sys, "argv", ["summary.py", *map(str, [*paths, *more])])
    summary.main()


def test_figures_stand_beside_peers_and_those_that_were_accepted(out, monkeypatch, capsys):
    run(monkeypatch, out, "--accept")
    run(monkeypatch, out)
    rows, fast = capsys.readouterr().out.splitlines()[-2:], "30 M points/s"
    assert rows == [
        f"| points to tiles, 1,000 tiles | {fast} | 1 M points/s sjoin | 30.00 | {fast} |  |",
        "| sight: lost | 0.2 % | 3 % (target) | 0.07 | 0.2 % |  |",
    ]


@pytest.mark.parametrize(
    ("rate", "line"),
    [(29.0, None), (60.0, None), (15.0, "15 M points/s, accepted is 30 M points/s")],
)
def test_what_got_worse_by_more_than_chance_is_named(out, monkeypatch, rate, line):
    run(monkeypatch, out, "--accept")
    figures.keep("assignment", [replace(SPEED, ours=rate)])
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
    assert "30 x sjoin" in text
    assert "sight" not in text
    assert "old" not in text


def test_without_any_figure_it_says_how_to_get_some(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match="make bench"):
        run(monkeypatch, tmp_path)


def test_what_was_accepted_and_is_not_measured_any_more_is_named(out, monkeypatch):
    run(monkeypatch, out, "--accept")
    (out / "out" / "sight.json").unlink()
    with pytest.raises(SystemExit, match="sight: lost: not measured"):
        run(monkeypatch, out)


def test_a_tenth_of_a_percent_more_than_none_is_not_worse(out, monkeypatch):
    figures.keep("sight", [replace(LOST, ours=0.0)])
    run(monkeypatch, out, "--accept")
    figures.keep("sight", [replace(LOST, ours=0.05)])
    run(monkeypatch, out)
    figures.keep("sight", [replace(LOST, ours=0.5)])
    with pytest.raises(SystemExit, match=r"lost: 0\.5 %, accepted is 0 %"):
        run(monkeypatch, out)


def test_a_bench_prints_keeps_and_judges_its_figures(out, capsys):
    met, missed = replace(LOST, what="met"), replace(LOST, what="missed", ours=3.5)
    figures.report("sight", [met])
    with pytest.raises(SystemExit, match=r"targets: missed: 3\.5 %, beside 3 %"):
        figures.report("sight", [missed, met])
    assert capsys.readouterr().out.count("met: 0.2 %, beside 3 % (target)") == 2
    kept = figures.read(out / "out" / "sight.json")
    assert kept == [LOST, met, missed]


def test_a_process_is_measured_by_itself(tmp_path):
    code = "import json, sys; x = bytearray(200_000_000); print(json.dumps(sys.argv[1:]))"
    ran = figures.run_alone("-c", f"{code}; print('{{\"a\": 1}}')", "b", root=tmp_path)
    assert ran.lines == [{"a": 1}]
    assert 180.0 < ran.peak_mib < 400.0
    assert 0.0 < ran.cpu_s < 30.0
    with pytest.raises(SystemExit, match="ended with code 7"):
        figures.run_alone("-c", "raise SystemExit(7)", root=tmp_path)
