"""The report of an audit in Markdown; reads nothing but the document."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from attacks.outcomes import KnowledgeLevel, Leaked, Property, Scheme
from attacks.report import RESULTS
from attacks.verdict import LIMITS, NOTHING_JUDGED
from verify.evaluation.markdown_cells import (
    MISSING,
    count,
    fixed,
    interval_cell,
    percent,
    plain,
    significant,
    table,
)

Row = Mapping[str, Any]
_KNOWLEDGE = {
    KnowledgeLevel.TEMPLATE: "template only",
    KnowledgeLevel.ALGORITHM: "+ algorithm",
    KnowledgeLevel.DECOYS: "+ decoys",
    KnowledgeLevel.RIGHT: "+ right",
    KnowledgeLevel.TEMPLATES: "k templates",
}
_LEAKED = {
    Leaked.DATABASE: "nothing, or the database only",
    Leaked.MASTER_KEY: "+ master key; the holder keeps a key",
    Leaked.HOLDER_KEYS: "+ holder's key; or + master key, where no holder keeps one",
}


def markdown(report: Mapping[str, Any]) -> str:
    """Return the whole report."""
    parts = [
        f"# Privacy audit: {plain(report['kind'])}",
        _result(report),
        *_verdicts(report),
        *_attributes(report["rows"]),
        *_operating(report),
        *_outcomes(report["outcomes"]),
        _settings(report),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _result(report: Row) -> str:
    lines = [f"**{RESULTS[report['passed']]}**"]
    lines += [f"- {plain(sentence)}" for sentence in report["headlines"]]
    if report["comparison_headlines"]:
        lines += ["", "For comparison only:", ""]
        lines += [f"- {plain(sentence)}" for sentence in report["comparison_headlines"]]
    return "\n".join([lines[0], "", *lines[1:]])


def _verdicts(report: Row) -> Iterable[str]:
    yield "## Verdict"
    yield (
        "Each cell is the strongest attack that was made: its measure with the 95 % interval, what "
        "guessing would reach, and how it stands against the limit. *Not shown*: the sample is too "
        "small, so that the upper bound exceeds twice the limit. Where a cell is empty, no attack "
        "of ours fits it. The columns say what leaked."
    )
    yield (
        "The database alone holds ciphertext only: no attack begins there, and what stands in its "
        "column uses the service."
    )
    for verdict in report["verdicts"]:
        cells: dict[tuple[str, str], dict[str, list[str]]] = {}
        for cell in verdict["cells"]:
            line = cells.setdefault((cell["property"], cell["knowledge"]), {})
            line.setdefault(cell["leaked"], []).append(_verdict_cell(cell))
        lines = [
            [
                str(prop),
                _KNOWLEDGE[known],
                *("<br>".join(cells[prop, known].get(leaked, [MISSING])) for leaked in Leaked),
            ]
            for prop in Property
            for known in KnowledgeLevel
            if (prop, known) in cells
        ]
        title = f"### {plain(str(Scheme.of(verdict)))}"
        if verdict["comparison"]:
            title += " (comparison)"
        yield title
        if not lines:
            yield f"On this scheme {NOTHING_JUDGED}."
            continue
        yield table(
            ["property", "attacker has", *(_LEAKED[leaked] for leaked in Leaked)],
            lines,
            [True] * (2 + len(Leaked)),
        )
    yield "### Limits"
    yield table(
        ["limit", "most", "on"],
        [
            [f"`--max-{limit.name}`", significant(report["limits"][limit.name]), limit.meaning]
            for limit in LIMITS
        ],
        [True, False, True],
    )


def _verdict_cell(cell: Row) -> str:
    name = plain(cell["attack"]) + (f" ({plain(cell['variant'])})" if cell["variant"] else "")
    status = cell["status"]
    shown = f"**{status}**" if status == "fail" else status
    if cell["reason"]:
        why = "by design" if status == "no limit" else "cannot hold"
        shown += f", {why}: {plain(cell['reason'])}"
    return (
        f"{significant(cell['value'])} [{significant(cell['ci_low'])}, "
        f"{significant(cell['ci_high'])}], chance {significant(cell['chance'])}: {name}: {shown}"
    )


def _attributes(rows: Sequence[Row]) -> Iterable[str]:
    if not rows:
        return
    yield "## Attribute inference"
    yield (
        "Accuracy in % over all attacked faces, with the 95 % Wilson interval; `balanced` is the "
        "mean over classes; chance is the share of the largest class. Leakage is a difference, up "
        "or down, from what the same predictions would score if they were dealt out at random."
    )
    for attribute in dict.fromkeys(str(row["attribute"]) for row in rows):
        of_attribute = [row for row in rows if row["attribute"] == attribute]
        yield f"### {plain(attribute)}"
        first = of_attribute[0]
        stated = ", ".join(
            f"{plain(name)} {percent(value)}"
            for name, value in first["baselines"].items()
            if name != "same_predictions"  # of this row's attacker only
        )
        yield f"Baselines in %: {stated}."
        yield table(
            [
                "scheme",
                "attacker",
                "knows",
                "accuracy %",
                "balanced %",
                "chance %",
                "leakage",
            ],
            [
                [
                    plain(str(Scheme.of(row))),
                    plain(row["attacker"] + (f", {row['metric']}" if row.get("metric") else "")),
                    plain(row["knowledge"]),
                    interval_cell({**row, "value": row["accuracy"], "errors": row["correct"]}),
                    percent(row["balanced_accuracy"]),
                    percent(row["chance"]),
                    plain(row["leakage"]),
                ]
                for row in of_attribute
            ],
            [True, True, True, False, False, False, True],
        )


def _operating(report: Row) -> Iterable[str]:
    schemes = report.get("schemes")
    if not schemes:
        return
    yield "## What each scheme costs"
    yield (
        "Error rates of the calibration at each level, both tests together, in % with the 95 % "
        "interval; a raw photo is compared with a template of one or more averaged photos."
    )
    yield table(
        ["scheme", "level", "FMR %", "FNMR %", "template, bytes"],
        [
            [
                plain(str(Scheme.of(scheme))),
                plain(level["name"])
                + (" (default)" if level["name"] == scheme["default_level"] else ""),
                interval_cell({**level["fmr"], "value": _share(level["fmr"])}),
                interval_cell({**level["fnmr"], "value": _share(level["fnmr"])}),
                count(scheme["template_bytes"]),
            ]
            for scheme in schemes
            for level in scheme["levels"]
        ],
        [True, True, False, False, False],
    )


def _share(rate: Row) -> float:
    return float(rate["errors"]) / rate["trials"] if rate["trials"] else 0.0


def _outcomes(outcomes: Sequence[Row]) -> Iterable[str]:
    if not outcomes:
        return
    shown = [row for row in outcomes if row["property"] != Property.CONFIDENTIALITY]
    if not shown:
        return
    yield "## Attacks on templates"
    yield (
        "Success is the successful attack rate (SAR) of ISO/IEC 30136, in % with its interval and "
        "counts, at the level named; D_sys is no share, and is given as it is. AUC: how often a "
        "guess is nearer to a photo of its own person than of another; 0.5 tells nothing."
    )
    for scheme in dict.fromkeys(Scheme.of(row) for row in shown):
        yield f"### {plain(str(scheme))}: attacks"
        yield table(
            [
                "attack",
                "leaked",
                "knows",
                "level",
                "success",
                "chance",
                "AUC",
                "cosine to truth",
                "judged",
            ],
            [
                [
                    plain(row["attack"] + (f": {row['variant']}" if row["variant"] else "")),
                    plain(row["leaked"]),
                    plain(row["knowledge"]),
                    plain(row["level"]),
                    _measured(row),
                    significant(row["chance"]),
                    fixed(row["details"].get("auc"), 3),
                    fixed(row["details"].get("cosine_to_truth_mean"), 3),
                    "yes" if row["judged"] else f"no: {plain(row['unjudged'])}",
                ]
                for row in shown
                if Scheme.of(row) == scheme
            ],
            [True, True, True, True, False, False, False, False, True],
        )
    yield "### What each attacker has and does"
    said = dict.fromkeys((row["attack"], row["assumption"]) for row in shown)
    yield "\n".join(f"- **{plain(name)}**: {plain(text)}" for name, text in said)


def _measured(row: Row) -> str:
    measured = row["measured"]
    if "errors" in measured:
        return interval_cell(measured)
    return (
        f"{fixed(measured['value'], 3)} [{fixed(measured['ci_low'], 3)}, "
        f"{fixed(measured['ci_high'], 3)}]"
    )


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
