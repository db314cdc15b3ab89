"""From folders of photos to what ``serve`` loads: the decoy source and the contract.

The commands ``decoys build`` and ``calibrate`` and the demo are callers of these functions.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attacks.operating_point import (
    OperatingPoint,
    choose_and_judge,
    judge_accuracy,
    judge_groups,
)
from attacks.privacy import AttackSetup
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.binding import embedding_id
from templates.contract.canonical import Json
from templates.contract.document import Binding, Contract
from templates.contract.verdict import Verdict
from templates.decoys import Attributes, DecoyGenerator, DecoyPool, DecoySource
from templates.distances.blas import single_threaded
from templates.errors import ContractMismatch, VeilfaceError
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy, plain_strategy
from verify import (
    CalibrationOptions,
    CalibrationReport,
    LabelledFolder,
    calibrate,
    read_lfw_pairs,
)
from verify.calibration import part_of
from verify.comparisons import Progress
from verify.evaluation.attributes import resembling_rows
from verify.group_rates import PhotoLabels
from verify.own_decoys import SAME_PHOTO, require_others
from verify.trials import chosen_photos

DEFAULT_DIM = 64
"""Dimension that an audit attacks where it is told none."""
DEFAULT_PROBE_DIM = 4
"""Dimension of the lifted probes that a calibration takes."""
_SEARCHED = 0.6
"""Share of a calibration's time that has passed, on LFW, once axes and dimension are chosen."""


class PreparationError(VeilfaceError):
    """The photos do not suffice for what is to be made of them."""


def acquired(extraction: Extraction) -> str:
    """Say how many photos were skipped, and why (failures to acquire)."""
    counts = [(code.replace("_", " "), n) for code, n in extraction.failure_counts().items()]
    if not counts:
        return f"All {extraction.attempts:,} photos used"
    why = ", ".join(f"{name} ({n})" for name, n in counts) if len(counts) > 1 else counts[0][0]
    return f"{len(extraction.failures):,} of {extraction.attempts:,} photos skipped: {why}"


def acquired_json(extraction: Extraction) -> dict[str, Json]:
    """Give :func:`acquired` as JSON."""
    return {
        "photos": extraction.attempts,
        "failed": len(extraction.failures),
        "reasons": dict(extraction.failure_counts()),
    }


def default_probe_dims(m: int | None) -> tuple[int, ...]:
    """Dimensions of lifted probes where none are asked for: no larger than the templates'."""
    return (DEFAULT_PROBE_DIM if m is None else min(DEFAULT_PROBE_DIM, m),)


def made_with(pack: ModelPack) -> str:
    """Name the space of the pack's embeddings, as decoys made of them carry it."""
    return embedding_id(
        embedder_sha256=pack.info.embedder_sha256, preprocessing=pack.info.preprocessing
    )


def require_made_with(source: DecoySource, pack: ModelPack) -> None:
    """Refuse decoys that are not, or do not say that they are, descriptors of this pack.

    Raises
    ------
    ContractMismatch
        They lie in another space than the descriptors that they are to hide, or may do so.
    """
    if source.made_with is None:
        raise ContractMismatch(
            "the decoys do not say which model they were made with; build the decoys with this "
            "pack and the same --flip"
        )
    if source.made_with != made_with(pack):
        raise ContractMismatch(
            f"the decoys were made with another model or another preprocessing "
            f"({source.made_with[:16]}…, this pack's is {made_with(pack)[:16]}…), and would hide "
            "nothing; build the decoys with this pack and the same --flip"
        )


LOOKALIKE = 0.75
"""Raw cosine from which on two photos that nobody labelled are taken for copies. Lower, it would
drop strangers who look alike, of whom there are many among children, and flatter the thresholds."""
_TILE = 2_048


