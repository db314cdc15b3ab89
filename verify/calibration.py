"""From labelled embeddings to a contract: thresholds for stated false match rates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from templates.contract.canonical import Json
from templates.contract.document import Binding, Calibration, Contract
from templates.contract.nobody import Nobody
from templates.decoys import DecoySource, client_source
from templates.errors import ContractError
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.embedding import unit_descriptors
from templates.space.lifting import plain_strategy
from verify.calibration_mode import (
    CalibrationOptions,
    CalibrationReport,
    CalibrationRun,
    calibrate_lifted,
    calibrate_points,
    point_sets,
)
from verify.comparisons import Comparison, Lifter, Progress, honest_norms
from verify.consistency import photo_consistency, suspicious_pairs
from verify.group_rates import PeopleGroups, PhotoLabels, people_groups
from verify.tenfold import random_pairs
from verify.trials import ProbeSets, enrolled_means, plan_trials

SUSPICIOUS_ABOVE = 0.5
"""Raw cosine from which two people are reported as suspiciously alike. On LFW with ArcFace the
cosine of different people passes 0.37 once in 100,000 pairs, and half of the same person's pairs
reach 0.6."""
_ENROLLED = 0.3
"""Share of the time that has passed, on LFW, once people are enrolled."""
DEVIATIONS = 6.0
"""Of similarities to strangers, above the mean of honest templates: the largest that passes."""
DEFAULT_LEVELS = ("fmr-1e-4", "fmr-1e-3", "fmr-1e-2")
"""The first that all calibrations resolve is the default; 1e-4 is NIST SP 800-63B-4's."""


@dataclass(frozen=True)
class Calibrated:
    """A contract, and the report of its calibration."""

    contract: Contract
    report: CalibrationReport


def part_of(progress: Progress, first: float, last: float) -> Progress:
    """Report the progress of what begins and ends at two shares as progress of the whole."""
    return lambda what, share: progress(what, first + (last - first) * share)


