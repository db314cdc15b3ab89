"""The audit of attributes: what the templates of FairFace tell of gender, race and age."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from attacks.attributes.experiment import run_scheme
from attacks.attributes.faces import (
    LabelledFaces,
    Split,
    attacker_faces,
    split,
)
from attacks.attributes.plan import (
    AttributePlan,
    prepare,
    require_decoys,
    require_folds,
)
from attacks.attributes.rows import AttributeRow, strongest
from attacks.errors import AuditError
from attacks.outcomes import (
    COMPARED,
    GENERATED,
    RAW_SCHEME,
    AttackOutcome,
    KnowledgeLevel,
    Leaked,
    Property,
    Scheme,
)
from attacks.population import LEAST_FITTED
from models.extraction import Extraction
from templates.decoys import DecoyGenerator
from verify.evaluation.attributes import resembling_rows
from verify.fairface_labels import CLASSES, Label
from verify.own_decoys import require_others

PAPER_LIFTING = 10_000
LIFTING_SHARE = 0.3
"""Of the training faces, where they are too few for the paper's 10,000."""

ATTACK = "attribute-inference"
_HAS = {
    KnowledgeLevel.ALGORITHM: "One template, how templates are lifted, and labelled faces of other "
    "people, which it lifts itself to learn from",
    KnowledgeLevel.DECOYS: "The same, and the pool that the decoys were drawn from",
}


def default_lifting(training: int) -> int:
    """Size of the lifting database: the paper's, or three tenths of a smaller training set."""
    return min(PAPER_LIFTING, max(LEAST_FITTED, int(LIFTING_SHARE * training)))


def labelled_faces(
    photos: Extraction, labels: Mapping[Path, Label], attributes: Sequence[str]
) -> LabelledFaces:
    """Join the photos that were embedded with their labels."""
    return LabelledFaces.of_names(
        photos.descriptors,
        {name: [str(getattr(labels[path], name)) for path in photos.paths] for name in attributes},
        {name: CLASSES[name] for name in attributes},
    )


def _sample(labels: Mapping[Path, Label], most: int | None, seed: int) -> Mapping[Path, Label]:
    """Choose at most so many photos at random; all where None."""
    if most is None or most >= len(labels):
        return labels
    photos = list(labels)
    chosen = np.random.default_rng([seed, 3]).permutation(len(photos))[:most]
    return {photos[index]: labels[photos[index]] for index in sorted(chosen.tolist())}


@dataclass(frozen=True, kw_only=True)
class AttributeAuditPlan:
    """What is inferred from the templates of which schemes, and how.

    Parameters
    ----------
    lifting
        Training faces that are the lifting database; see :func:`default_lifting`.
    attack, attacked
        Most training faces that the attacker has, and most validation faces that are attacked;
        None for all.
    axes
        That faces are projected on for generated decoys; None for all.
    drop_duplicates
        Cosine from which an attacked face resembles a training face too much; None to keep all.
    """

    schemes: tuple[Scheme, ...]
    attributes: tuple[str, ...]
    attackers: AttributePlan
    lifting: int
    attack: int | None = None
    attacked: int | None = None
    axes: int | None = None
    drop_duplicates: float | None = None
    seed: int = 0

    def sample(
        self, train: Mapping[Path, Label], validation: Mapping[Path, Label]
    ) -> tuple[Mapping[Path, Label], Mapping[Path, Label]]:
        """Choose the photos that take part, so that no others are embedded.

        A face costs a hundred times what an attack on it does.
        """
        most = None if self.attack is None else self.lifting + self.attack
        return _sample(train, most, self.seed), _sample(validation, self.attacked, self.seed)

    def attacker_faces(self, training: int) -> int:
        """Return how many of so many training faces are the attacker's.

        Raises
        ------
        AuditError
            There are too few training faces.
        """
        # Which photos give no embedding is not known beforehand.
        most = None if self.attack is None else min(self.attack, max(1, training - self.lifting))
        return attacker_faces(training, lifting=self.lifting, attack=most)

    def require_faces(self, train: Mapping[Path, Label]) -> None:
        """Refuse, before anything is embedded, what would fail even if every photo had a face.

        Raises
        ------
        AuditError
            There are too few training faces for the plan.
        """
        attack = self.attacker_faces(len(train))
        require_folds(attack, self.attackers)
        require_decoys(
            self.schemes,
            list(train.values()),
            lifting=self.lifting,
            fold=attack // self.attackers.folds,
        )


