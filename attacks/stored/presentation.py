"""Presentation: probes that are no photo of the subject: zero, central, wolf, replay.

See docs/method.md §4.7.

Wolves are chosen and improved on templates that the attacker lifts; the victims' templates and the
service's cohort are met once, at the end.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import Scores, score
from attacks.linkage import rotations_of, turned, turned_points
from attacks.outcomes import (
    POOLED,
    AttackOutcome,
    Knowledge,
    Leaked,
    Property,
    judged_by_controls,
)
from attacks.recovery import fmr_of
from attacks.stored.honest_probes import (
    honest_embedding,
    honest_flats,
    honest_lift,
    points_inside,
)
from attacks.stored.point_ascent import ascend_points
from attacks.stored.wolf_ascent import Ground, ascend_subspaces
from attacks.stored.wolves import ALONG_MEAN, CENTRAL, axis_wolves, canonical
from attacks.system import System
from templates.contract.canonical import Json
from templates.contract.document import Calibration, Level, Rate
from templates.contract.nobody import Nobody
from templates.decoys import client_source
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes
from verify.comparisons import through_wire
from verify.metrics import rate

TARGETS = 150
"""Templates that the attacker lifts to climb on; as many again to choose among the ends."""
_WITHOUT, _WITH = "without the key", "with the key"
COHORT_CLIMBED = 150
"""Of the attacker's cohort, those that the score is normalised by while it climbs; all of them
decide which end is best."""
STARTS = 6


@dataclass(frozen=True, eq=False, repr=False)
class OwnTemplates:
    """What the attacker lifts on their own.

    Parameters
    ----------
    targets, held_out
        Templates of the attacker's faces: to climb on, and to choose with.
    cohort
        Made as the service makes one, which lifted probes are held against.
    """

    targets: SubspaceBatch
    held_out: SubspaceBatch
    cohort: SubspaceBatch

    def ground(self, level: Level) -> Ground:
        """Return what the attacker climbs on with lifted probes, for a level."""
        return Ground.of(self.targets, self.cohort[:COHORT_CLIMBED], level)


def lift_own_templates(system: System) -> OwnTemplates:
    """Lift the attacker's faces, and a cohort with the generator that clients have.

    Templates are lifted with the scheme's decoys: see ``wolf_knowledge``.
    """
    faces = np.random.default_rng(system.seed).permutation(system.attacker)[: 2 * TARGETS]
    half = len(faces) // 2
    with Keystream.seeded("audit", system.seed, str(system.scheme), "attacker's cohort") as stream:
        seed = stream.token(KEY_BYTES)
    generator = client_source(system.source)
    return OwnTemplates(
        targets=system.lift(faces[:half], "attacker's targets"),
        held_out=system.lift(faces[half:], "attacker's held-out targets"),
        cohort=Nobody(generator, system.strategy, system.scheme.dim, seed).cohort,
    )


def wolf_knowledge(system: System) -> Knowledge:
    """Return what lifting as the service does takes: a generator is public, a pool is secret."""
    return Knowledge.DECOYS if system.scheme.decoys == POOLED else Knowledge.ALGORITHM


def presentation_attack(system: System) -> list[AttackOutcome]:
    """All probes, raw and, where the contract takes them, lifted.

    Each is judged by the decision, after the input checks.
    """
    own = lift_own_templates(system)
    outcomes = _raw(system, own)
    if system.lifted is not None:
        outcomes += _lifted(system, system.lifted, own)
    return judged_by_controls(outcomes, _WITHOUT, _WITH)


@dataclass(frozen=True, eq=False, repr=False)
class Trial:
    """One kind of probe.

    Parameters
    ----------
    does
        What the attacker does with it, to complete "The attacker …".
    probes
        One for each victim, or one for all.
    """

    variant: str
    does: str
    probes: Probes
    knowledge: Knowledge = Knowledge.ALGORITHM
    leaked: Leaked = Leaked.DATABASE


def _raw(system: System, own: OwnTemplates) -> list[AttackOutcome]:
    calibration, n = system.points, system.templates.n
    level = calibration.level(system.contract.default_level)
    zero = np.zeros((1, n), dtype=np.float32)
    plain = _plain_wolves(system.attacker)
    starts = np.concatenate([plain, system.attacker[:STARTS]])
    inside = points_inside(system.templates, seed=system.seed)
    rotations = rotations_of(system, "replay", "template", len(inside))
    as_stored = turned_points(inside, rotations).astype(np.float32)

    def wolf(variant: str, does: str, made: Callable[[Level], NDArray[np.float32]]) -> Trial:
        candidates = made(level)
        shares = accepted_shares(candidates, own, system.nobody, calibration, level)
        best = candidates[[int(np.argmax(shares))]]
        return Trial(variant, does, best, wolf_knowledge(system))

    def climbed(level: Level) -> NDArray[np.float32]:
        return ascend_points(starts, own.targets, system.nobody, threshold=level.threshold)

    trials = [
        Trial("zero embedding", "sends the zero vector", zero),
        wolf(
            "wolf embedding, axes of faces",
            "sends the best of the mean face and the principal axes of their faces",
            lambda _: plain,
        ),
        wolf(
            "wolf embedding, optimised",
            "climbs on templates that they lift until as many as possible accept one embedding",
            climbed,
        ),
        Trial(
            f"replay as embedding, {_WITH}",
            "has stolen the template and the tenant's key, may send embeddings, and sends a "
            "unit vector of the template",
            inside,
            leaked=Leaked.HOLDER_KEYS,
        ),
        Trial(
            f"replay as embedding, {_WITHOUT}",
            "has stolen the template in its rotation, may send embeddings, and sends a unit vector "
            "of it, which the service turns once more",
            as_stored,
            leaked=Leaked.MASTER_KEY,
        ),
    ]
    return [outcome for trial in trials for outcome in _outcomes(system, calibration, trial)]


def _lifted(system: System, calibration: Calibration, own: OwnTemplates) -> list[AttackOutcome]:
    m, n = calibration.probe_m, system.templates.n
    level = calibration.level(system.contract.default_level)
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    rng = np.random.default_rng(system.seed)
    wolves = axis_wolves(system.attacker, m, foot_norm=(low + high) / 2, seed=system.seed)
    central = SubspaceBatch.of(
        [canonical(np.zeros(n), rng.standard_normal((m, n))) for _ in range(len(system.templates))]
    )
    inside = honest_flats(system.templates, calibration)
    as_stored = turned(inside, rotations_of(system, "replay", "template", len(inside)))

    def shares(probes: SubspaceBatch, level: Level) -> NDArray[np.float64]:
        return accepted_shares(probes, own, system.nobody, calibration, level)

    def wolf(variant: str, does: str, made: Callable[[Level], SubspaceBatch]) -> Trial:
        received = through_wire(made(level), contract_id=system.contract.contract_id)
        honest = honest_lift(received, calibration)
        if honest.any():
            received = received[honest]
        best = received[np.array([np.argmax(shares(received, level))])]
        return Trial(variant, does, best, wolf_knowledge(system))

    def family(name: str) -> SubspaceBatch:
        return SubspaceBatch.of([axis.subspace for axis in wolves if axis.family == name])

    def climbed(level: Level) -> SubspaceBatch:
        starts = SubspaceBatch.of([axis.subspace for axis in wolves])
        starts = starts[honest_lift(starts, calibration)]
        leading = starts[np.argsort(-shares(starts, level))[:STARTS]]
        return ascend_subspaces(leading, own.ground(level))

    trials = [
        Trial(
            "random central subspaces",
            "sends random subspaces through the coordinate origin",
            central,
        ),
        wolf(
            f"wolf, {CENTRAL}",
            "sends principal axes of faces through the coordinate origin",
            lambda _: family(CENTRAL),
        ),
        wolf(
            f"wolf, {ALONG_MEAN}",
            "sends principal axes of faces with a foot point along the mean face",
            lambda _: family(ALONG_MEAN),
        ),
        wolf(
            "wolf, optimised",
            "climbs on templates that they lift until as many as possible accept one lifted probe",
            climbed,
        ),
        Trial(
            f"replay as lifted probe, {_WITH}",
            "has stolen the template and the tenant's key, may send lifted probes, and sends "
            "a part of the template",
            inside,
            leaked=Leaked.HOLDER_KEYS,
        ),
        Trial(
            f"replay as lifted probe, {_WITHOUT}",
            "has stolen the template in its rotation, may send lifted probes, and sends a part of "
            "it, which the service rotates once more",
            as_stored,
            leaked=Leaked.MASTER_KEY,
        ),
    ]
    return [outcome for trial in trials for outcome in _outcomes(system, calibration, trial)]


def _plain_wolves(faces: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean face and principal axes of faces (N, n), alone and with the mean face."""
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:STARTS]
    length = float(np.linalg.norm(mean))
    rows = np.concatenate([mean[None], axes, -axes, mean + length * axes, mean - length * axes])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)


