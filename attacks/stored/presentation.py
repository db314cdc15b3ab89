"""Presentation: probes that are no photo of the subject: zero, central, wolf, replay.

See docs/method.md §4.7.

Wolves are chosen and improved on templates that the attacker lifts; the victims' templates and the
service's cohort are met once, at the end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import Scores, score
from attacks.linkage import secret_rotation
from attacks.outcomes import POOLED, Knowledge, Outcome, Property
from attacks.recovery import fmr_of
from attacks.scene import Scene
from attacks.stored.nearest_neighbour import nearest_points
from attacks.stored.wolf_ascent import Ground, ascend_points, ascend_subspaces
from attacks.stored.wolves import ALONG_MEAN, CENTRAL, axis_wolves, canonical
from templates.contract.canonical import Json
from templates.contract.document import Calibration, Contract, Level, Rate
from templates.decoys import DecoyGenerator
from templates.errors import InvalidEmbedding
from templates.keys.randomness import Keystream
from templates.keys.rotation import rotate
from templates.space.embedding import unit_rows
from templates.space.subspace import SubspaceBatch
from verify.cohort import COHORT_SIZE, Probes, make_cohort, people_like
from verify.comparisons import through_wire
from verify.metrics import rate

TARGETS = 150
"""Templates that the attacker lifts to climb on; as many again to choose among the ends."""
COHORT_CLIMBED = 150
"""Of the attacker's cohort, those that the score is normalised by while it climbs; all of them
decide which end is best."""
STARTS = 6


@dataclass(frozen=True, eq=False, repr=False)
class Bench:
    """What the attacker lifts on their own.

    Parameters
    ----------
    targets, held_out
        Templates of the attacker's faces: to climb on, and to choose with.
    cohort
        A cohort made as the service makes one.
    """

    targets: SubspaceBatch
    held_out: SubspaceBatch
    cohort: SubspaceBatch

    def ground(self, rule: Level) -> Ground:
        """Return what the attacker climbs on, by the rule of a level."""
        return Ground.of(self.targets, self.cohort[:COHORT_CLIMBED], rule)


def attacker_bench(scene: Scene) -> Bench:
    """Lift the attacker's faces, and a cohort with the generator that clients have.

    The cohort of a pool's service is made with a generator; the attacker fits one to their own
    faces. Templates are lifted with the scheme's decoys: see ``wolf_knowledge``.
    """
    faces = np.random.default_rng(scene.seed).permutation(scene.attacker)[: 2 * TARGETS]
    source = scene.lifter.source
    known = source if isinstance(source, DecoyGenerator) else DecoyGenerator.fit(scene.attacker)
    half = len(faces) // 2
    with Keystream.seeded("audit", scene.seed, str(scene.scheme), "attacker's cohort") as stream:
        cohort = make_cohort(
            known,
            strategy=scene.lifter.strategy,
            m=scene.scheme.dim,
            stream=stream,
            size=COHORT_SIZE,
            hidden=people_like(known, scene.attacker),
        )
    return Bench(
        targets=scene.lift(faces[:half], "attacker's targets"),
        held_out=scene.lift(faces[half:], "attacker's held-out targets"),
        cohort=cohort,
    )


def wolf_knowledge(scene: Scene) -> Knowledge:
    """Return what lifting as the service does takes: a generator is public, a pool is secret."""
    return Knowledge.DECOYS if scene.scheme.decoys == POOLED else Knowledge.ALGORITHM


def presentation_attack(scene: Scene) -> list[Outcome]:
    """All probes, raw and, where the contract takes them, lifted.

    Of each the decision with input checks and cohort test is judged; the threshold alone, without
    input checks, stands beside it.
    """
    bench = attacker_bench(scene)
    outcomes = _raw(scene, bench)
    if scene.lifted is not None:
        outcomes += _lifted(scene, scene.lifted, bench)
    return outcomes


def honest_embedding(probes: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which raw probes (P, n) pass the service's input check."""
    passed = np.ones(len(probes), dtype=np.bool_)
    for row, probe in enumerate(probes):
        try:
            unit_rows(probe, n=probes.shape[1], most=1)
        except InvalidEmbedding:
            passed[row] = False
    return passed


def honest_lift(probes: SubspaceBatch, calibration: Calibration) -> NDArray[np.bool_]:
    """Return which lifted probes have a foot point that the calibration takes for honest."""
    low, high = calibration.foot_point_norm or (1.0, 0.0)
    return np.asarray((low <= probes.foot_norms) & (probes.foot_norms <= high))


def points_inside(templates: SubspaceBatch, *, seed: int) -> NDArray[np.float32]:
    """Return a random unit vector of every template, (T, n): at distance 0 from it."""
    directions = np.random.default_rng(seed).standard_normal((len(templates), templates.n))
    return nearest_points(directions, templates).astype(np.float32)


