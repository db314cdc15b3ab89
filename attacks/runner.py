"""Runs an attack: its results are scored, its controls made, its rows judged, for all alike.

A new attack is one function in a file of ``attacks/stored``, which says by :func:`attack` what it
breaks and what it takes. Its docstring is the assumption that the report prints. It yields one of
four things: guesses of embeddings, probes to present, scores of two templates, or successes that
it has counted itself.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from attacks.bed import LEAST_FACES, LEAST_VICTIMS, Pairs, Testbed
from attacks.decisions import fmr_of, score
from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked, Property, unproven
from attacks.rotations import holder_rotations_of, rotations_of, turned, turned_back, turned_points
from attacks.unlinkability import unlinkability
from templates.contract.canonical import Json
from templates.contract.document import Calibration
from templates.contract.levels import Rate
from templates.errors import InvalidEmbedding
from templates.keys.rotation import SignedCosineRotation
from templates.space.embedding import normalised, unit_rows
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes as Sent
from verify.comparisons import through_wire
from verify.metrics import rate

MATCH_FMR = 1e-3
"""Of the raw comparison that decides whether a guess is a match."""
KEPT = "holder's key kept"
WITH_KEY, WITHOUT_KEY = "with the key", "without the key"
OPEN, ONE_SET = "keys leaked", "one set for both"
CONTROL_DIM = 4
"""Dimension of the templates that show that an attack works at all."""
LINKED = 100
"""Victims whose templates are linked across tenants: every two of them are compared."""
LIFTINGS = 2
"""Times that they are lifted, with other decoys and other keys, which makes histograms finer."""
JUDGED_PEOPLE = 75
"""Of fewer people a share says too little to judge by: of none of 74 the upper bound is 4 %, twice
the limit where keys are kept."""
COUNTS = (2, 5)
"""Numbers of templates of different photos."""
TWO_SECRETS = "the same photos under two lift secrets"
OVERLAP = "two of three photos the same"
OVERLAPPING = ((0, 1, 2), (0, 1, 3))
"""Photos of two enrollments that overlap."""


@dataclass(frozen=True, eq=False, repr=False)
class Guesses:
    """Guesses of the embeddings that templates hide; success is a match with a fresh photo.

    Parameters
    ----------
    points : (V, k) floating
        One for each victim; their length does not matter. A zero row is a failure.
    variant
        What distinguishes them from the other guesses of the attack.
    people
        Who was attacked instead of the bed's victims.
    details
        Further figures for the report.
    unjudged
        Why the verdict does not count them.
    """

    points: NDArray[np.floating]
    variant: str = ""
    people: Pairs | None = None
    details: Mapping[str, Json] = field(default_factory=dict)
    unjudged: str | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Probes:
    """What the attacker sends, one for each victim or one for all; success is acceptance.

    ``sent`` are (V, k) or (1, k) float32, or lifted probes of the contract's dimension.
    """

    sent: Sent
    variant: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class LinkScores:
    """Of template i of one batch with template j of the other, (V, V): more where one person is."""

    values: NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Hits:
    """Victims whom the attack has opened, (V,), and how often guessing would have."""

    hits: NDArray[np.bool_]
    variant: str
    chance: float
    details: Mapping[str, Json] = field(default_factory=dict)


Result: TypeAlias = Guesses | Probes | LinkScores | Hits


@dataclass(frozen=True)
class Attack:
    """An attack that the runner knows; see :func:`attack`."""

    run: Callable[[Testbed], Iterable[Result]]
    breaks: Property
    needs: Knowledge

    @property
    def name(self) -> str:
        """Name of the attack in reports: that of its function."""
        return str(getattr(self.run, "__name__", "")).replace("_", "-")

    @property
    def assumption(self) -> str:
        """What the attacker does, in a sentence."""
        return " ".join((self.run.__doc__ or "").split("\n\n")[0].split())

    def row(self, bed: Testbed, **fields: object) -> AttackOutcome:
        """Return a row of the report, with what every row of the attack says."""
        common = {
            "attack": self.name,
            "breaks": self.breaks,
            "knowledge": self.needs.level(bed.scheme),
            "assumption": self.assumption,
            "scheme": bed.scheme,
        }
        return AttackOutcome(**(common | fields))  # type: ignore[arg-type]


def attack(
    *, breaks: Property, needs: Knowledge
) -> Callable[[Callable[[Testbed], Iterable[Result]]], Attack]:
    """Declare a function of a test bed to be an attack.

    Parameters
    ----------
    breaks
        The property that it breaks.
    needs
        What it takes.
    """
    return partial(Attack, breaks=breaks, needs=needs)


def run_attack(attack: Attack, bed: Testbed) -> list[AttackOutcome]:
    """Make an attack on the victims' templates, with its controls; a row for each variant."""
    if attack.breaks is Property.UNLINKABILITY:
        return _linked(attack, bed)
    if attack.needs.several:
        return [row for several in _several(bed) for row in _recovered(attack, *several)]
    if attack.breaks is Property.IRREVERSIBILITY:
        return _recovered(attack, bed)
    return _sent(attack, bed)


