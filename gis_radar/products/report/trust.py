"""Whether a report can be trusted: a row a sensor, in the words of the check."""

from __future__ import annotations

from gis_radar.base import NO_FIGURE, Clock, localised, plural, tr
from gis_radar.calibration import FITS, WRONG, Finding
from gis_radar.products.report.content import Table, text_columns
from gis_radar.products.report.results import Results

NOT_CHECKED = "not checked"


def trust_table(results: Results, clock: Clock) -> Table:
    """Return what the check found of each sensor, and what to do about it.

    Parameters
    ----------
    results : Results
        What the report is made of.
    clock : Clock
        Of the site, for times in the evidence.

    Returns
    -------
    Table
        With sensors whose recordings are in the heat map, and those that were left out.
    """
    known = results.findings
    names = sorted({*results.sensors, *results.lost, *known})
    rows = [_row(name, known.get(name), results, clock) for name in names]
    columns = text_columns(tr("Sensor"), tr("Verdict"), tr("Evidence"), tr("What to do"))
    return Table(
        name="trust",
        caption=tr("Whether pose, recordings and map of each sensor fit together"),
        columns=columns,
        rows=rows,
        note=" ".join(_notes(results, known)),
    )


def _row(name: str, found: Finding | None, results: Results, clock: Clock) -> list[str]:
    if found is None:
        lost = results.lost.get(name, "")
        return [name, tr(NOT_CHECKED), tr(lost) if lost else NO_FIGURE, NO_FIGURE]
    verdict = tr(found.verdict_told)
    if found.refused:
        text = "{verdict}, left out" if name in results.lost else "{verdict}, accepted anyway"
        verdict = tr(text, verdict=verdict)
    return [name, verdict, tr(localised(found.reason, clock.zone)), tr(found.advice) or NO_FIGURE]


def _notes(results: Results, known: dict[str, Finding]) -> list[str]:
    """Return in sentences how many sensors fit, and what the verdicts mean."""
    shown = [known.get(name) for name in results.sensors]
    fit = sum(each is not None and not each.doubt for each in shown)
    wrong = sum(each is not None and each.verdict == WRONG for each in shown)
    notes = [
        plural(fit, "{n} sensor of this map fits.", "{n} sensors of this map fit.")
        if fit < len(shown) or not shown
        else tr("All sensors of this map fit.")
    ]
    if wrong:
        notes.append(
            tr("Where one does not fit, do not use this map: vehicles may be on wrong lanes.")
        )
    if any(each is not None and each.verdict != FITS and not each.refused for each in shown):
        notes.append(
            tr("Too little traffic to tell: an error would not have shown; the map may be right.")
        )
    return notes
