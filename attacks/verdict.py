"""The verdict: what an attacker achieves at best, by property, theft and knowledge, against limits.

Every cell of the table holds the strongest attack that was made: the one that exceeds chance most.
A cell fails where its measure exceeds the limit that the operator set. It is *not shown* where only
the one-sided 95 % upper bound exceeds twice the limit, or where the attacker had too little to show
anything: the sample is too small. A scheme none of whose attacks is judged has no cell, and neither
passes nor fails.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from attacks.operating_point import PRIVACY_LIMIT
from attacks.outcomes import (
    COMPARED,
    CONTROL,
    AttackOutcome,
    KnowledgeLevel,
    Leaked,
    Property,
    Scheme,
)
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.contract.verdict import upper_bound


class Status(StrEnum):
    """How a cell stands; an audit with a cell that is not shown has not passed."""

    PASS = "pass"  # noqa: S105 - a word of the report
    FAIL = "fail"
    NOT_SHOWN = "not shown"
    UNLIMITED = "no limit"


_GRAVITY = (Status.UNLIMITED, Status.PASS, Status.NOT_SHOWN, Status.FAIL)
_BOUND = 2.0
"""Most that an upper bound may be, in multiples of the limit."""


@dataclass(frozen=True)
class Limit:
    """What an operator accepts.

    Parameters
    ----------
    name
        Of the field in the report, and in ``--limit NAME=SHARE``.
    default
        The most that passes; 1 limits nothing.
    meaning
        What is limited, for ``--help`` and the report.
    """

    name: str
    default: float
    meaning: str


FOOT_POINT = "foot-point-success"
ATTRIBUTE_LEAKAGE = "attribute-leakage"
WITH_KEY, WITHOUT_KEY = "success-with-key", "success-without-key"
LIMITS: tuple[Limit, ...] = (
    Limit(
        FOOT_POINT,
        0.1,
        "share of templates whose foot point matches a fresh photo of the victim",
    ),
    Limit(
        "recovery-success",
        PRIVACY_LIMIT,
        "share of templates from which any other attack recovers a match for a fresh photo",
    ),
    Limit(
        "linkability",
        0.1,
        "D_sys between two tenants, less the mean of its permutation null",
    ),
    Limit(
        "renewed-success",
        0.05,
        "share of renewed templates that what was stolen before opens",
    ),
    Limit(
        ATTRIBUTE_LEAKAGE,
        0.25,
        "distance of the strongest attacker's accuracy from chance, in either direction, as a "
        "share of what raw embeddings gain over the largest class",
    ),
    Limit(
        "false-acceptance",
        0.02,
        "share of templates that accept a probe made without the victim, checks included",
    ),
    Limit(
        WITH_KEY,
        1.0,
        "Attacks that succeed by design once every key has leaked. A template accepts the vectors "
        "inside it; a renewed template holds the same face; several templates of one person "
        "intersect in that person's embedding.",
    ),
    Limit(
        WITHOUT_KEY,
        0.02,
        "recovery or acceptance from templates that are still turned by a secret rotation",
    ),
)
_BY_PROPERTY = {
    Property.IRREVERSIBILITY: "recovery-success",
    Property.UNLINKABILITY: "linkability",
    Property.RENEWABILITY: "renewed-success",
    Property.CONFIDENTIALITY: ATTRIBUTE_LEAKAGE,
    Property.IMPERSONATION: "false-acceptance",
}
_OF_A_TEMPLATE = (Property.IRREVERSIBILITY, Property.CONFIDENTIALITY)
"""Properties that one template should have without any rotation."""
_BY_ATTACK = {"foot-point": FOOT_POINT}
"""Attacks with a limit of their own, and so a cell of their own."""


@dataclass(frozen=True)
class Cell:
    """The strongest attack on one property, of one theft and knowledge, and how it stands.

    Parameters
    ----------
    excess, low, high
        What is compared with the limit, its lower bound, and its one-sided upper bound.
    """

    outcome: AttackOutcome
    limit: str
    most: float
    excess: float
    low: float
    high: float

    @property
    def status(self) -> Status:
        """Pass, fail, not shown, or no limit."""
        if self.most >= 1:
            return Status.UNLIMITED
        if self.excess > self.most:
            return Status.FAIL
        shown = self.high <= _BOUND * self.most and self.outcome.details.get("too_few") is None
        return Status.PASS if shown else Status.NOT_SHOWN

    @property
    def rank(self) -> tuple[int, float]:
        """What the strongest attack is chosen by: a doubt counts more than a small success."""
        return _GRAVITY.index(self.status), self.excess

    def to_json(self) -> dict[str, Json]:
        """Return a cell of ``verdict`` of the report."""
        return {
            "property": str(self.outcome.breaks),
            "leaked": str(self.outcome.leaked),
            "knowledge": str(self.outcome.knowledge),
            "attack": self.outcome.attack,
            "variant": self.outcome.variant,
            "value": self.outcome.measured.value,
            "ci_low": self.outcome.measured.ci_low,
            "ci_high": self.outcome.measured.ci_high,
            "chance": self.outcome.chance,
            "compared": self.excess,
            "compared_low": self.low,
            "compared_high": self.high,
            "limit": self.limit,
            "most": self.most,
            "status": str(self.status),
        }


@dataclass(frozen=True)
class Verdict:
    """The cells of one scheme, in the order of properties, thefts and knowledge.

    ``unjudged`` are the outcomes that the verdict does not count.
    """

    scheme: Scheme
    cells: tuple[Cell, ...]
    unjudged: tuple[AttackOutcome, ...] = ()

    @property
    def failed(self) -> tuple[Cell, ...]:
        """The cells that exceed their limit."""
        return tuple(cell for cell in self.cells if cell.status is Status.FAIL)

    @property
    def passed(self) -> bool | None:
        """Whether every cell holds; None where none fails, and not all are shown to hold."""
        if self.failed:
            return False
        unshown = any(cell.status is Status.NOT_SHOWN for cell in self.cells)
        return None if unshown or not self.cells else True

    def to_json(self) -> dict[str, Json]:
        """Return an entry of ``verdicts`` of the report."""
        return {
            **self.scheme.to_json(),
            "passed": self.passed,
            "cells": [cell.to_json() for cell in self.cells],
            "not_judged": [
                {"attack": each.attack, "variant": each.variant, "reason": each.unjudged}
                for each in self.unjudged
            ],
        }


def judge(
    outcomes: Iterable[AttackOutcome], *, limits: Mapping[str, float] | None = None
) -> list[Verdict]:
    """Judge every scheme by the strongest attack on each property, theft and knowledge.

    Outcomes that are not ``judged`` fill no cell. A scheme that has nothing but controls, or is
    there to compare with, gets no verdict. ``limits`` go by name; absent ones are the defaults.
    """
    most = {limit.name: limit.default for limit in LIMITS} | dict(limits or {})
    by_scheme: dict[Scheme, list[AttackOutcome]] = {}
    for outcome in outcomes:
        by_scheme.setdefault(outcome.scheme, []).append(outcome)
    verdicts = []
    for scheme, rows in by_scheme.items():
        if all(row.unjudged in (CONTROL, COMPARED) for row in rows):
            continue
        cells: dict[tuple[int, int, int, str], Cell] = {}
        for cell in (cell_of(row, most) for row in rows if row.judged):
            place = _place(cell)
            if place not in cells or cell.rank > cells[place].rank:
                cells[place] = cell
        unjudged = tuple(row for row in rows if not row.judged)
        verdicts.append(Verdict(scheme, tuple(cells[place] for place in sorted(cells)), unjudged))
    return verdicts


def _place(cell: Cell) -> tuple[int, int, int, str]:
    """Where a cell stands: properties, thefts and knowledge in their own orders."""
    row = cell.outcome
    return (
        list(Property).index(row.breaks),
        list(Leaked).index(row.leaked),
        list(KnowledgeLevel).index(row.knowledge),
        cell.limit,
    )


def cell_of(outcome: AttackOutcome, most: Mapping[str, float]) -> Cell:
    """Compare one outcome with its limit."""
    name = _limit_of(outcome)
    measured = outcome.measured
    value, low, high = measured.value, measured.ci_low, measured.ci_high
    if outcome.breaks is Property.CONFIDENTIALITY:
        gain = float(str(outcome.details["raw_gain"]))
        value, low, high = (one / gain for one in _distance(outcome.chance, value, low, high))
    elif outcome.breaks is Property.UNLINKABILITY:
        # D_sys below its null is chance, and tells nothing.
        value, low, high = (max(0.0, bound - outcome.chance) for bound in (value, low, high))
    elif isinstance(measured, Rate) and measured.interval == "wilson":
        high = upper_bound(measured.errors, measured.trials)
    return Cell(outcome, name, most[name], value, low, high)


def _limit_of(outcome: AttackOutcome) -> str:
    several = outcome.knowledge is KnowledgeLevel.TEMPLATES
    of_a_template = outcome.breaks in _OF_A_TEMPLATE and not several
    if outcome.leaked is Leaked.HOLDER_KEYS and not of_a_template:
        return WITH_KEY
    if outcome.leaked is Leaked.MASTER_KEY and outcome.breaks in (
        Property.IRREVERSIBILITY,
        Property.IMPERSONATION,
    ):
        return WITHOUT_KEY
    return _BY_ATTACK.get(outcome.attack, _BY_PROPERTY[outcome.breaks])


def _distance(chance: float, value: float, low: float, high: float) -> tuple[float, float, float]:
    """Distance from chance, in either direction, and its interval."""
    far = max(abs(low - chance), abs(high - chance))
    near = 0.0 if low <= chance <= high else min(abs(low - chance), abs(high - chance))
    return abs(value - chance), near, far


NOTHING_JUDGED = "no attack was judged, so it neither passed nor failed"


def headlines(verdicts: Sequence[Verdict]) -> list[str]:
    """Say what fails, what is not judged, what succeeds without a limit, what is not shown."""
    lines: list[str] = []
    for verdict in verdicts:
        unshown = [cell for cell in verdict.cells if cell.status is Status.NOT_SHOWN]
        broken = [
            cell for cell in verdict.cells if cell.status is Status.UNLIMITED and cell.excess > 0.1
        ]
        sentences = [
            *([] if verdict.cells else [f"{NOTHING_JUDGED}."]),
            *map(_sentence, verdict.failed),
            *_not_judged(verdict),
            *map(_sentence, broken),
            *map(_sentence, unshown),
        ]
        if verdict.passed:
            sentences.append("no attack that was made exceeds its limit.")
        lines += [f"{verdict.scheme}: {sentence}" for sentence in sentences]
    return lines


def _not_judged(verdict: Verdict) -> list[str]:
    """Name the rows that are not judged, a line for each reason; of controls the attacks only."""
    rows: dict[str, list[str]] = {}
    for outcome in verdict.unjudged:
        measured = outcome.measured
        reached = f": {measured.value:.3g} [{measured.ci_low:.3g}, {measured.ci_high:.3g}]"
        control = outcome.unjudged == CONTROL
        row = outcome.attack if control else outcome.name + reached
        rows.setdefault(str(outcome.unjudged), []).append(row)
    return [
        f"not judged ({reason}): {'; '.join(dict.fromkeys(rows[reason]))}."
        for reason in sorted(rows, key=lambda reason: reason == CONTROL)
    ]


_SAID = {
    Status.FAIL: "fails",
    Status.UNLIMITED: "is broken, and no limit is set on it",
    Status.NOT_SHOWN: "is not shown to hold: the sample is too small",
}


def _sentence(cell: Cell) -> str:
    outcome = cell.outcome
    bound = "" if cell.status is Status.UNLIMITED else f", limit {cell.most:.3g}"
    return (
        f"{outcome.breaks} {_SAID[cell.status]}: {outcome.name}, leaked {outcome.leaked}, "
        f"attacker with {outcome.knowledge}: "
        f"{cell.excess:.3g} [{cell.low:.3g}, {cell.high:.3g}]{bound}."
    )