# Guesses of embeddings


@dataclass(frozen=True, eq=False, repr=False)
class Recovery:
    """One variant of an attack that guesses embeddings, scored.

    Parameters
    ----------
    found
        Guesses that match a fresh photo of the person, at raw FMR 1e-3.
    control
        Those that match the photo of the next person, as should happen by chance only.
    auc
        Probability that a guess is nearer to a photo of its own person than to one of another:
        0.5 where it tells nothing. It shows what leaks where nothing crosses the threshold.
    to_truth
        Mean cosine to the embedding that was lifted.
    """

    attack: str
    guesses: Guesses
    found: Rate
    control: Rate
    auc: float
    to_truth: float

    @property
    def faces(self) -> int | None:
        """Faces that the attacker has; None where it knows their moments exactly."""
        faces = self.guesses.details.get("faces", 0)
        return faces if isinstance(faces, int) else None

    def to_json(self) -> dict[str, Json]:
        """Return an entry of the attacks that a verdict rests on."""
        return {
            "attack": self.attack.replace("-", " "),
            "faces": 0,
            "counted": "nothing",
            "share_of_decoys": 1.0,
            **self.guesses.details,
            "found": self.found.to_json(),
            "control": self.control.to_json(),
            "auc": self.auc,
        }


def recoveries(attack: Attack, bed: Testbed) -> list[Recovery]:
    """Let an attack guess, and score every variant."""
    made = []
    for guesses in attack.run(bed):
        if not isinstance(guesses, Guesses):
            raise TypeError(f"{attack.name} must yield guesses")
        people = guesses.people or bed.victims
        unit = normalised(guesses.points.astype(np.float64))
        own, others = (
            np.einsum("ij,ij->i", unit, fresh)
            for fresh in (people.fresh, np.roll(people.fresh, 1, axis=0))
        )
        made.append(
            Recovery(
                attack.name,
                guesses,
                _share(own >= bed.match_cosine),
                _share(others >= bed.match_cosine),
                round(area_under_curve(unit @ people.fresh.T), 4),
                float(np.einsum("ij,ij->i", unit, people.enrolled).mean()),
            )
        )
    return made


def area_under_curve(scores: NDArray[np.floating]) -> float:
    """Probability that a score of one's own exceeds one of another's, ties half; (V, V) scores.

    The area under the ROC curve, of the diagonal against all else; 0.5 of a single person.
    """
    own = np.diagonal(scores)
    others = np.sort(scores[~np.eye(len(scores), dtype=np.bool_)])
    if not len(others):
        return 0.5
    below = np.searchsorted(others, own, side="left") + np.searchsorted(others, own, side="right")
    return float(below.mean() / (2 * len(others)))


def _recovered(attack: Attack, bed: Testbed, setting: str = "") -> list[AttackOutcome]:
    """Score the guesses, and make the controls of the strongest variant.

    These are the same guesses against photos of the next victim (a control); the same attack where
    the holder keeps a key, which is judged where the attack succeeds with the key; and where it
    does not, on templates of m = 4, which shows that it is an attack at all (a control).
    """
    found = recoveries(attack, bed)
    few = None
    if attack.needs.several and len(bed.victims) < JUDGED_PEOPLE:
        few = f"fewer than {JUDGED_PEOPLE} people have the photos"

    def row(one: Recovery, made: str = "", leaked: Leaked = Leaked.HOLDER_KEYS) -> AttackOutcome:
        return attack.row(
            bed,
            variant=_joined(setting, one.guesses.variant, made),
            leaked=leaked,
            level="fmr-1e-3",
            measured=one.found,
            chance=MATCH_FMR,
            unjudged=one.guesses.unjudged or few,
            details={
                "auc": one.auc,
                "cosine_to_truth_mean": one.to_truth,
                "people": one.found.trials,
                "too_few": _too_few(attack, bed),
                **one.guesses.details,
            },
        )

    rows = [row(one) for one in found]
    own = [one for one in found if one.guesses.people is None and one.guesses.unjudged is None]
    if not own:
        return rows
    best = max(own, key=lambda one: (one.found.value, one.auc))
    strongest = rows[found.index(best)]
    others = row(best, "photos of other people")
    rows.append(replace(others, measured=best.control, unjudged=CONTROL, details={}))

    def again(other: Testbed) -> Recovery:
        return next(
            one
            for one in recoveries(attack, replace(other, drawn=None))
            if one.guesses.variant == best.guesses.variant
        )

    kept = row(again(_under_holder_keys(bed)), KEPT, Leaked.MASTER_KEY)
    proven = unproven(strongest, "the same with the holder's key")
    rows.append(replace(kept, unjudged=kept.unjudged or proven))
    if proven and not bed.batches and bed.m > CONTROL_DIM:
        few_decoys = row(again(bed.at(CONTROL_DIM, "few decoys")), f"m = {CONTROL_DIM}")
        rows.append(replace(few_decoys, unjudged=CONTROL))
    return rows


