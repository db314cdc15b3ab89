"""One calibration of a contract: one mode, one metric, one kind of probe."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from templates.contract.canonical import Json
from templates.contract.document import Calibration
from templates.contract.levels import photos_in_words
from templates.distances import Metric
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from verify.cohort import Probes
from verify.comparisons import Comparison, Lifter, Progress, honest_norms, pair_similarities
from verify.consistency import Consistency, SuspiciousPair
from verify.group_rates import PeopleGroups, group_rates, worst_group_threshold
from verify.metrics import threshold_at_fmr
from verify.tenfold import Pairs, TenFold, ten_fold
from verify.thresholds import (
    EXPECTED_ERRORS,
    TARGETS,
    Genuine,
    Impostors,
    level_name,
    make_level,
    resolved_targets,
)
from verify.trials import GROUP, ProbeSets, TrialPlan, impostor_groups, probe_sets

Protocol: TypeAlias = Literal["fmr", "ten-fold"]

ACCURACY_LEVEL = "accuracy"
GROUPED = 10 / 3
"""How many more comparisons are made where people are labelled: a group has a part of them."""

STEPS = 20
"""Steps of the iteration that decides a lifted probe: 50 take longer and reject no fewer
(docs/method.md §3.5)."""


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """How to calibrate."""

    protocol: Protocol = "fmr"  # ten-fold adds the level `accuracy`
    metric: Metric = Metric.SPHERICAL
    steps: int = STEPS
    probe_dims: tuple[int, ...] = (0,)  # 0 for raw probes, others for lifted ones
    # Photos that raw probes are the means of; beyond 1 where `least_people` have as many left over.
    probe_photos: tuple[int, ...] = (1, 2, 3, 5)
    least_people: int = 50
    targets: tuple[float, ...] = TARGETS  # powers of ten; those unresolved are reported
    photos_per_enrollment: int = 3  # at most
    most_templates: int = 2_400  # people whose templates are compared with; all where labelled
    # P-to-s comparisons at most: FMR 1e-6 is resolved by 10 million. An eighth of it for probes of
    # several photos, and `GROUPED` times as many where people are labelled.
    most_cells: int = 12_000_000
    lifted_probes: int = 2_000  # size of the random subset of s-to-s, for each dimension
    lifted_impostor_pairs: int = 300_000
    worst_group: bool = False  # no group with trials enough exceeds a target either; needs labels
    seed: int = 0  # of every random choice but the strangers' and the cohort's

    def __post_init__(self) -> None:
        for target in self.targets:
            level_name(target)  # refuses what has no name, before anything is computed


@dataclass(frozen=True)
class CalibrationReport:
    """What an operator should read beside the contract; every calibration adds to its lists."""

    consistency: Consistency
    suspicious: list[SuspiciousPair]
    """People who may be one person under two names (docs/thresholds.md)."""
    unresolved: list[str] = field(default_factory=list)
    """Sentences about the FMR targets that the data cannot resolve."""
    left_out: list[str] = field(default_factory=list)
    """Sentences about the groups whose trials are too few for ``worst_group`` to heed them."""


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationRun:
    """Everything that the calibrations of one run share.

    ``embeddings`` are unit rows, (N, n); templates are in the coordinates of the axes.
    """

    embeddings: NDArray[np.float32]
    plan: TrialPlan
    comparison: Comparison
    service: Lifter
    client: Lifter
    pairs: Pairs | None  # of the ten-fold protocol
    groups: tuple[PeopleGroups, ...]
    report: CalibrationReport
    options: CalibrationOptions
    facts: Mapping[str, Json]
    progress: Progress


def point_sets(run: CalibrationRun, rng: np.random.Generator) -> list[ProbeSets]:
    """Choose the raw probes of every number of photos that the people allow."""
    templates, options = len(run.plan.compared), run.options
    times = GROUPED if run.groups else 1
    chosen = []
    for photos in sorted(options.probe_photos):
        cells = options.most_cells // (1 if photos == 1 else 8)
        most = max(1, int(times * cells) // templates)
        sets = probe_sets(run.plan, photos, most=most, rng=rng)
        genuine = run.plan.person_of[sets.photos[: sets.genuine, 0]]
        if photos == 1 or len(np.unique(genuine)) >= options.least_people:
            chosen.append(sets)
    return chosen


def calibrate_points(run: CalibrationRun, sets: ProbeSets) -> Calibration:
    """Compare raw probes of one number of photos with everybody's template, and set the levels."""
    photos = sets.photos.shape[1]
    what = f"comparing probes of {photos_in_words(photos)} with templates"
    project = run.comparison.nobody.generator.project
    points = project(sets.means(run.embeddings, sets.impostor))
    impostors = run.comparison.impostors(
        points,
        run.comparison.expected(points),
        run.plan.person_of[sets.photos[sets.impostor, 0]],
        run.plan.compared[None],
        size=len(sets.impostor),
        progress=lambda share: run.progress(what, share),
    )
    own = run.plan.person_of[sets.photos[: sets.genuine, 0]]
    consistency = run.report.consistency.probe_threshold
    refused = sets.disagreeing(run.embeddings, consistency=consistency)
    points = np.empty((0, run.comparison.templates.n), dtype=np.float32)
    if len(own):
        points = project(sets.means(run.embeddings, slice(sets.genuine)))
    genuine = run.comparison.genuine(points, run.comparison.expected(points), own, refused)
    return _calibration(run, impostors, genuine, probe_photos=photos)


