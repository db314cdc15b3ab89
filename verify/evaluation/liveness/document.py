"""The document of a liveness evaluation, ``results.json``, and its report in Markdown."""

from collections.abc import Mapping, Sequence

from models.liveness import PassiveLiveness
from templates.contract.document import Contract
from templates.contract.levels import Rate
from verify.evaluation.liveness.scores import ScoredSet, VerifiedSet
from verify.evaluation.markdown_cells import (
    code,
    count,
    interval_cell,
    plain,
    significant,
    table,
)
from verify.evaluation.plan import Json
from verify.evaluation.provenance import software
from verify.evaluation.tables import Cells, failure_list

FORMAT = "veilface liveness evaluation"
VERSION = 1
CONTRACT_POINT = "contract"
"""Name of the operating point at the contract's threshold."""


def document(
    scored: ScoredSet,
    model: Json,
    liveness: PassiveLiveness,
    points: Mapping[str, float],
    *,
    contract: Contract | None,
    verified: VerifiedSet | None,
    unverified: str | None,
    refused: Sequence[str],
) -> Json:
    """Put everything together; ``points`` are thresholds by the names of their operating points."""
    presented = scored.presented
    species = [name for name in presented.species if len(scored.scored(name))]
    verification: Json = {"measured": False, "reason": unverified}
    if verified is not None:
        verification = {
            "measured": True,
            "level": verified.level,
            "target_fmr": verified.target_fmr,
            "enrolled_subjects": verified.enrolled,
            "enrolled_photos": verified.enrolled_photos,
            "left_out": list(verified.left_out),
            "frr": _rate(verified.false_rejections(None)),
        }
    policy = None if contract is None or contract.liveness is None else contract.liveness.to_json()
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": software(),
        "model": {**model, "liveness": [graph.as_dict() for graph in liveness.members]},
        "contract": contract and {"contract_id": contract.contract_id, "liveness": policy},
        "dataset": {
            "name": presented.name,
            "subjects": presented.subjects,
            "live": len(scored.rows(None)),
            "attacks": {name: len(scored.rows(name)) for name in presented.species},
            "bpnrr": _rate(scored.non_response(None)),
            "apnrr": {name: _rate(scored.non_response(name)) for name in presented.species},
        },
        "failures": [
            {"image": failure.path.name, "code": failure.code, "reason": failure.reason}
            for failure in scored.failures
        ],
        "rows": [
            row
            for point, threshold in points.items()
            for row in _rows(scored, species, point, threshold, verified)
        ],
        "verification": verification,
        "refused": list(refused),
    }


def _rows(
    scored: ScoredSet,
    species: Sequence[str],
    point: str,
    threshold: float,
    verified: VerifiedSet | None,
) -> list[Json]:
    """Errors of one operating point: a row for each species, the worst marked."""
    passed = {name: scored.apcer(name, threshold) for name in species}
    worst = max(species, key=lambda name: passed[name].value)
    return [
        {
            "dataset": scored.presented.name,
            "operating_point": point,
            "threshold": threshold,
            "species": name,
            "worst": name == worst,
            "apcer": _rate(passed[name]),
            "bpcer": _rate(scored.bpcer(threshold)),
            "iapmr_without_liveness": verified and _rate(verified.iapmr(name, None)),
            "iapmr": verified and _rate(verified.iapmr(name, threshold)),
            "frr": verified and _rate(verified.false_rejections(threshold)),
        }
        for name in species
    ]


def _rate(rate: Rate) -> Json:
    return {"value": rate.value if rate.trials else None, **rate.to_json()}


def row_cells(rows: Sequence[Json]) -> Cells:
    """Say what the rates are of each species at each threshold."""
    rates = {
        "APCER %": "apcer",
        "BPCER %": "bpcer",
        "IAPMR % without liveness": "iapmr_without_liveness",
        "IAPMR %": "iapmr",
        "FRR %": "frr",
    }
    lines = [
        [
            plain(row["operating_point"]),
            significant(row["threshold"]),
            plain(row["species"]) + (" (worst)" if row["worst"] else ""),
            *(interval_cell(row[name]) for name in rates.values()),
        ]
        for row in rows
    ]
    return ["threshold of", "threshold", "species", *rates], lines