def calibrate(
    embeddings: NDArray[np.floating],  # (N, n) unit rows
    identities: Sequence[str],
    *,
    binding: Binding,
    source: DecoySource,
    options: CalibrationOptions | None = None,
    labels: PhotoLabels | None = None,  # of every embedding, for rates by group of people
    cohort_seed: bytes | None = None,  # a contract's, to keep its cohort
    recorded: Mapping[str, Json] | None = None,  # facts for the contract file
    dataset: str = "labelled folder",
    excluded_photos: int = 0,  # of the data set, for the contract file
    progress: Progress = lambda _what, _share: None,  # of the whole, from 0 to 1
) -> Calibrated:
    """Calibrate a contract on the private templates of labelled people.

    Every person is enrolled once, on up to ``photos_per_enrollment`` averaged photos, lifted and
    passed through the wire format as in the service; of many people, ``most_templates``. Genuine
    probes are the photos that were left out. Impostor trials are all cross-identity pairs or a
    random subset of them, as the contract states. A level's threshold is the smallest score at
    which the FMR is at most the target (docs/method.md "Scores").

    Raises
    ------
    ContractError
        Where the data are too few for a single level, or ``worst_group`` is asked for and nobody
        is labelled.
    """
    options = options or CalibrationOptions()
    data = np.ascontiguousarray(unit_descriptors(embeddings), dtype=np.float32)
    if len(set(identities)) < 2:
        raise ContractError("a calibration needs at least two people")
    rng = np.random.default_rng(options.seed)
    plan = plan_trials(
        identities,
        photos_per_enrollment=options.photos_per_enrollment,
        rng=rng,
        most_templates=None if labels is not None else options.most_templates,
    )
    groups: tuple[PeopleGroups, ...] = ()
    if labels is not None:
        groups = people_groups(labels, plan.person_of, people=len(plan.people))
    if options.worst_group and not groups:
        raise ContractError("thresholds by the worst group need labels of the people")
    pairs = None
    if options.protocol == "ten-fold":
        pairs = random_pairs(plan.person_of, rng=rng)
    consistency = photo_consistency(
        data, plan.person_of, photos=options.photos_per_enrollment, rng=rng
    )
    report = CalibrationReport(
        consistency, suspicious_pairs(data, plan.person_of, plan.people, above=SUSPICIOUS_ABOVE)
    )
    service = Lifter(binding.strategy, source, binding.contract_id)
    generator = client_source(source)
    progress("enrolling people", 0.0)
    stream = Keystream.seeded("calibration templates", options.seed)
    templates = service.lift(
        enrolled_means(data, plan)[plan.compared],
        m=binding.m,
        stream=stream,
    )
    if cohort_seed is None:
        stream = Keystream.fresh()
        cohort_seed = stream.token(KEY_BYTES)
    run = CalibrationRun(
        embeddings=data,
        plan=plan,
        comparison=Comparison(
            plan,
            templates,
            Nobody(generator, binding.strategy, binding.m, cohort_seed),
            options.metric,
            options.steps,
        ),
        service=service,
        client=Lifter(plain_strategy(binding.strategy), generator, binding.contract_id),
        pairs=pairs,
        groups=groups,
        report=report,
        options=options,
        facts={
            "dataset": dataset,
            **({"groups_from": labels.source} if labels is not None else {}),
            "worst_group": options.worst_group,
            "photos": len(data),
            "people": len(plan.people),
            "templates": len(plan.compared),
            "excluded_photos": excluded_photos,
            "photos_per_enrollment": options.photos_per_enrollment,
            "protocol": options.protocol,
            "seed": options.seed,
        },
        progress=progress,
    )
    progress("comparing probes with templates", _ENROLLED)
    calibrations: list[Calibration] = []
    sets = point_sets(run, rng) if 0 in options.probe_dims else []
    kinds: list[ProbeSets | int] = [*sets, *(dim for dim in options.probe_dims if dim)]
    for number, kind in enumerate(kinds):
        first, last = (
            _ENROLLED + (1 - _ENROLLED) * done / len(kinds) for done in (number, number + 1)
        )
        part = replace(run, progress=part_of(progress, first, last))
        calibrations.append(
            calibrate_lifted(part, kind, rng)
            if isinstance(kind, int)
            else calibrate_points(part, kind)
        )
    return Calibrated(_contract(run, binding, calibrations, recorded or {}), report)


def _contract(
    run: CalibrationRun,
    binding: Binding,
    calibrations: Sequence[Calibration],
    recorded: Mapping[str, Json],
) -> Contract:
    consistency, templates = run.report.consistency, run.comparison.templates
    near = run.comparison.nobody.stranger_similarity(templates)
    return Contract(
        binding=binding,
        recorded={
            **recorded,
            "photo_consistency_fmr": consistency.fmr.value,
            "photo_consistency_refused": consistency.refused.value,
        },
        calibrations=tuple(calibrations),
        default_level=_default_level(calibrations),
        photo_consistency=consistency.threshold,
        probe_consistency=consistency.probe_threshold,
        template_foot_point_norm=honest_norms(templates.foot_norms),
        template_stranger_similarity=float(near.mean() + DEVIATIONS * near.std()),
        cohort_seed=run.comparison.nobody.cohort_seed,
    )


def _default_level(calibrations: Sequence[Calibration]) -> str:
    """Return the first of ``DEFAULT_LEVELS`` that all calibrations resolve, or what they share.

    Those of several probe photos do not count: one of fewer photos decides where one lacks a level.

    The laxest target is resolved by all of them, or the level of the ten-fold protocol is there.
    """
    single = [entry for entry in calibrations if entry.probe_photos == 1]
    shared = set.intersection(*({level.name for level in entry.levels} for entry in single))
    for name in DEFAULT_LEVELS:
        if name in shared:
            return name
    levels = [level for level in calibrations[0].levels if level.name in shared]
    targeted = [level for level in levels if level.target_fmr is not None]
    return (targeted or levels)[-1].name
