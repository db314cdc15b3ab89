"""One calibration of a contract: one mode, one metric, one probe dimension."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from templates.contract.canonical import Json
from templates.contract.document import Calibration, Level
from templates.contract.nobody import Nobody
from templates.distances import DEFAULT_STEPS, Metric
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.comparisons import (
    Lifter,
    Progress,
    honest_norms,
    lifted_trials,
    pair_similarities,
    point_trials,
)
from verify.tenfold import Pair, TenFold, pair_arrays, ten_fold
from verify.thresholds import (
    TARGETS,
    Genuine,
    Impostors,
    JointTails,
    level_name,
    make_level,
    resolved_targets,
)
from verify.trials import TrialPlan

Protocol: TypeAlias = Literal["fmr", "ten-fold"]

ACCURACY_LEVEL = "accuracy"


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """How to calibrate.

    Parameters
    ----------
    protocol
        ``fmr`` sets levels by target FMR; ``ten-fold`` adds the level ``accuracy``.
    metric, steps
        The distance that will decide.
    probe_dims
        Dimensions of the probes: 0 for raw ones, others for lifted ones.
    targets
        FMR targets, powers of ten; those that the data cannot resolve are left out and reported.
    photos_per_enrollment
        Most photos averaged into one template.
    suspicious_above
        Raw cosine from which two people are reported as suspiciously alike. On LFW with ArcFace
        descriptors the cosine of different people passes 0.37 once in 100,000 pairs, and half of
        the same person's pairs reach 0.6.
    most_cells
        Most p-to-s comparisons, which bounds memory: 20 bytes a comparison.
    lifted_probes, lifted_impostor_pairs
        Size of the random subset of s-to-s comparisons, for each probe dimension.
    seed
        Seed of every random choice but the cohort's.
    """

    protocol: Protocol = "fmr"
    metric: Metric = Metric.SPHERICAL
    steps: int = DEFAULT_STEPS
    probe_dims: tuple[int, ...] = (0,)
    targets: tuple[float, ...] = TARGETS
    photos_per_enrollment: int = 3
    suspicious_above: float = 0.5
    most_cells: int = 40_000_000
    lifted_probes: int = 2_000
    lifted_impostor_pairs: int = 300_000
    seed: int = 0

    def __post_init__(self) -> None:
        for target in self.targets:
            level_name(target)  # refuses what has no name, before anything is computed


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationRun:
    """Everything that the calibrations of one run share.

    ``halves``: the strangers are of two sources (:func:`verify.strangers.strangers_like`).
    """

    descriptors: NDArray[np.float32]
    plan: TrialPlan
    templates: SubspaceBatch
    cohort: SubspaceBatch
    nobody: Nobody
    halves: bool
    service: Lifter
    client: Lifter
    pairs: tuple[Pair, ...]
    options: CalibrationOptions
    facts: Mapping[str, Json]
    progress: Progress


def calibrate_mode(
    run: CalibrationRun, probe_m: int, rng: np.random.Generator
) -> tuple[Calibration, list[str], TenFold | None]:
    """Calibrate one probe dimension: 0 is p-to-s."""
    options = run.options
    norms: tuple[float, float] | None = None
    if probe_m == 0:
        impostors, genuine = point_trials(
            run.descriptors,
            run.plan,
            run.templates,
            run.cohort,
            metric=options.metric,
            steps=options.steps,
            most_cells=options.most_cells,
            rng=rng,
            progress=run.progress,
        )
    else:
        with Keystream.seeded("calibration probes", options.seed, probe_m) as stream:
            trials = lifted_trials(
                run.descriptors,
                run.plan,
                run.templates,
                run.cohort,
                run.client,
                probe_m=probe_m,
                metric=options.metric,
                steps=options.steps,
                most_probes=options.lifted_probes,
                impostor_pairs=options.lifted_impostor_pairs,
                rng=rng,
                stream=stream,
                progress=run.progress,
            )
        impostors, genuine = trials.impostors, trials.genuine
        norms = honest_norms(trials.foot_norms)
    everything = len(run.plan.person_of) * (len(run.plan.people) - 1)
    tails = JointTails(impostors)
    kept, unresolved = resolved_targets(impostors, options.targets)
    levels = [
        make_level(
            level_name(target),
            target,
            tails.for_target(target),
            impostors,
            genuine,
            seed=options.seed,
        )
        for target in kept
    ]
    folds = None
    if options.protocol == "ten-fold":
        folds = _ten_fold(run, probe_m)
        levels.append(_accuracy_level(folds, tails, impostors, genuine, seed=options.seed))
    if not levels:
        raise ContractError("the data resolve no level: " + "; ".join(unresolved))
    facts: dict[str, Json] = {
        **run.facts,
        "genuine_trials": len(genuine.people),
        "impostor_trials": impostors.trials,
        "impostor_people_pairs": impostors.person_pairs,
        "impostor_sample": "all cross-identity pairs"
        if impostors.trials == everything
        else f"random subset of {everything} cross-identity pairs",
    }
    if folds is not None:
        facts["ten_fold_accuracy"] = folds.accuracy_mean
        facts["ten_fold_std"] = folds.accuracy_std
    calibration = Calibration(
        mode="s2s" if probe_m else "p2s",
        metric=options.metric,
        probe_m=probe_m,
        steps=options.steps,
        levels=tuple(levels),
        foot_point_norm=norms,
        calibrated_on=facts,
    )
    where = f"probe m = {probe_m}: " if probe_m else "raw probes: "
    return calibration, [where + sentence for sentence in unresolved], folds


def _ten_fold(run: CalibrationRun, probe_m: int) -> TenFold:
    """Paper's protocol: one photo enrolled, one photo as the probe, raw or lifted."""
    firsts = np.array([pair.first for pair in run.pairs], dtype=np.int64)
    seconds = np.array([pair.second for pair in run.pairs], dtype=np.int64)
    enrolled, numbers = np.unique(firsts, return_inverse=True)
    probing, positions = np.unique(seconds, return_inverse=True)
    options = run.options
    with Keystream.seeded("ten folds", options.seed, probe_m) as stream:
        templates = run.service.lift(run.descriptors[enrolled], m=run.templates.m, stream=stream)
        raw = run.descriptors[probing]
        probes = run.client.lift(raw, m=probe_m, stream=stream) if probe_m else raw
    scores = pair_similarities(
        probes,
        templates,
        positions.astype(np.int64),
        numbers.astype(np.int64),
        metric=options.metric,
        steps=options.steps,
    )
    return ten_fold(scores, *pair_arrays(run.pairs))


def _accuracy_level(
    folds: TenFold, tails: JointTails, impostors: Impostors, genuine: Genuine, *, seed: int
) -> Level:
    """Ten-fold similarity threshold, with the cohort test at the same marginal quantile."""
    similarity = folds.threshold_mean
    _, cohort = tails.at_rank(min(tails.rank_of(similarity), impostors.trials))
    return make_level(ACCURACY_LEVEL, None, (similarity, cohort), impostors, genuine, seed=seed)