def without_lookalikes(extraction: Extraction) -> Extraction:
    """Drop photos that resemble an earlier one, of faces of which each shows another person."""
    rows = extraction.descriptors
    stays = np.ones(len(rows), dtype=np.bool_)
    for start in range(0, len(rows), _TILE):
        tile = rows[start : start + _TILE]
        alike = tile @ rows[: start + len(tile)].T >= LOOKALIKE
        for row in np.flatnonzero(alike.sum(axis=1) > 1):
            stays[start + row] = not (alike[row] & stays)[: start + row].any()
    kept = np.flatnonzero(stays).tolist()
    return Extraction(
        rows[kept],
        [extraction.paths[row] for row in kept],
        extraction.failures,
        cached=extraction.cached,
    )


@dataclass(frozen=True, eq=False)
class LikeSample:
    """Descriptors of a few faces of the kind that will be enrolled, and K names of the people."""

    extraction: Extraction
    people: Sequence[str]


def make_generator(
    extraction: Extraction, pack: ModelPack, *, like: LikeSample | None = None
) -> DecoyGenerator:
    """Fit the generator of decoys that belong to nobody to descriptors of the pack.

    Raises
    ------
    PreparationError
        Photos of ``like`` are also among those that are adapted to it.
    """
    rows, made = extraction.descriptors, made_with(pack)
    if like is None:
        with single_threaded():  # as below, in calibrate_folder
            return DecoyGenerator.fit(rows, made_with=made)
    sample = like.extraction.descriptors
    twice = len(resembling_rows(sample, rows, cosine=SAME_PHOTO))
    if twice:
        raise PreparationError(
            f"{twice} of the {len(sample)} photos to adapt to are among the others too: the fit "
            "would take them for people whom it has not seen. Give folders that share no people, "
            "or leave them out"
        )
    with single_threaded():
        return DecoyGenerator.adapt(rows, sample, like.people, made_with=made)


def make_pool(
    extraction: Extraction, labels: Mapping[Path, Attributes] | None, pack: ModelPack
) -> DecoyPool:
    """Make a pool of real descriptors, labelled where labels are given.

    Raises
    ------
    PreparationError
        A photo has no label: hybrid+ could not tell what it is.
    """
    if labels is None:
        return DecoyPool(extraction.descriptors, made_with=made_with(pack))
    labels_of_photos = [labels.get(path.resolve()) for path in extraction.paths]
    missing = [
        path.name
        for path, label in zip(extraction.paths, labels_of_photos, strict=True)
        if not label
    ]
    if missing:
        raise PreparationError(
            f"{len(missing)} photos have no label, the first is {missing[0]}; give the label file "
            "of this folder, or leave those photos out"
        )
    return DecoyPool(
        extraction.descriptors,
        labels=[label for label in labels_of_photos if label],
        made_with=made_with(pack),
    )


def binding_for(pack: ModelPack, source: DecoySource, *, strategy: Strategy, m: int) -> Binding:
    """Bind a pack, a decoy source and a way of lifting.

    Raises
    ------
    ContractMismatch
        The source says that it was made with another model or another preprocessing.
    """
    info = pack.info
    binding = Binding(
        embedder_sha256=info.embedder_sha256,
        preprocessing=info.preprocessing,
        n=info.n,
        axes=source.k,
        strategy=strategy,
        m=m,
        decoy_source_id=source.source_id,
        rotation_version=ROTATION_VERSION,
    )
    binding.require_source(source_id=source.source_id, made_with=source.made_with)
    return binding


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
    exclude: Collection[str] = (),
    aliases: Mapping[str, str] | None = None,
    labels: PhotoLabels | None = None,
    progress: Progress = lambda _what, _share: None,
) -> CalibratedFolder:
    """Calibrate on the descriptors of a labelled folder; judge privacy, accuracy and groups.

    LFW's own pairs are used for the ten-fold protocol where ``pairs.txt`` lies in the folder.

    Parameters
    ----------
    source
        With all of its axes.
    axes, m
        Axes that embeddings are projected on, and dimension of the templates; None: what rejects
        the fewest genuine probes of all that is private.
    labels
        Of the photos of ``extraction``, for rates by group of people.
    progress
        Called with what is being done and the share of the whole, which rises from 0 to 1.

    Raises
    ------
    ContractError
        The decoys were made of these people, or the data are too few for a single level.
    PreparationError
        The strategy has no decoys.
    """
    if not strategy.needs_decoys:
        raise PreparationError(
            f"templates of strategy {strategy} conceal nothing; `veilface evaluate` measures it, "
            "and no contract is made for it"
        )
    # Thousands of products of small matrices: with a second thread for each, the library spends
    # most of its time waiting. The distances have threads of their own.
    with single_threaded():
        return _calibrated(
            folder, extraction, pack, source, strategy, axes, m, options, exclude, aliases or {},
            labels, progress,
        )  # fmt: skip


