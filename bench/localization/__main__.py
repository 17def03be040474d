"""Localization, measured: our method and the paper's beside the paper's figures.

    python bench/localization             all, half an hour on two free cores
    python bench/localization --quick     a look, a few minutes
    python bench/localization --only table,straight
    python bench/localization --only calibration --conditions "radar as recorded, walkers"
    python bench/localization --into docs/accuracy.md   its table, from the kept JSON

Parts: speed, straight (a road that fixes no place along it), table (sets DY and DO of a town, as in
Table I), sites (the sample and what lies beside the project), calibration, curves (start, length,
traffic), ablation (each stage of our method turned off). Results in out/bench-localization:
report.md, a JSON file a part, pictures. What is simulated is kept there and made again when the
simulator changes. Needs Eclipse SUMO and Open3D.
Exit code 1 where one of our answers in table, sites or straight is wrong and is not marked as such.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ablation
import calibration
import curves
import figures
import speed
import straight
import table
from conditions import CONDITIONS, TEXTBOOK, folder_name
from places import OUT
from town import SETS, town_folder
from trials import METHODS, run_all
from workers import workers

sys.path.append(str(Path(__file__).resolve().parents[1]))  # what all benches share
import pages
import sites

QUICK_COMBINATIONS = 10
README_CONDITIONS = ("radar as recorded, walkers", "drivers as recorded")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effort:
    """How much to do.

    Parameters
    ----------
    quick : bool
        A few starts everywhere.
    starts : int
        At most so many a sensor, set and method in the table.
    conditions : str
        A name of `CONDITIONS`: radar, drivers and people of the table and the calibration.
    methods : tuple of str
        Which methods the table compares.
    """

    quick: bool
    starts: int
    conditions: str = TEXTBOOK
    methods: tuple[str, ...] = METHODS

    @property
    def out(self) -> Path:
        """Folder of the results."""
        return OUT if self.conditions == TEXTBOOK else OUT / folder_name("report", self.conditions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """What a part of the benchmark found.

    Parameters
    ----------
    title, text : str
        Of its chapter in the report, Markdown.
    figures : dict or list
        The same for programs.
    wrong : int
        How many of our answers are wrong and are not marked as such.
    """

    title: str
    text: str
    figures: Any
    wrong: int = 0


def make_table(effort: Effort) -> Part:
    """Measure the town's sets."""
    town = town_folder("town", conditions=effort.conditions)
    results = run_all(table.plan(town, most=effort.starts, methods=effort.methods), what="table")
    groups = table.report(results)
    figures.draw_town(town, effort.out / "town.png")
    pictures = ["![The town](town.png)"]
    for set_name in SETS:
        near = [r for r in results if r.trial.group == f"near {set_name}"]
        figures.draw_starts(town, set_name, near, effort.out / f"starts_{set_name}.png")
        pictures.append(f"![Set {set_name}: starts and ends](starts_{set_name}.png)")
    wrong = [r for r in results if r.wrong and r.trial.method == "lane"]
    return Part(
        title="Sets DY and DO, as in the paper's Table I",
        text="\n\n".join([table.markdown(groups), *pictures]),
        figures={"groups": groups, "trials": [_plain(r) for r in results]},
        wrong=len(wrong),
    )


def make_curves(effort: Effort) -> Part:
    """Measure against start, length and traffic."""
    town = town_folder("town")
    with workers() as pool:
        pool.map(curves.other_town, curves.other_rates(quick=effort.quick), chunksize=1)
    made = curves.report(run_all(curves.plan(town, quick=effort.quick), what="curves"))
    figures.draw_curves(made, OUT / "curves.png")
    text = f"![Curves](curves.png)\n{curves.markdown(made)}"
    return Part(title="Against start, length and traffic", text=text, figures=made)


def make_sites(effort: Effort) -> Part:
    """Measure the other sites."""
    made = sites.report(run_all(sites.plan(quick=effort.quick), what="sites"))
    wrong = sum(round(f["wrong"] * f["starts"]) for f in made.values())
    return Part(title="Other sites", text=sites.markdown(made), figures=made, wrong=wrong)


def make_calibration(effort: Effort) -> Part:
    """Measure errors against their covariance."""
    count = QUICK_COMBINATIONS if effort.quick else calibration.COUNT
    outcomes = calibration.run(range(count), conditions=effort.conditions)
    summary = calibration.summary(outcomes)
    figures.draw_calibration((o.nees for o in outcomes if o.outcome == "right"),
                             effort.out / "calibration.png")  # fmt: skip
    return Part(
        title="Calibration",
        text=f"{calibration.table(summary)}\n\n![NEES](calibration.png)",
        figures={"summary": summary, "outcomes": [dataclasses.asdict(o) for o in outcomes]},
    )


def make_straight(effort: Effort) -> Part:
    """Try a road that fixes no place along it."""
    attempts = straight.measure(quick=effort.quick)
    return Part(
        title="A straight road, the sensor looks along it",
        text=straight.markdown(attempts),
        figures=[dataclasses.asdict(a) for a in attempts],
        wrong=sum(a.confident for a in attempts),
    )