@dataclass(frozen=True, eq=False)
class AttributeAudit:
    """What an audit found."""

    rows: list[AttributeRow]
    split: Split
    duplicates: int

    def settings(self) -> dict[str, int]:
        """Return the sizes of the parts, for the report."""
        return {
            "lifting": len(self.split.lifting),
            "attack": len(self.split.attack),
            "attacked": len(self.split.attacked),
            "duplicates_dropped": self.duplicates,
        }


def run_attribute_audit(
    plan: AttributeAuditPlan,
    train: LabelledFaces,
    validation: LabelledFaces,
    *,
    generator: DecoyGenerator | None = None,
    progress: Callable[[float], None] = lambda _share: None,
) -> AttributeAudit:
    """Infer attributes from the templates of validation faces.

    Parameters
    ----------
    generator
        The deployment's own, on the plan's axes. Without one, a generator is fitted to the lifting
        faces.
    progress
        Called with the share of the attacks that is done, which rises to 1.

    Raises
    ------
    AuditError
        There are too few faces for the plan.
    """
    duplicates = 0
    if plan.drop_duplicates is not None:
        # FairFace's two parts share photos, and who has the victim's own face infers nothing.
        dropped = resembling_rows(
            validation.descriptors, train.descriptors, cosine=plan.drop_duplicates
        )
        validation = validation.take(np.setdiff1d(np.arange(len(validation)), dropped))
        duplicates = len(dropped)
    parts = split(
        train,
        validation,
        lifting=plan.lifting,
        attack=plan.attacker_faces(len(train)),
        attacked_most=plan.attacked,
        seed=plan.seed,
    )
    if generator is None:
        generator = DecoyGenerator.fit(parts.lifting.descriptors)
        generator = generator.reduced(plan.axes or generator.k)
    else:
        people = [str(number) for number in range(len(parts.attacked))]
        require_others(generator, parts.attacked.descriptors, people)
    whole = prepare(parts, plan=plan.attackers, seed=plan.seed)
    ours = prepare(parts.along(generator), plan=plan.attackers, seed=plan.seed, generator=generator)
    setups = [ours if scheme.decoys == GENERATED else whole for scheme in plan.schemes]
    rows: list[AttributeRow] = []
    progress(0.0)
    for number, (setup, scheme) in enumerate(zip(setups, plan.schemes, strict=True), start=1):
        rows += run_scheme(setup, scheme)
        progress(number / len(setups))
    return AttributeAudit(rows, parts, duplicates)


def attribute_outcomes(rows: Sequence[AttributeRow], *, audited: Scheme) -> list[AttackOutcome]:
    """Report the strongest attacker on each scheme and attribute, by what it knows.

    The strongest is chosen on faces of the attacker's own (see ``attributes.rows.strongest``).
    Chance is what its very predictions would score dealt out at random: an attacker who knows
    nothing stays below the majority's share, and would seem to know something. What is left to it
    is judged by what raw embeddings gain over the majority's share.

    Parameters
    ----------
    rows
        Of raw embeddings too.
    audited
        The scheme that is judged; the others are reported to compare with.

    Raises
    ------
    AuditError
        There is no row of raw embeddings.
    """
    best = strongest(rows)
    gains = {
        attribute: row.accuracy - row.chance
        for (scheme, attribute, _), row in best.items()
        if scheme == RAW_SCHEME
    }
    if not gains:
        raise AuditError("what templates tell is judged by what raw embeddings tell: add `raw`")
    outcomes = []
    for (scheme, attribute, knowledge), row in best.items():
        unjudged = None if scheme == audited else COMPARED
        if unjudged is None and gains[attribute] <= 0:
            unjudged = "raw embeddings do not tell it either"
        outcomes.append(
            AttackOutcome(
                attack=ATTACK,
                variant=f"{attribute} by {row.attacker}",
                breaks=Property.CONFIDENTIALITY,
                leaked=Leaked.HOLDER_KEYS,
                knowledge=knowledge,
                assumption=f"{_HAS[knowledge]}; success is the right {attribute}.",
                scheme=scheme,
                measured=row.measures.accuracy,
                chance=row.chance_of_predictions,
                unjudged=unjudged,
                details={
                    "majority": row.chance,
                    "raw_gain": gains[attribute],
                    "balanced_accuracy": row.measures.balanced_accuracy,
                    "leakage": str(row.measures.leakage),
                    "chosen_among": "the attacker's own held-out faces",
                },
            )
        )
    return outcomes
