"""From labelled descriptors to a contract: thresholds for stated false match rates."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from templates.contract.canonical import Json
from templates.contract.document import Binding, Calibration, Contract
from templates.contract.nobody import Nobody
from templates.decoys import Attributes, DecoySource
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.embedding import unit_descriptors
from templates.space.subspace import SubspaceBatch
from verify.calibration_mode import CalibrationOptions, CalibrationRun, calibrate_mode
from verify.cohort import COHORT_SIZE, client_source, make_cohort, people_like, plain_strategy
from verify.comparisons import Lifter, Progress, honest_norms
from verify.consistency import Consistency, photo_consistency
from verify.raw_pairs import SuspiciousPair, suspicious_pairs
from verify.strangers import honest_score, make_nobody, strangers_like
from verify.tenfold import Pair, TenFold, pair_arrays, random_pairs, require_folds
from verify.trials import TrialPlan, chosen_photos, enrolled_means, plan_trials

DEFAULT_LEVEL = "fmr-1e-3"


@dataclass(frozen=True)
class CalibrationReport:
    """What an operator should read beside the contract.

    Parameters
    ----------
    consistency
        How ``photo_consistency`` was set.
    unresolved
        Sentences about the FMR targets that the data cannot resolve.
    suspicious
        People who may be one person under two names: look at them before believing a threshold
        at FMR 1e-4 or below, then name them in ``aliases`` (docs/method.md §7.3).
    suspicious_above
        Raw cosine that makes a pair suspicious.
    ten_folds
        Results of the ten-fold protocol, one per calibration in the contract's order; empty
        under protocol ``fmr``.
    """

    consistency: Consistency
    unresolved: tuple[str, ...]
    suspicious: tuple[SuspiciousPair, ...]
    suspicious_above: float
    ten_folds: tuple[TenFold, ...]


@dataclass(frozen=True)
class Calibrated:
    """A contract, and the report of its calibration."""

    contract: Contract
    report: CalibrationReport


def _part_of(progress: Progress, number: int, parts: int) -> Progress:
    """Report the progress of one of several equal parts as progress of the whole."""
    return lambda what, share: progress(what, (number + share) / parts)


def _silent(_what: str, _share: float) -> None:
    """Show no progress."""


def calibrate(
    descriptors: NDArray[np.floating],
    identities: Sequence[str],
    *,
    binding: Binding,
    source: DecoySource,
    options: CalibrationOptions | None = None,
    exclude: Collection[str] = (),
    aliases: Mapping[str, str] | None = None,
    attributes: Sequence[Attributes] | None = None,
    pairs: Sequence[Pair] | None = None,
    cohort: SubspaceBatch | None = None,
    nobody: Nobody | None = None,
    recorded: Mapping[str, Json] | None = None,
    dataset: str = "labelled folder",
    progress: Callable[[str, float], None] = _silent,
) -> Calibrated:
    """Calibrate a contract on the private templates of labelled people.

    Every person is enrolled once, on up to ``photos_per_enrollment`` averaged photos, lifted and
    passed through the wire format as in the service. Genuine probes are the photos that were left
    out. Impostor trials are all cross-identity pairs in p-to-s, and a stated random subset of
    them in s-to-s. A level's two thresholds stand at one marginal quantile, chosen so that the
    joint FMR is at most the target (docs/method.md §6.2).

    Parameters
    ----------
    descriptors : (N, n) floating
        Unit rows.
    identities
        N names.
    binding, source
        What the contract binds to, and the decoy source it names.
    exclude
        People to leave out, such as those of a test.
    aliases
        Second names of one person, mapped to the first.
    attributes
        One per descriptor, for hybrid+; without them hybrid+ is calibrated on decoys of any label.
    pairs
        Pairs of the ten-fold protocol, as positions in ``descriptors``; balanced random pairs
        where None. Pairs of excluded people are left out.
    cohort
        A contract's cohort, to keep it; by default a new one is drawn from fresh randomness.
    nobody
        A contract's strangers, to keep them with their cohort; by default new ones are drawn.
    recorded
        Facts for the contract file, such as the pack's name and detector.
    dataset
        What the descriptors came from, for the contract file.
    progress
        Called with what is being done and the share of the whole, which rises from 0 to 1.

    Returns
    -------
    Calibrated
        Contract and report.

    Raises
    ------
    ContractError
        Where the data are too few for a single level, or do not fit the binding.
    ContractMismatch
        Where ``source`` is not the binding's.
    """
    options = options or CalibrationOptions()
    binding.require_source(source_id=source.source_id)
    unit = unit_descriptors(descriptors)
    if unit.shape != (len(identities), binding.n):
        raise ContractError(
            f"{len(identities)} identities and a binding of n = {binding.n} need embeddings of "
            f"shape ({len(identities)}, {binding.n}), not {unit.shape}"
        )
    kept, names = chosen_photos(identities, exclude=exclude, aliases=aliases or {})
    if len(set(names)) < 2 or len(set(names)) == len(names):
        raise ContractError(
            "a calibration needs at least two people, and one with at least two photos"
        )
    data = np.ascontiguousarray(unit[kept], dtype=np.float32)
    rng = np.random.default_rng(options.seed)
    plan = plan_trials(names, photos_per_enrollment=options.photos_per_enrollment, rng=rng)
    run = _lay_out(
        data,
        plan,
        binding=binding,
        source=source,
        options=options,
        cohort=cohort,
        nobody=nobody,
        attributes=None if attributes is None else [attributes[index] for index in kept],
        pairs=_protocol_pairs(options, pairs, kept, plan, rng),
        facts={
            "dataset": dataset,
            "photos": len(data),
            "people": len(plan.people),
            "excluded_photos": len(identities) - len(data),
            "photos_per_enrollment": options.photos_per_enrollment,
            "protocol": options.protocol,
            "seed": options.seed,
        },
        progress=progress,
    )
    consistency = photo_consistency(
        data, plan.person_of, photos=options.photos_per_enrollment, rng=rng
    )
    calibrations: list[Calibration] = []
    unresolved: list[str] = []
    ten_folds: list[TenFold] = []
    for number, probe_m in enumerate(options.probe_dims):
        part = replace(run, progress=_part_of(progress, number, len(options.probe_dims)))
        entry, missing, folds = calibrate_mode(part, probe_m, rng)
        calibrations.append(entry)
        unresolved += missing
        ten_folds += [folds] if folds else []
    contract = _contract(run, binding, calibrations, consistency, recorded or {})
    return Calibrated(
        contract,
        CalibrationReport(
            consistency=consistency,
            unresolved=tuple(unresolved),
            suspicious=tuple(
                suspicious_pairs(data, plan.person_of, plan.people, above=options.suspicious_above)
            ),
            suspicious_above=options.suspicious_above,
            ten_folds=tuple(ten_folds),
        ),
    )


def _contract(
    run: CalibrationRun,
    binding: Binding,
    calibrations: Sequence[Calibration],
    consistency: Consistency,
    recorded: Mapping[str, Json],
) -> Contract:
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
        template_foot_point_norm=honest_norms(run.templates.foot_norms),
        template_stranger_score=honest_score(
            run.nobody,
            run.templates,
            halves=run.halves,
            metric=run.options.metric,
            steps=run.options.steps,
        ),
        cohort=run.cohort,
        nobody=run.nobody,
    )


def _lay_out(
    data: NDArray[np.float32],
    plan: TrialPlan,
    *,
    binding: Binding,
    source: DecoySource,
    options: CalibrationOptions,
    cohort: SubspaceBatch | None,
    nobody: Nobody | None,
    attributes: Sequence[Attributes] | None,
    pairs: tuple[Pair, ...],
    facts: Mapping[str, Json],
    progress: Progress,
) -> CalibrationRun:
    """Enroll everybody, and draw the cohort and the strangers where none are given."""
    service = Lifter(binding.strategy, source, binding.contract_id)
    generator = client_source(source)
    client = Lifter(plain_strategy(binding.strategy), generator, binding.contract_id)
    progress("enrolling people", 0.0)
    means = enrolled_means(data, plan)
    with Keystream.seeded("calibration templates", options.seed) as stream:
        templates = service.lift(
            means,
            m=binding.m,
            stream=stream,
            attributes=attributes and [attributes[photos[0]] for photos in plan.enrolled],
        )
    halves = False
    if cohort is None or nobody is None:
        hidden = people_like(generator, means)
    if cohort is None:
        with Keystream.fresh() as stream:
            cohort = make_cohort(
                generator,
                strategy=binding.strategy,
                m=binding.m,
                stream=stream,
                size=COHORT_SIZE,
                hidden=hidden,
            )
    if nobody is None:
        progress("drawing strangers", 0.0)
        sources = strangers_like(generator, hidden, data, plan.person_of)
        halves = len(sources) == 2
        with Keystream.fresh() as stream:
            nobody = make_nobody(
                generator,
                strangers=sources,
                cohort=cohort,
                metric=options.metric,
                steps=options.steps,
                stream=stream,
            )
    return CalibrationRun(
        descriptors=data,
        plan=plan,
        templates=templates,
        cohort=cohort,
        nobody=nobody,
        halves=halves,
        service=service,
        client=client,
        pairs=pairs,
        options=options,
        facts=facts,
        progress=progress,
    )


def _protocol_pairs(
    options: CalibrationOptions,
    pairs: Sequence[Pair] | None,
    kept: NDArray[np.int64],
    plan: TrialPlan,
    rng: np.random.Generator,
) -> tuple[Pair, ...]:
    if options.protocol == "fmr":
        return ()
    if pairs is None:
        return tuple(random_pairs(plan.person_of, rng=rng))
    place = {int(photo): position for position, photo in enumerate(kept)}
    staying = [
        (place[pair.first], place[pair.second], pair.fold)
        for pair in pairs
        if pair.first in place and pair.second in place
    ]
    # Two names of one person make a pair of the protocol genuine, whatever its file says.
    placed = tuple(
        Pair(first, second, bool(plan.person_of[first] == plan.person_of[second]), fold)
        for first, second, fold in staying
    )
    require_folds(pair_arrays(placed)[1])
    return placed


def _default_level(calibrations: Sequence[Calibration]) -> str:
    """FMR 1e-3 where all calibrations resolve it, else the strictest target that all do.

    The laxest target is resolved by all of them, or the level of the ten-fold protocol is there.
    """
    shared = set.intersection(*({level.name for level in c.levels} for c in calibrations))
    levels = [level for level in calibrations[0].levels if level.name in shared]
    if any(level.name == DEFAULT_LEVEL for level in levels):
        return DEFAULT_LEVEL
    targeted = [level for level in levels if level.target_fmr is not None]
    return (targeted or levels)[-1].name
