"""The report of an audit for a reader: its verdict as tables, and all of it in Markdown.

Both read nothing but the document.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from attacks.outcomes import Property, Scheme
from attacks.report import RESULTS
from attacks.verdict import LIMITS, NOTHING_JUDGED
from verify.evaluation.markdown_cells import (
    fixed,
    interval_cell,
    percent,
    plain,
    significant,
    table,
)

Row = Mapping[str, Any]
Columns = Mapping[str, Callable[[Row], object]]
"""By title: what stands in the cell of a row."""


def _attack(row: Row) -> str:
    return f"{row['attack']} ({row['variant']})" if row["variant"] else str(row["attack"])


def _scheme(row: Row) -> str:
    return plain(Scheme.of(row))


VERDICT: Columns = {
    "property": lambda cell: cell["property"],
    "leaked": lambda cell: cell["leaked"],
    "attacker has": lambda cell: cell["knowledge"],
    "strongest attack": _attack,
    "reached (95 %)": lambda cell: (
        f"{cell['value']:.3g} ({cell['ci_low']:.2g}-{cell['ci_high']:.2g})"
    ),
    "by chance": lambda cell: f"{cell['chance']:.3g}",
    "compared": lambda cell: f"{cell['compared']:.3g}",
    "limit": lambda cell: "" if cell["most"] >= 1 else f"{cell['limit']} {cell['most']:.3g}",
    "status": lambda cell: cell["status"],
}
_ATTRIBUTES: Columns = {
    "scheme": _scheme,
    "attacker": lambda row: plain(
        row["attacker"] + (f", {row['metric']}" if row["metric"] else "")
    ),
    "knows": lambda row: plain(row["knowledge"]),
    "accuracy %": lambda row: interval_cell(
        {**row, "value": row["accuracy"], "errors": row["correct"]}
    ),
    "balanced %": lambda row: percent(row["balanced_accuracy"]),
    "chance %": lambda row: percent(row["chance"]),
    "dealt out %": lambda row: percent(row["chance_of_predictions"]),
}
_OUTCOMES: Columns = {
    "attack": lambda row: plain(row["attack"] + (f": {row['variant']}" if row["variant"] else "")),
    "leaked": lambda row: plain(row["leaked"]),
    "knows": lambda row: plain(row["knowledge"]),
    "level": lambda row: plain(row["level"]),
    "success": lambda row: _measured(row["measured"]),
    "chance": lambda row: significant(row["chance"]),
    "AUC": lambda row: fixed(row["details"].get("auc"), 3),
    "cosine to truth": lambda row: fixed(row["details"].get("cosine_to_truth_mean"), 3),
    "judged": lambda row: "yes" if row["judged"] else f"no: {plain(row['unjudged'])}",
}
_LIMITS: Columns = {
    "limit": lambda limit: f"`{limit['name']}`",
    "most": lambda limit: significant(limit["most"]),
    "on": lambda limit: limit["meaning"],
}


def markdown(report: Row) -> str:
    """Return the whole report."""
    parts = [
        f"# Privacy audit: {plain(report['kind'])}",
        _result(report),
        *_verdicts(report),
        *_attributes(report["rows"]),
        *_outcomes(report["outcomes"]),
        _settings(report),
    ]
    return "\n\n".join(parts) + "\n"


def verdict_tables(report: Row) -> Iterable[tuple[str, list[list[str]]]]:
    """Yield title and cells of the table of each scheme, which has the columns of ``VERDICT``."""
    for verdict in report["verdicts"]:
        compared = ", for comparison" if verdict["comparison"] else ""
        title = f"Verdict on {Scheme.of(verdict)}{compared}"
        yield title, _cells(verdict["cells"], VERDICT)


def _cells(rows: Iterable[Row], columns: Columns) -> list[list[str]]:
    return [[str(cell(row)) for cell in columns.values()] for row in rows]


def _table(rows: Iterable[Row], columns: Columns) -> str:
    return table(list(columns), _cells(rows, columns), [True] * len(columns))


def _result(report: Row) -> str:
    lines = [f"**{RESULTS[report['passed']]}**", ""]
    lines += [f"- {plain(sentence)}" for sentence in report["headlines"]]
    if report["comparison_headlines"]:
        lines += ["", "For comparison only:", ""]
        lines += [f"- {plain(sentence)}" for sentence in report["comparison_headlines"]]
    return "\n".join(lines)


def _verdicts(report: Row) -> Iterable[str]:
    yield "## Verdict"
    yield (
        "A row is the strongest attack that was made on a property after a theft: its measure with "
        "the 95 % interval, what guessing would reach, and how it stands against the limit. *Not "
        "shown*: the sample is too small, so that the upper bound exceeds twice the limit. The "
        "database alone holds ciphertext only: no attack begins there, and what stands in its rows "
        "uses the service."
    )
    for title, cells in verdict_tables(report):
        yield f"### {plain(title)}"
        if not cells:
            yield f"On this scheme {NOTHING_JUDGED}."
            continue
        lines = [[plain(cell) for cell in line] for line in cells]
        yield table(list(VERDICT), lines, [True] * len(VERDICT))
    yield "### Limits"
    yield _table(
        (
            {"name": limit.name, "meaning": limit.meaning, "most": report["limits"][limit.name]}
            for limit in LIMITS
        ),
        _LIMITS,
    )


def _attributes(rows: Sequence[Row]) -> Iterable[str]:
    if not rows:
        return
    yield "## Attribute inference"
    yield (
        "Accuracy in % over all attacked faces, with the 95 % Wilson interval; `balanced` is the "
        "mean over classes; chance is the share of the largest class. What leaks is a difference, "
        "up or down, from what the same predictions score where they are *dealt out* at random."
    )
    for attribute in dict.fromkeys(str(row["attribute"]) for row in rows):
        of_attribute = [row for row in rows if row["attribute"] == attribute]
        yield f"### {plain(attribute)}"
        stated = ", ".join(
            f"{plain(name)} {percent(value)}"
            for name, value in of_attribute[0]["baselines"].items()
            if name != "same_predictions"  # of this row's attacker only
        )
        yield f"Baselines in %: {stated}."
        yield _table(of_attribute, _ATTRIBUTES)


def _outcomes(outcomes: Sequence[Row]) -> Iterable[str]:
    shown = [row for row in outcomes if row["property"] != Property.CONFIDENTIALITY]
    if not shown:
        return
    yield "## Attacks on templates"
    yield (
        "Success is the successful attack rate (SAR) of ISO/IEC 30136, in % with its interval and "
        "counts, at the level named; D_sys is no share, and is given as it is. AUC: how often a "
        "guess is nearer to a photo of its own person than of another; 0.5 tells nothing."
    )
    for scheme in dict.fromkeys(map(_scheme, shown)):
        yield f"### {scheme}: attacks"
        yield _table((row for row in shown if _scheme(row) == scheme), _OUTCOMES)
    yield "### What each attacker has and does"
    said = dict.fromkeys((row["attack"], row["assumption"]) for row in shown)
    yield "\n".join(f"- **{plain(name)}**: {plain(text)}" for name, text in said)


def _measured(measured: Row) -> str:
    if "errors" in measured:
        return interval_cell(measured)
    value, low, high = (fixed(measured[name], 3) for name in ("value", "ci_low", "ci_high"))
    return f"{value} [{low}, {high}]"


def _acquired(failed: Row) -> str:
    if "photos" in failed:
        return f"{failed['failed']} of {failed['photos']} photos"
    return ", ".join(f"{name} {_acquired(part)}" for name, part in failed.items())


def _settings(report: Row) -> str:
    lines = ["## Settings", ""]
    if "failure_to_acquire" in report:
        lines.append(f"- failure to acquire: {plain(_acquired(report['failure_to_acquire']))}")
    for part in ("model", "settings"):
        lines += [f"- {plain(name)}: {plain(value)}" for name, value in report[part].items()]
    return "\n".join(lines)