def _calibrated(
    folder: LabelledFolder,
    extraction: Extraction,
    pack: ModelPack,
    source: DecoySource,
    strategy: Strategy,
    axes: int | None,
    m: int | None,
    options: CalibrationOptions,
    exclude: Collection[str],
    aliases: Mapping[str, str],
    labels: PhotoLabels | None,
    progress: Progress,
) -> CalibratedFolder:
    name_of = dict(zip(folder.paths, folder.identities, strict=True))
    pairs_file = folder.root / "pairs.txt"
    pairs = None
    if options.protocol == "ten-fold" and pairs_file.is_file():
        missing = [failure.path for failure in extraction.failures]
        pairs = read_lfw_pairs(pairs_file, extraction.paths, missing=missing)
    names = [name_of[path] for path in extraction.paths]
    kept, staying = chosen_photos(names, exclude=exclude, aliases=aliases)
    if len(kept):
        require_others(source, extraction.descriptors[kept], staying)
    point = _operating_point(
        extraction.descriptors[kept],
        staying,
        source,
        strategy=strategy,
        axes=axes,
        m=m,
        options=options,
        progress=part_of(progress, 0.0, _SEARCHED),
    )
    source = source.reduced(point.axes)
    done = calibrate(
        extraction.descriptors,
        names,
        binding=binding_for(pack, source, strategy=strategy, m=point.dim),
        source=source,
        options=replace(
            options, probe_dims=tuple(dim for dim in options.probe_dims if dim <= point.dim)
        ),
        exclude=exclude,
        aliases=aliases,
        labels=labels,
        pairs=pairs,
        recorded=recorded_of(pack),
        dataset=folder.root.resolve().name,
        progress=part_of(progress, _SEARCHED, 1.0),
    )
    verdict = Verdict(
        privacy=point.privacy,
        accuracy=judge_accuracy(
            done.contract, photos=extraction.attempts, not_acquired=len(extraction.failures)
        )
        if len(set(staying)) < len(staying)
        else None,
        groups=judge_groups(done.contract),
    )
    return CalibratedFolder(replace(done.contract, verdict=verdict), done.report, point)


def _operating_point(
    descriptors: NDArray[np.float32],
    names: Sequence[str],
    source: DecoySource,
    *,
    strategy: Strategy,
    axes: int | None,
    m: int | None,
    options: CalibrationOptions,
    progress: Progress,
) -> OperatingPoint:
    """Choose what is not asked for, and judge how private it is."""
    what = "attacking templates"
    progress(what, 0.0)
    setup = AttackSetup.of_people(
        descriptors, names, source, photos=options.photos_per_enrollment, seed=options.seed
    )
    plain = plain_strategy(strategy)
    uncovered = None
    if isinstance(source, DecoyPool):
        uncovered = "who has the pool finds the decoys, and no attack of a calibration has it"
    elif plain is not strategy:
        uncovered = f"the attacks are on {plain} lifting, not on what {strategy} chooses by"
    return choose_and_judge(
        setup,
        strategy=strategy,
        axes=axes,
        m=m,
        uncovered=uncovered,
        progress=lambda share: progress(what, share),
    )


def recorded_of(pack: ModelPack) -> dict[str, Json]:
    """Facts that a contract records without binding them."""
    detector = pack.info.detector
    facts: dict[str, Json] = {"pack": pack.info.name}
    if detector is not None:
        facts["detector"] = detector.kind
        facts["detector_sha256"] = detector.sha256
        facts["detector_input_size"] = list(detector.input_size)
    return facts