def flats_inside(templates: SubspaceBatch, m: int, *, foot_norm: float) -> SubspaceBatch:
    """Return an affine subspace of dimension m inside every template, at distance 0 from it.

    Where the template has more dimensions, the foot point is moved along one of them to have the
    norm of an honest lift's.
    """
    if templates.m <= m:
        return templates
    norms = templates.foot_norms[:, None]
    height = np.sqrt(np.maximum(foot_norm**2 - norms**2, 0))
    return SubspaceBatch(
        (templates.feet + height * templates.bases[:, m]).astype(np.float32), templates.bases[:, :m]
    )


def honest_flats(templates: SubspaceBatch, calibration: Calibration) -> SubspaceBatch:
    """Return ``flats_inside`` of a foot point norm that the calibration takes for honest."""
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    # Near the lower end: a foot point can be made longer inside a template, and not shorter.
    return flats_inside(templates, calibration.probe_m, foot_norm=low + 0.1 * (high - low))


@dataclass(frozen=True, eq=False, repr=False)
class Trial:
    """One kind of probe.

    Parameters
    ----------
    variant
        Its name.
    does
        What the attacker does with it, to complete "The attacker …".
    probes
        One for each victim, or one for all.
    alone
        Those that are tried against the threshold alone.
    knowledge
        What it takes.
    """

    variant: str
    does: str
    probes: Probes
    alone: Probes
    knowledge: Knowledge = Knowledge.ALGORITHM


def _raw(scene: Scene, bench: Bench) -> list[Outcome]:
    calibration, n = scene.points, scene.templates.n
    zero = np.zeros((1, n), dtype=np.float32)
    plain = _plain_wolves(scene.attacker)
    starts = np.concatenate([plain, scene.attacker[:STARTS]])
    inside = points_inside(scene.templates, seed=scene.seed)
    turned = rotate(inside, secret_rotation(scene, "replay")).astype(np.float32)

    def wolf(variant: str, does: str, made: Callable[[Level], NDArray[np.float32]]) -> Trial:
        found = []
        for rule in _rules(scene, calibration):
            candidates = made(rule)
            shares = accepted_shares(candidates, bench, scene.contract, calibration, rule)
            found.append(candidates[[int(np.argmax(shares))]])
        return Trial(variant, does, found[0], found[1], wolf_knowledge(scene))

    def climbed(rule: Level) -> NDArray[np.float32]:
        return ascend_points(starts, bench.ground(rule))

    trials = [
        Trial("zero embedding", "sends the zero vector", zero, zero),
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
            "replay as embedding, with the key",
            "has stolen the template and the tenant's rotation, may send embeddings, and sends a "
            "unit vector of the template",
            inside,
            inside,
            Knowledge.KEY,
        ),
        Trial(
            "replay as embedding, without the key",
            "has stolen the template in its rotation, may send embeddings, and sends a unit vector "
            "of it, which the service rotates once more",
            turned,
            turned,
        ),
    ]
    return [each for trial in trials for each in _outcomes(scene, calibration, trial)]


def _lifted(scene: Scene, calibration: Calibration, bench: Bench) -> list[Outcome]:
    m, n = calibration.probe_m, scene.templates.n
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    rng = np.random.default_rng(scene.seed)
    wolves = axis_wolves(scene.attacker, m, foot_norm=(low + high) / 2, seed=scene.seed)
    central = SubspaceBatch.of(
        [canonical(np.zeros(n), rng.standard_normal((m, n))) for _ in range(len(scene.templates))]
    )
    inside = honest_flats(scene.templates, calibration)
    turned = inside.rotated(secret_rotation(scene, "replay"))

    def shares(probes: SubspaceBatch, rule: Level) -> NDArray[np.float64]:
        return accepted_shares(probes, bench, scene.contract, calibration, rule)

    def wolf(variant: str, does: str, made: Callable[[Level], SubspaceBatch]) -> Trial:
        found = []
        for rule in _rules(scene, calibration):
            received = through_wire(made(rule), contract_id=scene.contract.contract_id)
            honest = honest_lift(received, calibration)
            # Without the cohort test there are no input checks either: see `_outcomes`.
            if np.isfinite(rule.cohort_threshold) and honest.any():
                received = received[honest]
            found.append(received[np.array([np.argmax(shares(received, rule))])])
        return Trial(variant, does, found[0], found[1], wolf_knowledge(scene))

    def family(name: str) -> SubspaceBatch:
        return SubspaceBatch.of([each.subspace for each in wolves if each.family == name])

    def climbed(rule: Level) -> SubspaceBatch:
        starts = SubspaceBatch.of([each.subspace for each in wolves])
        starts = starts[honest_lift(starts, calibration)]
        leading = starts[np.argsort(-shares(starts, rule))[:STARTS]]
        return ascend_subspaces(leading, bench.ground(rule))

    trials = [
        Trial(
            "random central subspaces",
            "sends random subspaces through the coordinate origin",
            central,
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
            "replay as lifted probe, with the key",
            "has stolen the template and the tenant's rotation, may send lifted probes, and sends "
            "a part of the template",
            inside,
            inside,
            Knowledge.KEY,
        ),
        Trial(
            "replay as lifted probe, without the key",
            "has stolen the template in its rotation, may send lifted probes, and sends a part of "
            "it, which the service rotates once more",
            turned,
            turned,
        ),
    ]
    return [each for trial in trials for each in _outcomes(scene, calibration, trial)]


