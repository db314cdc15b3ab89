"""What every attack reports: who was assumed to know what, and how often it succeeded."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.errors import VeilfaceError
from verify.metrics import rate


class AuditError(VeilfaceError):
    """An attack or an audit that cannot be made as it was ordered."""


class Property(StrEnum):
    """What an attack breaks: the properties of ISO/IEC 24745, and one beside them."""

    IRREVERSIBILITY = "irreversibility"
    """Nobody gets the embedding, or a face, out of a template."""
    UNLINKABILITY = "unlinkability"
    """Nobody tells whether two templates, of two tenants, are of one person."""
    RENEWABILITY = "renewability"
    """A template that was stolen is of no use once another has replaced it."""
    CONFIDENTIALITY = "confidentiality"
    """Nobody learns gender, race or age from a template."""
    IMPERSONATION = "impersonation"
    """Nobody is accepted but the person. Not of ISO/IEC 24745, and what the service exists for."""


class Leaked(StrEnum):
    """What was stolen, as ISO/IEC 30136 asks to say; each includes the ones before it.

    No attack begins at the database alone, which is ciphertext: what is measured there needs
    nothing of it.
    """

    DATABASE = "database"
    """Nothing, or the database without the master key."""
    MASTER_KEY = "master key"
    """Database and every secret of the deployment, of templates whose holders keep a key: each is
    still turned by a rotation that nothing stolen gives."""
    HOLDER_KEYS = "holder keys"
    """Every key that a template's rotations need: un-rotated templates. Where no holder keeps a
    key, the master key gives as much."""


class KnowledgeLevel(StrEnum):
    """What the attacker has beside what was stolen: a column of the report.

    Each but the last includes the one before.
    """

    TEMPLATE = "template"
    """One template, and that embeddings are of unit length."""
    ALGORITHM = "algorithm"
    """How templates are lifted, the model, the decoy generator (clients have it), other faces."""
    DECOYS = "decoys"
    """The decoy pool, which is a secret of the deployment."""
    TEMPLATES = "templates"
    """The algorithm, and several templates: of the victim, or of a whole tenant."""


@dataclass(frozen=True)
class Knowledge:
    """What an attack takes: one template, unless it says otherwise, and these."""

    template: bool = True  # false where nothing needs to be stolen
    several: bool = False  # several templates of one person
    generator: bool = False  # how templates are lifted, the model and the generator, as clients
    faces: bool = False  # photos of other people
    lifting: bool = False  # to lift faces as the service does, which of a pool takes the pool
    pool: bool = False  # the decoy pool

    def level(self, scheme: "Scheme") -> KnowledgeLevel:
        """Return the column of the report, for templates of a scheme."""
        if self.several:
            return KnowledgeLevel.TEMPLATES
        if self.pool or (self.lifting and scheme.decoys == POOLED):
            return KnowledgeLevel.DECOYS
        knows = self.generator or self.faces or self.lifting
        return KnowledgeLevel.ALGORITHM if knows else KnowledgeLevel.TEMPLATE


GENERATED, POOLED = "generator", "pool"
CONTROL = "a control"
COMPARED = "the scheme is there to compare with"
RAW = "raw"


@dataclass(frozen=True)
class Scheme:
    """A way of protecting embeddings."""

    strategy: str  # a ``templates.space.lifting.Strategy``, or ``raw``
    decoys: str | None  # ``pool`` or ``generator``; None where the strategy takes none
    dim: int  # m; 0 for raw embeddings
    axes: int | None = None  # numbers of what is lifted, k; None where that is not projected

    def __str__(self) -> str:
        if self.strategy == RAW:
            return "raw embeddings"
        source = {GENERATED: ", generated decoys", POOLED: ", decoys of a pool"}
        axes = "" if self.axes is None else f" of {self.axes} axes"
        return f"{self.strategy}, m = {self.dim}{axes}{source.get(self.decoys or '', '')}"

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> "Scheme":
        """Return the scheme of a row that has the fields."""
        axes = row.get("axes")
        return cls(
            str(row["strategy"]),
            row["decoys"],
            int(row["dim"]),
            None if axes is None else int(axes),
        )

    def to_json(self) -> dict[str, Json]:
        """Return the fields."""
        return asdict(self)


RAW_SCHEME = Scheme(RAW, None, 0)


@dataclass(frozen=True)
class Estimate:
    """A measure that is no count, with its 95 % interval."""

    value: float
    ci_low: float
    ci_high: float
    trials: int  # number of scores that it rests on
    interval: str  # how the bounds were computed

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return asdict(self)


Measured: TypeAlias = Rate | Estimate


@dataclass(frozen=True, kw_only=True)
class AttackOutcome:
    """One attack on one scheme."""

    attack: str  # its name, such as ``foot-point``; one name has one meaning in all reports
    variant: str = ""  # what distinguishes it from this attack's other outcomes on this scheme
    breaks: Property
    leaked: Leaked
    knowledge: KnowledgeLevel
    assumption: str  # what the attacker has and does, and what counts as success, in a sentence
    scheme: Scheme
    level: str | None = None  # that success is judged at, such as ``fmr-1e-3``
    measured: Measured
    chance: float  # how often guessing would succeed: the level's FMR, or the majority class
    # Why the verdict does not count it, as the end of a sentence that begins "not judged:"; None
    # where it does. ``CONTROL`` for a control, ``COMPARED`` where it is not of the audited scheme.
    unjudged: str | None = None
    # Further figures. Never a number of an embedding or a template.
    details: Mapping[str, Json] = field(default_factory=dict)

    @property
    def judged(self) -> bool:
        """Whether the verdict counts it."""
        return self.unjudged is None

    @property
    def succeeds(self) -> bool:
        """Whether its interval lies above what guessing gives.

        Of a D_sys that is the 95th percentile of its permutation null, of a share its chance.
        """
        guessing = self.details.get("null_95_percent", self.chance)
        return self.measured.ci_low > float(str(guessing))

    @property
    def name(self) -> str:
        """The attack, with its variant."""
        return self.attack + (f" ({self.variant})" if self.variant else "")

    def to_json(self) -> dict[str, Json]:
        """Return a row of ``outcomes`` of the report."""
        rate = self.measured.to_json()
        rate["value"] = self.measured.value
        return {
            "attack": self.attack,
            "variant": self.variant,
            "property": str(self.breaks),
            "leaked": str(self.leaked),
            "knowledge": str(self.knowledge),
            "assumption": self.assumption,
            **self.scheme.to_json(),
            "level": self.level,
            "measured": rate,
            "chance": self.chance,
            "judged": self.judged,
            "unjudged": self.unjudged,
            "details": dict(self.details),
        }


def unproven(control: AttackOutcome, what: str) -> str | None:
    """Return why rows are not judged whose control fails; None where it shows that they may be.

    What an attack does not get proves something only where the same attack gets it if it can. So a
    row is judged by its control, and never by its own result.
    """
    if control.succeeds:
        return None
    return f"it proves nothing, for its control, {what}, does not succeed either"


def share_of(hits: NDArray[np.bool_]) -> Rate:
    """Count successes as a rate with its interval."""
    return rate(int(np.count_nonzero(hits)), len(hits))


def joined(*parts: str) -> str:
    """Put the parts of a variant's name together, without the empty ones."""
    return ", ".join(part for part in parts if part)
