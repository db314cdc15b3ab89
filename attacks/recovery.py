"""Guesses of embeddings: how they are scored, and which controls the strongest has."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Attack, Guesses
from attacks.bed import LEAST_FACES, LEAST_VICTIMS, Pairs, Testbed
from attacks.outcomes import CONTROL, AttackOutcome, Leaked, joined, share_of, unproven
from attacks.rotations import KEPT, holder_rotations_of, turned
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch
from verify.comparisons import through_wire

MATCH_FMR = 1e-3
"""Of the raw comparison that decides whether a guess is a match."""
CONTROL_DIM = 4
"""Dimension of the templates that show that an attack works at all."""
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
class Recovery:
    """One variant of an attack that guesses embeddings, scored."""

    attack: str
    guesses: Guesses
    matched: Rate  # guesses that match a fresh photo of the person, at raw FMR 1e-3
    control: Rate  # those that match the photo of the next person: by chance only
    # Probability that a guess is nearer to a photo of its own person than to one of another. It
    # shows what leaks where nothing crosses the threshold.
    auc: float
    to_truth: float  # mean cosine to the embedding that was lifted

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
            "found": self.matched.to_json(),
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
                share_of(own >= bed.match_cosine),
                share_of(others >= bed.match_cosine),
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


def recovered(attack: Attack, bed: Testbed, setting: str = "") -> list[AttackOutcome]:
    """Score the guesses, and make the controls of the strongest variant.

    These are the same guesses against photos of the next victim (a control); the same attack where
    the holder keeps a key, which is judged where the attack succeeds with the key; and where it
    does not, on templates of m = 4, which shows that it is an attack at all (a control).
    """
    made = recoveries(attack, bed)
    few = None
    if attack.needs.several and len(bed.victims) < JUDGED_PEOPLE:
        few = f"fewer than {JUDGED_PEOPLE} people have the photos"

    def row(one: Recovery, how: str = "", leaked: Leaked = Leaked.HOLDER_KEYS) -> AttackOutcome:
        return attack.row(
            bed,
            variant=joined(setting, one.guesses.variant, how),
            leaked=leaked,
            level="fmr-1e-3",
            measured=one.matched,
            chance=MATCH_FMR,
            unjudged=one.guesses.unjudged or few,
            details={
                "auc": one.auc,
                "cosine_to_truth_mean": one.to_truth,
                "people": one.matched.trials,
                "too_few": _too_few(attack, bed),
                **one.guesses.details,
            },
        )

    rows = [row(one) for one in made]
    own = [one for one in made if one.guesses.people is None and one.guesses.unjudged is None]
    if not own:
        return rows
    best = max(own, key=lambda one: (one.matched.value, one.auc))
    strongest = rows[made.index(best)]
    others = row(best, "photos of other people")
    rows.append(replace(others, measured=best.control, unjudged=CONTROL, details={}))

    def repeated(other: Testbed) -> Recovery:
        return next(
            one
            for one in recoveries(attack, replace(other, drawn=None))
            if one.guesses.variant == best.guesses.variant
        )

    kept = row(repeated(_under_holder_keys(bed)), KEPT, Leaked.MASTER_KEY)
    proven = unproven(strongest, "the same with the holder's key")
    rows.append(replace(kept, unjudged=kept.unjudged or proven))
    if proven and not bed.batches and bed.m > CONTROL_DIM:
        few_decoys = row(repeated(bed.at(CONTROL_DIM, "few decoys")), f"m = {CONTROL_DIM}")
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


def several_templates(bed: Testbed) -> Iterator[tuple[Testbed, str]]:
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
