"""From embeddings of photos to decoys, and to what a contract is bound to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.binding import embedding_id
from templates.contract.canonical import Json
from templates.contract.document import Binding
from templates.decoys import Attributes, DecoyGenerator, DecoyPool, DecoySource
from templates.distances.blas import single_threaded
from templates.errors import ContractMismatch, VeilfaceError
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from verify.evaluation.attributes import resembling_rows


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


def made_with(pack: ModelPack) -> str:
    """Name the space of the pack's embeddings, as decoys made of them carry it."""
    info = pack.info
    return embedding_id(embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing)


def require_made_with(source: DecoySource, pack: ModelPack) -> None:
    """Refuse decoys that are not, or do not say that they are, embeddings of this pack."""
    if source.made_with != made_with(pack):
        what = (
            "do not say which model they were made with"
            if source.made_with is None
            else "were made with another model or another preprocessing"
        )
        raise ContractMismatch(
            f"the decoys {what}, and would hide nothing; build the decoys with this pack and the "
            "same --flip"
        )


SAME_PHOTO = 0.999
"""Cosine of a photo to itself, encoded again."""
LOOKALIKE = 0.75
"""Raw cosine from which on two photos that nobody labelled are taken for copies. Lower, it would
drop strangers who look alike, of whom there are many among children, and flatter the thresholds."""
_TILE = 2_048


def without_lookalikes(extraction: Extraction) -> Extraction:
    """Drop photos that resemble an earlier one, of faces of which each shows another person."""
    rows = extraction.embeddings
    stays = np.ones(len(rows), dtype=np.bool_)
    for start in range(0, len(rows), _TILE):
        tile = rows[start : start + _TILE]
        alike = tile @ rows[: start + len(tile)].T >= LOOKALIKE
        for row in np.flatnonzero(alike.sum(axis=1) > 1):
            earlier = slice(start + row)
            stays[start + row] = not (alike[row, earlier] & stays[earlier]).any()
    kept = np.flatnonzero(stays).tolist()
    return Extraction(
        rows[kept],
        [extraction.paths[row] for row in kept],
        extraction.failures,
        cached=extraction.cached,
    )


@dataclass(frozen=True, eq=False)
class LikeSample:
    """Embeddings of a few faces of the kind that will be enrolled, and K names of the people."""

    extraction: Extraction
    people: Sequence[str]


def make_generator(
    extraction: Extraction, pack: ModelPack, *, like: LikeSample | None = None
) -> DecoyGenerator:
    """Fit the generator of decoys that belong to nobody to embeddings of the pack."""
    rows, made = extraction.embeddings, made_with(pack)
    if like is None:
        with single_threaded():
            return DecoyGenerator.fit(rows, made_with=made)
    sample = like.extraction.embeddings
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
    """Make a pool of real embeddings, labelled where labels are given."""
    if labels is None:
        return DecoyPool(extraction.embeddings, made_with=made_with(pack))
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
        extraction.embeddings,
        labels=[label for label in labels_of_photos if label],
        made_with=made_with(pack),
    )


def binding_for(pack: ModelPack, source: DecoySource, *, strategy: Strategy, m: int) -> Binding:
    """Bind a pack, a decoy source and a way of lifting."""
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
    binding.require_source(source)
    return binding


def recorded_of(pack: ModelPack) -> dict[str, Json]:
    """Facts that a contract records without binding them."""
    detector = pack.info.detector
    facts: dict[str, Json] = {"pack": pack.info.name}
    if detector is not None:
        facts["detector"] = detector.kind
        facts["detector_sha256"] = detector.sha256
        facts["detector_input_size"] = list(detector.input_size)
    return facts