def _too_few(attack: Attack, bed: Testbed) -> str | None:
    most = max((each.faces or 0 for each in bed.attackers), default=0)
    if attack.needs.several or not attack.needs.faces:
        return None
    if len(bed.victims) >= LEAST_VICTIMS and most >= LEAST_FACES:
        return None
    return f"it takes {LEAST_VICTIMS} victims and {LEAST_FACES:,} faces of others"


def _under_holder_keys(bed: Testbed) -> Testbed:
    """Turn the templates as their holders' keys do, each enrollment in another way."""
    return replace(
        bed,
        templates=_kept(bed, bed.templates, "enrollment"),
        batches=tuple(
            _kept(bed, batch, f"enrollment {number}") for number, batch in enumerate(bed.batches)
        ),
    )


def _kept(bed: Testbed, batch: SubspaceBatch, enrollment: str) -> SubspaceBatch:
    stored = turned(batch, holder_rotations_of(bed, enrollment, len(batch)))
    return through_wire(stored, contract_id=bed.service.contract_id)


def _several(bed: Testbed) -> Iterator[tuple[Testbed, str]]:
    """Yield beds whose victims have several templates, and what these are of."""
    truth = bed.victims.enrolled
    twice = tuple(bed.lift(truth, f"under {name} secret") for name in ("one", "another"))
    yield replace(bed, batches=twice), f"{TWO_SECRETS}, {len(twice)} templates"
    groups: list[tuple[str, Sequence[Sequence[int]]]] = [(OVERLAP, OVERLAPPING)]
    groups += [("different photos", [[number] for number in range(count)]) for count in COUNTS]
    for name, photos in groups:
        most = max(max(numbers) for numbers in photos) + 1
        albums = [album for album in bed.albums if len(album) > most]
        if not albums:
            continue
        people = Pairs(
            _mean(bed, albums, range(most)), bed.source.project(np.stack([a[-1] for a in albums]))
        )
        batches = tuple(
            bed.lift(_mean(bed, albums, numbers), f"{name}, photos {list(numbers)}")
            for numbers in photos
        )
        other = replace(bed, victims=people, templates=batches[0], batches=batches)
        yield other, f"{name}, {len(batches)} templates"


def _mean(
    bed: Testbed, albums: Sequence[NDArray[np.float32]], numbers: Sequence[int]
) -> NDArray[np.float32]:
    """What some photos of every person enroll, (V, k): averaged, then projected."""
    means = [album[list(numbers)].mean(axis=0, dtype=np.float64) for album in albums]
    return bed.source.project(normalised(np.stack(means)).astype(np.float32))


# Probes that are presented


def _sent(attack: Attack, bed: Testbed) -> list[AttackOutcome]:
    """Present probes to the victims' templates, or to their renewed ones, after the input checks.

    Probes that are made from a stolen template are presented with its rotation known, and without:
    the service turns what it is sent once more. The latter are judged where the same is accepted
    with the key.
    """
    targets = bed.renewed if attack.breaks is Property.RENEWABILITY else bed.templates
    rows = []
    for made in attack.run(bed):
        if isinstance(made, Hits):
            rows.append(
                attack.row(
                    bed,
                    variant=made.variant,
                    leaked=Leaked.DATABASE,
                    level=bed.level.name,
                    measured=_share(made.hits),
                    chance=made.chance,
                    details=made.details,
                )
            )
        if not isinstance(made, Probes):
            continue
        if not attack.needs.template:
            rows += _presented(attack, bed, made.sent, targets, made.variant, Leaked.DATABASE)
            continue
        names = (_joined(made.variant, name) for name in (WITH_KEY, WITHOUT_KEY))
        rotations = rotations_of(bed, "replay", "template", len(targets))
        known = _presented(attack, bed, made.sent, targets, next(names), Leaked.HOLDER_KEYS)
        secret = _presented(
            attack, bed, _turned(made.sent, rotations), targets, next(names), Leaked.MASTER_KEY
        )
        rows += known
        rows += [
            replace(row, unjudged=unproven(control, WITH_KEY))
            for row, control in zip(secret, known, strict=True)
        ]
    return rows