def _plain_wolves(faces: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean face and principal axes of faces (N, n), alone and with the mean face."""
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:STARTS]
    length = float(np.linalg.norm(mean))
    rows = np.concatenate([mean[None], axes, -axes, mean + length * axes, mean - length * axes])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)


def _rules(scene: Scene, calibration: Calibration) -> tuple[Level, Level]:
    """Return the service's default level, and the same without the cohort test."""
    level = calibration.level(scene.contract.default_level)
    return level, replace(level, cohort_threshold=-np.inf)


def accepted_shares(
    probes: Probes, bench: Bench, contract: Contract, calibration: Calibration, level: Level
) -> NDArray[np.float64]:
    """Share of the attacker's held-out templates that accept each probe, by their own cohort.

    Ties, such as where none accepts, are broken by the mean similarity.
    """
    scores = score(probes, bench.held_out, contract, calibration, cohort=bench.cohort)
    # Similarities lie in [-1, 1]: their mean, scaled, never outweighs one acceptance.
    tie = scores.similarities.mean(axis=1) / (4 * len(bench.held_out))
    return np.asarray(scores.at(level).accepted.mean(axis=1) + tie, dtype=np.float64)


def _outcomes(scene: Scene, calibration: Calibration, trial: Trial) -> list[Outcome]:
    """Judge the service's decision, and report that of the threshold alone."""
    default = scene.contract.default_level
    passed = _passed(trial.probes, calibration)
    judged, alone = {}, {}
    by_level: dict[str, Json] = {}
    alone_by_level: dict[str, Json] = {}
    scores = _scored(scene, trial.probes, calibration)
    bare = scores if trial.alone is trial.probes else _scored(scene, trial.alone, calibration)
    for level in calibration.levels:
        accepted = scores.at(level).accepted
        judged[level.name] = accepted & passed
        alone[level.name] = bare.at(level).near
        by_level[level.name] = {
            "without_input_checks": _counted(accepted),
            "with_input_checks": _counted(judged[level.name]),
        }
        alone_by_level[level.name] = _counted(alone[level.name])
    judged_outcome = Outcome(
        attack="presentation",
        breaks=Property.IMPERSONATION,
        knowledge=trial.knowledge,
        scheme=scene.scheme,
        level=default,
        chance=fmr_of(calibration.level(default)),
        variant=trial.variant,
        assumption=(
            f"The attacker {trial.does}; success is acceptance by a victim's template, after "
            "the input checks, by threshold and cohort test."
        ),
        measured=_rate(judged[default]),
        details={
            "mode": calibration.mode,
            "probes": len(trial.probes),
            "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
            "by_level": by_level,
        },
    )
    return [
        judged_outcome,
        replace(
            judged_outcome,
            variant=f"{trial.variant}; threshold alone",
            assumption=(
                f"The attacker {trial.does}; success is acceptance by a victim's template by the "
                "similarity threshold alone, without input checks and cohort test, which no "
                "service leaves out (not judged)."
            ),
            measured=_rate(alone[default]),
            judged=False,
            details={"mode": calibration.mode, "by_level": alone_by_level},
        ),
    ]


def _passed(probes: Probes, calibration: Calibration) -> NDArray[np.bool_]:
    if isinstance(probes, SubspaceBatch):
        return honest_lift(probes, calibration)
    return honest_embedding(probes)


def _scored(scene: Scene, probes: Probes, calibration: Calibration) -> Scores:
    """One trial a victim: probe i meets template i, or the only probe meets all; (V,) each."""
    if len(probes) > 1:
        return score(probes, scene.templates, scene.contract, calibration, paired=True)
    every = score(probes, scene.templates, scene.contract, calibration)
    return Scores(every.similarities[0], every.cohort_scores[0])


def _rate(accepted: NDArray[np.bool_]) -> Rate:
    return rate(int(np.count_nonzero(accepted)), len(accepted))


def _counted(accepted: NDArray[np.bool_]) -> dict[str, Json]:
    return _rate(accepted).to_json()