def accepted_shares(
    probes: Probes, own: OwnTemplates, nobody: Nobody, calibration: Calibration, level: Level
) -> NDArray[np.float64]:
    """Share of the attacker's held-out templates that accept each probe.

    Lifted probes are held against the attacker's own cohort, for the service's is secret. Ties,
    such as where none accepts, are broken by the mean similarity.
    """
    scores = score(probes, own.held_out, nobody, calibration, cohort=own.cohort)
    # Similarities lie in [-1, 1]: their mean, scaled, never outweighs one acceptance.
    tie = scores.similarities.mean(axis=1) / (4 * len(own.held_out))
    return np.asarray(scores.at(level).mean(axis=1) + tie, dtype=np.float64)


def _outcomes(system: System, calibration: Calibration, trial: Trial) -> list[AttackOutcome]:
    """Judge the service's decision."""
    default = system.contract.default_level
    passed = _passed(trial.probes, calibration)
    judged: dict[str, NDArray[np.bool_]] = {}
    by_level: dict[str, Json] = {}
    scores = _scored(system, trial.probes, calibration)
    for level in calibration.levels:
        accepted = scores.at(level)
        judged[level.name] = accepted & passed
        by_level[level.name] = {
            "without_input_checks": _counted(accepted),
            "with_input_checks": _counted(judged[level.name]),
        }
    return [
        AttackOutcome(
            attack="presentation",
            breaks=Property.IMPERSONATION,
            leaked=trial.leaked,
            knowledge=trial.knowledge,
            scheme=system.scheme,
            level=default,
            chance=fmr_of(calibration.level(default)),
            variant=trial.variant,
            assumption=(
                f"The attacker {trial.does}; success is acceptance by a victim's template, after "
                "the input checks."
            ),
            measured=_rate(judged[default]),
            details={
                "mode": calibration.mode,
                "probes": len(trial.probes),
                "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
                "by_level": by_level,
            },
        )
    ]


def _passed(probes: Probes, calibration: Calibration) -> NDArray[np.bool_]:
    if isinstance(probes, SubspaceBatch):
        return honest_lift(probes, calibration)
    return honest_embedding(probes)


def _scored(system: System, probes: Probes, calibration: Calibration) -> Scores:
    """One trial a victim: probe i meets template i, or the only probe meets all; (V,) each."""
    if len(probes) > 1:
        return score(probes, system.templates, system.nobody, calibration, paired=True)
    every = score(probes, system.templates, system.nobody, calibration)
    return Scores(every.similarities[0], every.scores[0])


def _rate(accepted: NDArray[np.bool_]) -> Rate:
    return rate(int(np.count_nonzero(accepted)), len(accepted))


def _counted(accepted: NDArray[np.bool_]) -> dict[str, Json]:
    return _rate(accepted).to_json()