def _turned(probes: Sent, rotations: Sequence[SignedCosineRotation]) -> Sent:
    if isinstance(probes, SubspaceBatch):
        return turned(probes, rotations)
    return np.ascontiguousarray(turned_points(probes, rotations), dtype=np.float32)


def _presented(
    attack: Attack,
    bed: Testbed,
    probes: Sent,
    targets: SubspaceBatch,
    variant: str,
    leaked: Leaked,
) -> list[AttackOutcome]:
    """Count who accepts; empty where the calibration lacks the service's default level."""
    calibration = bed.lifted if isinstance(probes, SubspaceBatch) else bed.points
    levels = () if calibration is None else calibration.levels
    level = next((one for one in levels if one.name == bed.level.name), None)
    if calibration is None or level is None:
        return []
    passed = passes_checks(probes, calibration)
    paired = len(probes) > 1  # probe i meets template i, or the only probe meets all
    accepted = score(probes, targets, bed.nobody, calibration, paired=paired).at(level)
    hits = (accepted if paired else accepted[0]) & passed
    return [
        attack.row(
            bed,
            variant=variant,
            leaked=leaked,
            level=level.name,
            measured=_share(hits),
            chance=fmr_of(level),
            details={
                "mode": calibration.mode,
                "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
            },
        )
    ]


def passes_checks(probes: Sent, calibration: Calibration) -> NDArray[np.bool_]:
    """Return which probes, (P,), pass the service's input checks."""
    if isinstance(probes, SubspaceBatch):
        low, high = calibration.foot_point_norm or (1.0, 0.0)
        return np.asarray((low <= probes.foot_norms) & (probes.foot_norms <= high))
    passed = np.ones(len(probes), dtype=np.bool_)
    for row, probe in enumerate(probes):
        try:
            unit_rows(probe, n=probes.shape[1], most=1)
        except InvalidEmbedding:
            passed[row] = False
    return passed


# Templates that are linked


def _linked(attack: Attack, bed: Testbed) -> list[AttackOutcome]:
    """Link two templates of each victim, one by one; success is D_sys.

    One tenant has enrolled each victim from what is enrolled, the other, or the same one again,
    from the fresh photo. All pairs of two victims are impostor pairs. Templates in secret rotations
    are judged where the attack links one set in two rotations, a control that is the last row.
    """
    scores: dict[str, list[NDArray[np.float64]]] = {}
    for number in range(LIFTINGS):
        for setting, sides in _sides(bed.first(LINKED), number).items():
            if attack.needs.unrotated and setting != OPEN:
                continue
            (made,) = attack.run(replace(bed, batches=sides))
            if not isinstance(made, LinkScores):
                raise TypeError(f"{attack.name} must yield scores of two templates")
            scores.setdefault(setting, []).append(made.values)
    rows = {}
    for setting, values in scores.items():
        measured = unlinkability(np.stack(values), seed=bed.seed)
        rows[setting] = attack.row(
            bed,
            variant=setting,
            leaked=Leaked.HOLDER_KEYS if setting == OPEN else Leaked.MASTER_KEY,
            measured=measured.d_sys,
            chance=measured.null_mean,
            unjudged=CONTROL if setting == ONE_SET else None,
            details={**measured.details(), "liftings": LIFTINGS},
        )
    if attack.needs.unrotated:
        return list(rows.values())
    proven = unproven(rows[ONE_SET], "one set in two rotations")
    return [
        row if name in (OPEN, ONE_SET) else replace(row, unjudged=proven)
        for name, row in rows.items()
    ]


def _sides(bed: Testbed, number: int) -> dict[str, tuple[SubspaceBatch, SubspaceBatch]]:
    """Return both templates of every person as each setting has them, in one lifting."""
    first = bed.lift(bed.victims.enrolled, f"linkage, first tenant {number}")
    second = bed.lift(bed.victims.fresh, f"linkage, second tenant {number}")
    count = len(first)
    left = rotations_of(bed, f"first {number}", "template", count)
    right = rotations_of(bed, f"second {number}", "template", count)
    again = rotations_of(bed, f"first {number}", "another template", count)
    hidden = turned(first, left), turned(second, right)
    return {
        "secret rotations": hidden,
        "one tenant": (hidden[0], turned(second, again)),
        KEPT: (
            turned(first, holder_rotations_of(bed, f"first {number}", count)),
            turned(second, holder_rotations_of(bed, f"second {number}", count)),
        ),
        OPEN: (turned_back(hidden[0], left), turned_back(hidden[1], right)),
        ONE_SET: (hidden[0], turned(first, right)),
    }


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


def _share(hits: NDArray[np.bool_]) -> Rate:
    return rate(int(np.count_nonzero(hits)), len(hits))
