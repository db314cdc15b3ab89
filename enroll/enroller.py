"""From photos, embeddings or a client's template to the one private template that is stored.

The order matters: the photos' embeddings are averaged first and lifted once, because two lifts of
one person meet in that person's descriptor (docs/method.md §4.6). Randomness is fresh for every
template and dropped with it. The tenant's rotation comes last, so that clients never need it.
"""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from enroll.errors import InconsistentImages, PhotoRejected
from models.decoding import DEFAULT_LIMITS, ImageLimits
from models.errors import ModelError
from models.pack import FacePolicy, ModelPack
from models.quality import DEFAULT_QUALITY, QualityLimits
from templates.contract import wire
from templates.contract.document import Contract
from templates.decoys import Attributes, DecoySource
from templates.errors import ContractMismatch, InvalidTemplate
from templates.keys.randomness import Keystream
from templates.space.agreement import weakest_split
from templates.space.embedding import unit_rows
from templates.space.lifting import Strategy, lift
from templates.space.subspace import AffineSubspace

MAX_PHOTOS = 10
WIRE_DTYPE: wire.WireDtype = "float16"


@dataclass(frozen=True)
class PhotoResult:
    """What is told about one photo: its position, and its quality where a photo was sent."""

    index: int
    quality: object | None = None


@dataclass(frozen=True)
class Enrollment:
    """One private template, ready for the store.

    Parameters
    ----------
    wire
        Rotated template in the wire format. Private: to be sealed, never logged.
    template_id
        Random name of this template, 32 hexadecimal digits.
    contract_id
        Contract that the template belongs to.
    per_photo
        One result per photo; empty for a client's template.
    """

    wire: bytes = field(repr=False)
    template_id: str
    contract_id: str
    per_photo: tuple[PhotoResult, ...]


