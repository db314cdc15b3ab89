"""From folders of photos to what ``serve`` loads: the decoy source and the contract.

The commands ``decoys build`` and ``calibrate`` and the demo are callers of these functions.
"""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.binding import embedding_id
from templates.contract.canonical import Json
from templates.contract.document import Binding
from templates.decoys import Attributes, DecoyGenerator, DecoyPool, DecoySource
from templates.errors import ContractMismatch, VeilfaceError
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from verify import Calibrated, CalibrationOptions, LabelledFolder, calibrate, read_lfw_pairs
from verify.own_decoys import require_others
from verify.trials import chosen_photos

DEFAULT_DIM = 64
"""Dimension of stored templates: the operating point that docs/privacy.md arrives at."""


DEFAULT_PROBE_DIM = 4
"""Dimension of the lifted probes that a calibration takes. On LFW at m = 64, 5 % of genuine ones
are rejected, 7 % at 8 and 15 % at 16 (docs/measurements.md); at 2 the FMR was above its target."""


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


def default_probe_dims(m: int) -> tuple[int, ...]:
    """Dimensions of lifted probes where none are asked for: no larger than the templates'."""
    return (min(DEFAULT_PROBE_DIM, m),)


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


def make_generator(extraction: Extraction, pack: ModelPack) -> DecoyGenerator:
    """Fit the generator of decoys that belong to nobody to descriptors of the pack."""
    return DecoyGenerator.fit(extraction.descriptors, made_with=made_with(pack))


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
    found = [labels.get(path.resolve()) for path in extraction.paths]
    missing = [path.name for path, label in zip(extraction.paths, found, strict=True) if not label]
    if missing:
        raise PreparationError(
            f"{len(missing)} photos have no label, the first is {missing[0]}; give the label file "
            "of this folder, or leave those photos out"
        )
    return DecoyPool(
        extraction.descriptors,
        labels=[label for label in found if label],
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
        strategy=strategy,
        m=m,
        decoy_source_id=source.source_id,
        rotation_version=ROTATION_VERSION,
    )
    binding.require_source(source_id=source.source_id, made_with=source.made_with)
    return binding


def calibrate_folder(
    folder: LabelledFolder,
    extraction: Extraction,
    *,
    pack: ModelPack,
    source: DecoySource,
    strategy: Strategy,
    m: int,
    options: CalibrationOptions,
    exclude: Collection[str] = (),
    aliases: Mapping[str, str] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Calibrated:
    """Calibrate on the descriptors of a labelled folder.

    LFW's own pairs are used for the ten-fold protocol where ``pairs.txt`` lies in the folder.

    Raises
    ------
    ContractError
        The decoys were made of these people, or the data are too few for a single level.
    """
    name_of = dict(zip(folder.paths, folder.identities, strict=True))
    pairs_file = folder.root / "pairs.txt"
    pairs = None
    if options.protocol == "ten-fold" and pairs_file.is_file():
        missing = [failure.path for failure in extraction.failures]
        pairs = read_lfw_pairs(pairs_file, extraction.paths, missing=missing)
    more: dict[str, Any] = {} if progress is None else {"progress": progress}
    names = [name_of[path] for path in extraction.paths]
    kept, staying = chosen_photos(names, exclude=exclude, aliases=aliases or {})
    if len(kept):
        require_others(source, extraction.descriptors[kept], staying)
    return calibrate(
        extraction.descriptors,
        names,
        binding=binding_for(pack, source, strategy=strategy, m=m),
        source=source,
        options=options,
        exclude=exclude,
        aliases=aliases,
        pairs=pairs,
        recorded=recorded_of(pack),
        dataset=folder.root.resolve().name,
        **more,
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
