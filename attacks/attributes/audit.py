"""The audit of attributes: what the templates of FairFace tell of gender, race and age."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from attacks.attributes.experiment import run_scheme
from attacks.attributes.faces import LabelledFaces, Split, split
from attacks.attributes.plan import AttributePlan, prepare
from attacks.attributes.rows import AttributeRow, strongest
from attacks.outcomes import (
    COMPARED,
    GENERATED,
    RAW_SCHEME,
    AttackOutcome,
    AuditError,
    KnowledgeLevel,
    Leaked,
    Property,
    Scheme,
)
from models.extraction import Extraction
from templates.decoys import DecoyGenerator
from templates.decoys.fitting import MIN_DESCRIPTORS
from verify.fairface_labels import CLASSES
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
    return min(PAPER_LIFTING, max(MIN_DESCRIPTORS, int(LIFTING_SHARE * training)))


def labelled_faces(photos: Extraction, labels: Mapping[Path, Mapping[str, str]]) -> LabelledFaces:
    """Join the photos that were embedded with their labels."""
    return LabelledFaces.of_names(
        photos.embeddings,
        {name: [labels[path][name] for path in photos.paths] for name in CLASSES},
        CLASSES,
    )


def run_attribute_audit(
    plan: AttributePlan,
    train: LabelledFaces,
    validation: LabelledFaces,
    *,
    generator: DecoyGenerator | None = None,
    progress: Callable[[float], None] = lambda _share: None,
) -> tuple[list[AttributeRow], Split]:
    """Infer attributes from the templates of validation faces: rows, and the parts of faces.

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
    parts = split(
        train,
        validation,
        lifting=plan.lifting,
        attack=plan.attacker_faces(len(train)),
        attacked_most=plan.attacked,
        seed=plan.seed,
    )
    if generator is None:
        generator = DecoyGenerator.fit(parts.lifting.embeddings)
        generator = generator.reduced(plan.axes or generator.k)
    else:
        people = [str(number) for number in range(len(parts.attacked))]
        require_others(generator, parts.attacked.embeddings, people)
    whole = prepare(parts, plan=plan)
    ours = prepare(parts.along(generator), plan=plan, generator=generator)
    rows: list[AttributeRow] = []
    progress(0.0)
    for number, scheme in enumerate(plan.schemes, start=1):
        rows += run_scheme(ours if scheme.decoys == GENERATED else whole, scheme)
        progress(number / len(plan.schemes))
    return rows, parts


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
        attribute: row.accuracy.value - row.chance
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
                measured=row.accuracy,
                chance=row.chance_of_predictions,
                unjudged=unjudged,
                details={
                    "majority": row.chance,
                    "raw_gain": gains[attribute],
                    "balanced_accuracy": row.balanced_accuracy,
                    "chosen_among": "the attacker's own held-out faces",
                },
            )
        )
    return outcomes