class Enroller:
    """Makes templates of one contract for one tenant. Holds no state between calls.

    Parameters
    ----------
    contract
        Contract that the templates will carry.
    source
        Decoy source; its id must be the contract's.
    rotation : (n, n) float64
        The tenant's orthogonal rotation.

    Raises
    ------
    ContractMismatch
        Where the source or the rotation is not the contract's.
    """

    def __init__(
        self, contract: Contract, source: DecoySource, *, rotation: NDArray[np.float64]
    ) -> None:
        contract.binding.require_source(source_id=source.source_id)
        n = contract.binding.n
        if source.n != n or rotation.shape != (n, n):
            raise ContractMismatch(
                f"the contract is for embeddings of {n} numbers; the decoy source gives "
                f"{source.n}, the rotation turns {rotation.shape[0]}"
            )
        self._contract = contract
        self._source = source
        self._rotation = rotation

    def from_photos(
        self,
        pack: ModelPack,
        photos: Sequence[bytes],
        *,
        attributes: Attributes | None = None,
        policy: FacePolicy = FacePolicy.SINGLE,
        quality: QualityLimits | None = DEFAULT_QUALITY,
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> Enrollment:
        """Enroll from 1 to 10 photo files.

        Parameters
        ----------
        policy, quality, limits
            See ``ModelPack.embed_photo``; ``attributes`` see ``from_embeddings``.

        Raises
        ------
        ContractMismatch
            Where the pack is not the contract's.
        PhotoRejected
            Where one photo has no usable face; nothing is enrolled then.
        InconsistentImages
            Where the photos do not show one person.
        """
        info = pack.info
        self._contract.binding.require_embedder(
            embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing, n=info.n
        )
        if not 1 <= len(photos) <= MAX_PHOTOS:
            raise ValueError(f"an enrollment has 1 to {MAX_PHOTOS} photos, not {len(photos)}")
        samples = []
        for index, photo in enumerate(photos):
            try:
                sample = pack.embed_photo(photo, policy=policy, quality=quality, limits=limits)
            except ModelError as error:
                raise PhotoRejected(index, error, count=len(photos)) from error
            samples.append(sample)
        return self.from_embeddings(
            np.stack([sample.embedding for sample in samples]),
            attributes=attributes,
            qualities=[sample.quality for sample in samples],
        )

    def from_embeddings(
        self,
        embeddings: NDArray[np.floating],
        *,
        attributes: Attributes | None = None,
        qualities: Sequence[object] | None = None,
    ) -> Enrollment:
        """Enroll from 1 to 10 unit embeddings of one person, (k, n).

        Parameters
        ----------
        attributes
            The subject's gender and race, for hybrid+ only. Used here and forgotten.
        qualities
            One quality record per embedding, handed through to the result.

        Raises
        ------
        InvalidEmbedding
            Where an embedding is not a finite unit vector of n numbers.
        InconsistentImages
            Where the embeddings part into two groups less alike than ``photo_consistency``.
        """
        rows = unit_rows(embeddings, n=self._contract.binding.n, most=MAX_PHOTOS)
        descriptor = mean_descriptor(rows, consistency=self._contract.photo_consistency)
        binding = self._contract.binding
        named = [attributes or Attributes()] if binding.strategy is Strategy.HYBRID_PLUS else None
        # Without a stream, lift draws from a fresh one and drops it.
        lifted = lift(
            descriptor[None],
            strategy=binding.strategy,
            m=binding.m,
            source=self._source,
            attributes=named,
        )
        records = qualities if qualities is not None else [None] * len(rows)
        results = [PhotoResult(index, entry) for index, entry in enumerate(records)]
        return self._finish(lifted[0], per_photo=tuple(results))

    def from_template(self, data: bytes) -> Enrollment:
        """Enroll a template that a client lifted, in the wire format, un-rotated.

        The set is kept; its basis is drawn anew. A template that lies near strangers, as a wolf
        does, is refused. One that was laid through a few dozen people is not: nothing tells it
        from a lift of one of them.

        Raises
        ------
        InvalidTemplate
            Where the bytes break the format, or the template cannot be an honest lift.
        ContractMismatch
            Where the template belongs to another contract.
        """
        contract, subspace = self._contract, self._received(data)
        rule = contract.calibrations[0]
        score = contract.nobody.score(subspace, metric=rule.metric, steps=rule.steps)
        # NaN is not below the limit either.
        if not score <= contract.template_stranger_score:
            raise InvalidTemplate(
                "the template lies nearer to strangers than the contract recorded of honest ones: "
                "lift photos of one person with the contract's decoys"
            )
        return self._of(subspace)

    def from_export(self, data: bytes) -> Enrollment:
        """Enroll the template of an export that this service sealed, un-rotated.

        As :meth:`from_template`, for a template that was made of photos by the service itself.
        """
        return self._of(self._received(data))

    def _received(self, data: bytes) -> AffineSubspace:
        """Decode a template, and check whether it is one of the contract."""
        binding = self._contract.binding
        received = wire.decode(data)
        binding.require_contract(received.contract_id, what="the template")
        subspace = received.subspace
        if (subspace.n, subspace.m) != (binding.n, binding.m):
            raise InvalidTemplate(
                f"a template of this contract has n = {binding.n} and m = {binding.m}, "
                f"not n = {subspace.n} and m = {subspace.m}"
            )
        low, high = self._contract.template_foot_point_norm
        if not low <= subspace.foot_norm <= high:
            raise InvalidTemplate(
                "the template's foot point is outside the range that the contract recorded: "
                "lift a unit-norm embedding with the contract's decoys"
            )
        return subspace

    def _of(self, subspace: AffineSubspace) -> Enrollment:
        # The client knows its rows. Rotated as they are, they would be pairs (x, R x) of the
        # tenant's rotation for whoever sees them stored; of a fresh basis only the set is known.
        with Keystream.fresh() as stream:
            spanned = AffineSubspace.through(subspace.foot, subspace.basis, stream=stream)
        return self._finish(spanned, per_photo=())

    def _finish(
        self, subspace: AffineSubspace, *, per_photo: tuple[PhotoResult, ...]
    ) -> Enrollment:
        contract_id = self._contract.contract_id
        rotated = subspace.rotated(self._rotation)
        return Enrollment(
            wire=wire.encode(rotated, contract_id=contract_id, dtype=WIRE_DTYPE),
            template_id=secrets.token_hex(16),
            contract_id=contract_id,
            per_photo=per_photo,
        )


def mean_descriptor(rows: NDArray[np.float32], *, consistency: float) -> NDArray[np.float32]:
    """Average the unit rows of one person and normalise, (k, n) to (n,).

    Raises
    ------
    InconsistentImages
        Where the rows part into two groups that agree less than ``consistency``
        (``templates.space.agreement``), or cancel.
    """
    mean = rows.astype(np.float64).mean(axis=0)
    norm = float(np.linalg.norm(mean))
    if len(rows) > 1:
        split = weakest_split(rows)
        if split.agreement < consistency or norm < 1e-6:
            raise InconsistentImages(split.apart, split.others)
    return np.asarray(mean / norm, dtype=np.float32)