def markdown(results: Json) -> str:
    """Return the report. It has no date, so that the same run gives the same text."""
    titles, lines = row_cells(results["rows"])
    parts = [
        f"# Presentation attack detection: {plain(results['dataset']['name'])}",
        _provenance(results),
        *(_headline(row) for row in results["rows"] if row["worst"]),
        table(titles, lines, [title in ("threshold of", "species") for title in titles]),
        _through(results["verification"]),
        "## Photos without a face",
        *_non_responses(results),
    ]
    if results["refused"]:
        parts.append("## Not reported")
        parts.append("\n".join(f"- {plain(sentence)}" for sentence in results["refused"]))
    return "\n\n".join([*parts, HOW_TO_READ]) + "\n"


HOW_TO_READ = """## How to read this

- APCER: share of the attack photos of one species that are taken for live. The worst species is the headline, since an attacker chooses. BPCER: share of the live photos that are taken for attacks. ISO/IEC 30107-3.
- In brackets the 95 % interval: people are resampled where they are known (never narrower than Wilson's), else Wilson's, as if the photos were independent. In parentheses errors of photos.
- A threshold that was set on these very photos flatters: apply one of other photos, `--contract`.
- IAPMR (IAPAR, its rate of acceptance by the full system, in ISO/IEC 30107-3:2023): share of the attacks with a photo of an enrolled person that the whole verification accepts for that person; a photo without a face is not accepted.
- Another camera, light or attack gives other rates (docs/liveness.md)."""  # noqa: E501


def _provenance(results: Json) -> str:
    model, dataset = results["model"], results["dataset"]
    lines = [f"Model pack: {plain(model.get('pack'))}"]
    lines += [
        f"Liveness graph: {code(graph['file'])}, crop {graph['crop']} × {graph['crop_scale']:g}, "
        f"SHA-256 {graph['sha256'][:12]}"
        for graph in model["liveness"]
    ]
    attacks = ", ".join(
        f"{plain(name)} {count(photos)}" for name, photos in dataset["attacks"].items()
    )
    people = "subjects not known"
    if dataset["subjects"] is not None:
        people = f"{count(dataset['subjects'])} subjects"
    lines.append(f"Photos: {count(dataset['live'])} live; attacks: {attacks}; {people}")
    return "\n".join(f"- {line}" for line in lines)


def _headline(worst: Json) -> str:
    point = worst["operating_point"]
    whose = "At the contract's threshold" if point == CONTRACT_POINT else f"At {plain(point)}"
    return (
        f"**{whose}: APCER, in %: {interval_cell(worst['apcer'])}** (worst species: "
        f"{plain(worst['species'])}); BPCER: {interval_cell(worst['bpcer'])}; threshold "
        f"{significant(worst['threshold'])}."
    )


def _through(facts: Json) -> str:
    if not facts["measured"]:
        return f"IAPMR was not measured: {plain(facts['reason'])}."
    left_out = f"; left out: {', '.join(map(plain, facts['left_out']))}" * bool(facts["left_out"])
    return (
        f"Through the whole verification: level {plain(facts['level'])}; "
        f"{count(facts['enrolled_subjects'])} subjects enrolled by "
        f"{count(facts['enrolled_photos'])} live photos each{left_out}. FRR of their other live "
        f"photos without liveness, in %: {interval_cell(facts['frr'])}."
    )


def _non_responses(results: Json) -> list[str]:
    dataset = results["dataset"]
    rates = {"live (BPNRR)": dataset["bpnrr"]}
    rates |= {f"{plain(name)} (APNRR)": rate for name, rate in dataset["apnrr"].items()}
    return [
        "They have no score, and are in neither APCER nor BPCER.",
        table(
            ["photos", "without a face %"],
            [[name, interval_cell(rate)] for name, rate in rates.items()],
            [True, False],
        ),
        *([failure_list(results["failures"])] if results["failures"] else []),
    ]