def calibrate_lifted(run: CalibrationRun, probe_m: int, rng: np.random.Generator) -> Calibration:
    """Compare lifted probes of one dimension, and set the levels.

    At most ``lifted_probes`` photos probe, genuine ones first. Groups of them meet groups of other
    people's templates, about ``lifted_impostor_pairs`` pairs in all.
    """
    plan, most = run.plan, run.options.lifted_probes
    photos = plan.genuine
    if len(photos) > most:
        photos = rng.choice(photos, most, replace=False)
    extra = np.setdiff1d(np.arange(len(plan.person_of)), plan.genuine)
    room = min(len(extra), most - len(photos))
    chosen = np.concatenate([photos, rng.choice(extra, room, replace=False)])
    stream = Keystream.seeded("calibration probes", run.options.seed, probe_m)
    probes = run.client.lift(run.embeddings[chosen], m=probe_m, stream=stream)
    expected = run.comparison.expected(probes)
    impostors = run.comparison.impostors(
        probes,
        expected,
        plan.person_of[chosen],
        impostor_groups(plan, len(chosen), pairs=run.options.lifted_impostor_pairs, rng=rng),
        size=GROUP,
        progress=lambda share: run.progress(f"comparing lifted probes, m = {probe_m}", share),
    )
    refused = np.zeros(len(photos), dtype=np.bool_)
    genuine = run.comparison.genuine(probes, expected, plan.person_of[photos], refused)
    return _calibration(
        run, impostors, genuine, probe_m=probe_m, norms=honest_norms(probes.foot_norms)
    )


def _calibration(
    run: CalibrationRun,
    impostors: Impostors,
    genuine: Genuine,
    *,
    probe_m: int = 0,
    probe_photos: int = 1,
    norms: tuple[float, float] | None = None,
) -> Calibration:
    """Set the levels that the trials resolve."""
    options = run.options
    kept, unresolved = resolved_targets(impostors, options.targets)
    thresholds, left_out = _thresholds(run, impostors, kept)
    levels = [
        make_level(level_name(target), target, threshold, impostors, genuine, seed=options.seed)
        for target, threshold in zip(kept, thresholds, strict=True)
    ]
    folds = None
    if run.pairs is not None and probe_photos == 1:
        folds = _ten_fold(run, run.pairs, probe_m)
        levels.append(
            make_level(
                ACCURACY_LEVEL, None, folds.threshold_mean, impostors, genuine, seed=options.seed
            )
        )
    if not levels:
        raise ContractError("the data resolve no level: " + "; ".join(unresolved))
    if run.groups and not probe_m:
        levels = [
            replace(level, groups=group_rates(level, run.groups, impostors, genuine))
            for level in levels
        ]
    facts: dict[str, Json] = {
        **run.facts,
        "genuine_trials": len(genuine.people),
        "impostor_trials": impostors.trials,
        "impostor_people_pairs": impostors.person_pairs,
    }
    if folds is not None:
        facts["pairs"] = "random"
        facts["ten_fold_accuracy"] = folds.accuracy_mean
        facts["ten_fold_std"] = folds.accuracy_std
    where = (
        f"probe m = {probe_m}: " if probe_m else f"raw probes of {photos_in_words(probe_photos)}: "
    )
    run.report.unresolved.extend(where + sentence for sentence in unresolved)
    run.report.left_out.extend(where + sentence for sentence in left_out)
    return Calibration(
        mode="s2s" if probe_m else "p2s",
        metric=options.metric,
        probe_m=probe_m,
        probe_photos=probe_photos,
        steps=options.steps,
        levels=tuple(levels),
        foot_point_norm=norms,
        calibrated_on=facts,
    )


def _thresholds(
    run: CalibrationRun, impostors: Impostors, targets: Sequence[float]
) -> tuple[list[float], list[str]]:
    """Set a threshold for each target, the largest first; name the groups that are not heeded."""
    thresholds: list[float] = []
    unheeded = []
    for target in targets:
        threshold = threshold_at_fmr(impostors.scores, target, trials=impostors.trials)
        if run.options.worst_group:
            threshold, left_out = worst_group_threshold(threshold, target, run.groups, impostors)
            # A group that only laxer targets resolve must not make those the stricter levels.
            threshold = max([threshold, *thresholds[-1:]])
            if left_out:
                unheeded.append(
                    f"FMR {target:g} needs {EXPECTED_ERRORS / target:.0f} impostor trials within a "
                    f"group to set a threshold by, and these have fewer: {', '.join(left_out)}"
                )
        thresholds.append(threshold)
    return thresholds, unheeded


def _ten_fold(run: CalibrationRun, pairs: Pairs, probe_m: int) -> TenFold:
    """Paper's protocol: one photo enrolled, one photo as the probe, raw or lifted."""
    enrolled, numbers = np.unique(pairs.first, return_inverse=True)
    probing, positions = np.unique(pairs.second, return_inverse=True)
    options = run.options
    stream = Keystream.seeded("ten folds", options.seed, probe_m)
    m = run.comparison.templates.m
    templates = run.service.lift(run.embeddings[enrolled], m=m, stream=stream)
    raw = run.embeddings[probing]
    probes: Probes = run.comparison.nobody.generator.project(raw)
    if probe_m:
        probes = run.client.lift(raw, m=probe_m, stream=stream)
    close = pair_similarities(
        probes,
        templates,
        positions.astype(np.int64),
        numbers.astype(np.int64),
        metric=options.metric,
        steps=options.steps,
    )
    means, spreads = (part[positions] for part in run.comparison.expected(probes))
    return ten_fold((close - means) / spreads, pairs.same, pairs.folds)