def make_speed(effort: Effort) -> Part:
    """Time the command."""
    del effort
    costs = speed.measure()
    summary = {way: dataclasses.asdict(cost) for way, cost in costs.items()}
    return Part(title="Speed and memory", text=speed.markdown(costs), figures=summary)


def make_ablation(effort: Effort) -> Part:
    """Turn each stage of our method off."""
    results = ablation.measure(ablation.plan(quick=effort.quick))
    made = ablation.report(results)
    return Part(
        title="Ablation: our method with one stage less",
        text=ablation.markdown(made),
        figures={"variants": made, "trials": ablation.plain(results)},
    )


PARTS: dict[str, Callable[[Effort], Part]] = {
    "speed": make_speed,
    "straight": make_straight,
    "table": make_table,
    "sites": make_sites,
    "calibration": make_calibration,
    "curves": make_curves,
    "ablation": make_ablation,
}
UNDER_CONDITIONS = ("table", "calibration")


def _plain(result: Any) -> dict[str, Any]:
    """Return a result as plain values, without paths of this machine."""
    row = dataclasses.asdict(result)
    row["trial"]["folder"] = result.trial.folder.name
    return row


def main() -> None:
    """Run the parts, write the report, judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few starts")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {','.join(PARTS)}")
    parser.add_argument("--starts", type=int, help="a sensor in the table, at most (50)")
    about = f"radar, drivers and people; for {', '.join(UNDER_CONDITIONS)}"
    parser.add_argument("--conditions", choices=CONDITIONS, default=TEXTBOOK, help=about)
    about = f"of the table, some of {','.join(METHODS)}"
    parser.add_argument("--methods", default=",".join(METHODS), help=about)
    parser.add_argument("--into", type=Path, help="put the kept table into this page, run nothing")
    options = parser.parse_args()
    if options.into:
        put_table(options.into)
        return
    methods = tuple(options.methods.split(","))
    if unknown := set(methods) - set(METHODS):
        parser.error(f"--methods: no method is called {', '.join(sorted(unknown))}")
    most = table.QUICK_STARTS if options.quick else table.NEAR_STARTS["lane"]
    effort = Effort(
        quick=options.quick, starts=options.starts or most, conditions=options.conditions,
        methods=methods,
    )  # fmt: skip
    names = options.only.split(",")
    if unknown := set(names) - set(PARTS):
        parser.error(f"--only: no part is called {', '.join(sorted(unknown))}")
    if effort.conditions != TEXTBOOK and set(names) - set(UNDER_CONDITIONS):
        parser.error(f"--conditions: is for --only {','.join(UNDER_CONDITIONS)}")
    effort.out.mkdir(parents=True, exist_ok=True)
    wrong = {}
    for name in names:
        begin = time.perf_counter()
        part = PARTS[name](effort)
        print(f"\n## {part.title}\n\n{part.text}\n", flush=True)
        _keep(name, part, effort, time.perf_counter() - begin)
        if part.wrong:
            wrong[name] = part.wrong
    if wrong:
        counts = ", ".join(f"{count} in {name}" for name, count in wrong.items())
        sys.exit(f"answers that are wrong and are not marked as such: {counts}")


def put_table(page: Path) -> None:
    """Put the table between its marks, from what is kept of table and sites."""
    by_conditions: dict[str, dict[str, Any]] = {}
    for conditions in (TEXTBOOK, *README_CONDITIONS):
        kept = Effort(quick=False, starts=0, conditions=conditions).out.glob("table*.json")
        for file in sorted(kept):
            groups = json.loads(file.read_text())["figures"]["groups"]
            known = {name: found for name, found in groups.items() if found["starts"]}
            by_conditions.setdefault(conditions, {}).update(known)
    of_sites = OUT / "sites.json"
    others = json.loads(of_sites.read_text())["figures"] if of_sites.exists() else {}
    pages.put(page, {"accuracy": table.readme(by_conditions, others)})


def _keep(name: str, part: Part, effort: Effort, seconds: float) -> None:
    """Write a part, and the report of all parts that are there, also of earlier runs."""
    how = "quick" if effort.quick else f"up to {effort.starts} starts a sensor"
    kept = dataclasses.asdict(part) | {"how": f"{how}, {seconds / 60.0:.0f} min"}
    if name == "table" and effort.methods != METHODS:
        name = f"table-{'-'.join(effort.methods)}"
    (effort.out / f"{name}.json").write_text(json.dumps(kept, indent=1) + "\n")
    files = [file for other in PARTS for file in sorted(effort.out.glob(f"{other}*.json"))]
    parts = [json.loads(file.read_text()) for file in files]
    chapters = [f"## {p['title']} ({p['how']})\n\n{p['text']}" for p in parts]
    head = f"# Localization: {effort.conditions}"
    (effort.out / "report.md").write_text("\n\n".join([head, *chapters]) + "\n")


if __name__ == "__main__":
    main()
