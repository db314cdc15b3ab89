"""From embeddings of labelled people to a contract that carries its verdict.

Axes and dimension are chosen, and privacy is judged, by attacks; so this lies above both
``verify`` and ``attacks``. The commands ``calibrate`` and ``setup``, and the demo, call it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from attacks.operating_point import OperatingPoint, choose_and_judge, judge_accuracy, judge_groups
from attacks.setup import AttackSetup
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.contract.verdict import Verdict
from templates.decoys import DecoyPool, DecoySource
from templates.distances.blas import single_threaded
from templates.space.lifting import Strategy, plain_strategy
from verify import CalibrationOptions, CalibrationReport, LabelledFolder, calibrate
from verify.group_rates import PhotoLabels
from verify.own_decoys import require_others
from verify.preparation import PreparationError, binding_for, recorded_of

DEFAULT_PROBE_DIM = 4
"""Dimension of the lifted probes that a calibration takes."""
SEARCHED = 0.6
"""Share of a calibration's time that has passed, on LFW, once axes and dimension are chosen."""


@dataclass(frozen=True)
class CalibratedFolder:
    """A contract with its verdict, the report of its calibration, and why it has its dimension."""

    contract: Contract
    report: CalibrationReport
    point: OperatingPoint


def calibrate_folder(
    folder: LabelledFolder,
    extraction: Extraction,
    *,
    pack: ModelPack,
    source: DecoySource,
    strategy: Strategy,
    axes: int | None = None,
    m: int | None = None,
    options: CalibrationOptions,
    labels: PhotoLabels | None = None,
    progress: Callable[[float], None] = lambda _share: None,
) -> CalibratedFolder:
    """Calibrate on the embeddings of a labelled folder; judge privacy, accuracy and groups.

    ``source`` has all of its axes. ``axes`` and ``m`` that are None are chosen: what rejects the
    fewest genuine probes of all that is private. ``progress`` is called with the share done.
    """
    if not strategy.needs_decoys:
        raise PreparationError(
            f"templates of strategy {strategy} conceal nothing; `veilface evaluate` measures it, "
            "and no contract is made for it"
        )
    name_of = dict(zip(folder.paths, folder.identities, strict=True))
    names = [name_of[path] for path in extraction.paths]
    require_others(source, extraction.embeddings, names)
    plain, uncovered = plain_strategy(strategy), None
    if isinstance(source, DecoyPool):
        uncovered = (
            "an attacker with the pool finds the decoys, and no attack of a calibration has it"
        )
    elif plain is not strategy:
        uncovered = f"the attacks are on {plain} lifting, not on what {strategy} chooses by"
    # Thousands of products of small matrices: with a second thread for each, the library spends
    # most of its time waiting. The distances have threads of their own.
    with single_threaded():
        setup = AttackSetup.of_people(
            extraction.embeddings,
            names,
            source,
            photos=options.photos_per_enrollment,
            seed=options.seed,
        )
        point = choose_and_judge(
            setup,
            strategy=strategy,
            axes=axes,
            m=m,
            uncovered=uncovered,
            progress=lambda share: progress(SEARCHED * share),
        )
        source = source.reduced(point.axes)
        probe_dims = tuple(dict.fromkeys(min(dim, point.dim) for dim in options.probe_dims))
        done = calibrate(
            extraction.embeddings,
            names,
            binding=binding_for(pack, source, strategy=strategy, m=point.dim),
            source=source,
            options=replace(options, probe_dims=probe_dims),
            labels=labels,
            recorded=recorded_of(pack),
            dataset=folder.root.resolve().name,
            excluded_photos=folder.excluded,
            progress=lambda _, share: progress(SEARCHED + (1 - SEARCHED) * share),
        )
    accuracy = None
    if len(set(names)) < len(names):
        accuracy = judge_accuracy(
            done.contract, photos=extraction.attempts, not_acquired=len(extraction.failures)
        )
    verdict = Verdict(point.privacy, accuracy, judge_groups(done.contract))
    return CalibratedFolder(replace(done.contract, verdict=verdict), done.report, point)
