"""From photos, embeddings or a client's template to the one private template that is stored.

The order matters: the photos' embeddings are averaged first and lifted once, because two lifts of
one person meet in that person's descriptor (docs/method.md §4.6). For the same reason the photos
decide the decoys, under a secret of the deployment: enrolled again, they give the same set; where
the person keeps a key, for the same subject only. The template's rotations come last, the holder's
and then the tenant's, so that clients never need the tenant's.
"""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from models.pack import ModelPack
from models.quality import Quality
from models.selection import FacePolicy
from templates.contract import wire
from templates.contract.document import Contract
from templates.decoys import Attributes, DecoySource
from templates.errors import InvalidTemplate
from templates.keys.randomness import Keystream
from templates.keys.rotation import HolderKey, TenantRotation, holder_rotation
from templates.space.agreement import distinct_rows, mean_embedding
from templates.space.embedding import unit_rows
from templates.space.lifting import Strategy, lift, lift_stream
from templates.space.subspace import SubspaceBatch

MAX_PHOTOS = 10
WIRE_DTYPE: wire.WireDtype = "float16"


@dataclass(frozen=True)
class Holder:
    """A person who keeps a key, without which the enrollment's template accepts nobody."""

    key: HolderKey = field(repr=False)
    tenant: str
    subject: str


@dataclass(frozen=True)
class Enrollment:
    """One private template, ready for the store.

    Parameters
    ----------
    wire
        Rotated template in the wire format. Private: to be sealed, never logged.
    template_id
        Random, 32 hexadecimal digits; its rotation is derived from it.
    holder_salt
        The holder's rotation is derived from it and their key. None where it needs no key.
    qualities
        Of each photo; empty where there were none.
    photos
        How many different photos were averaged: one that is given twice counts once.
    """

    wire: bytes = field(repr=False)
    template_id: str
    contract_id: str
    holder_salt: str | None = None
    qualities: tuple[Quality, ...] = ()
    photos: int = 0


class Enroller:
    """Makes templates of one contract for one tenant. Holds no state between calls.

    Parameters
    ----------
    source
        The contract's decoys, reduced to its axes; others are a ContractMismatch.
    rotation
        What gives each template of the tenant its rotation.
    lift_secret
        32 secret bytes of the deployment, which decoys are drawn under.
    """

    def __init__(
        self,
        contract: Contract,
        source: DecoySource,
        *,
        rotation: TenantRotation,
        lift_secret: bytes,
    ) -> None:
        self._contract = contract
        self._source = source
        self._rotation = rotation
        self._lift_secret = lift_secret
        self._nobody = contract.nobody(source)

    def from_photos(
        self,
        pack: ModelPack,
        photos: Sequence[bytes],
        *,
        attributes: Attributes | None = None,
        holder: Holder | None = None,
        policy: FacePolicy = FacePolicy.DOMINANT,
    ) -> Enrollment:
        """Enroll from 1 to 10 photo files; as :meth:`from_embeddings`.

        Parameters
        ----------
        pack
            The contract's.
        policy
            Which face is meant in a photo of several.

        Raises
        ------
        PhotoRejected
            Where one photo has no usable face; nothing is enrolled then.
        """
        samples = pack.embed_photos(photos, policy=policy, digested=True)
        enrollment = self._lifted(
            np.stack([sample.embedding for sample in samples]),
            [cast("bytes", sample.picture) for sample in samples],
            attributes,
            holder,
        )
        return replace(enrollment, qualities=tuple(sample.quality for sample in samples))

    def from_embeddings(
        self,
        embeddings: NDArray[np.floating],
        *,
        attributes: Attributes | None = None,
        holder: Holder | None = None,
    ) -> Enrollment:
        """Enroll from 1 to 10 unit embeddings of one person, (k, n).

        Parameters
        ----------
        attributes
            The subject's gender and race, for hybrid+ only. Used here and forgotten.
        holder
            Whose key the template needs; None: it needs none.

        Raises
        ------
        InvalidEmbedding
            Where an embedding is not a finite unit vector of n numbers.
        InconsistentImages
            Where the embeddings part into two groups less alike than ``photo_consistency``.
        """
        rows = unit_rows(embeddings, n=self._contract.binding.n, most=MAX_PHOTOS)
        return self._lifted(rows, [row.tobytes() for row in rows], attributes, holder)

    def _lifted(
        self,
        rows: NDArray[np.float32],
        photos: Sequence[bytes],
        attributes: Attributes | None,
        holder: Holder | None,
    ) -> Enrollment:
        """Lift the mean of unit rows; ``photos`` are what decides the decoys."""
        contract, binding = self._contract, self._contract.binding
        mean = mean_embedding(rows, consistency=contract.photo_consistency)
        labels = [attributes or Attributes()] if binding.strategy is Strategy.HYBRID_PLUS else None
        stream = lift_stream(
            self._lift_secret,
            contract_id=contract.contract_id,
            photos=photos,
            holder=None if holder is None else (holder.tenant, holder.subject),
        )
        lifted = lift(
            self._source.project(mean[None]),
            strategy=binding.strategy,
            m=binding.m,
            source=self._source,
            stream=stream,
            attributes=labels,
        )
        enrollment = self._enrollment(*self._turned_by_holder(lifted[0], holder))
        return replace(enrollment, photos=len(distinct_rows(rows)))

    def from_template(self, data: bytes, *, holder: Holder | None = None) -> Enrollment:
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
        near = float(self._nobody.stranger_similarity(subspace)[0])
        # NaN is not below the limit either.
        if not near <= contract.template_stranger_similarity:
            raise InvalidTemplate(
                "the template lies nearer to strangers than the contract recorded of honest ones: "
                "lift photos of one person with the contract's decoys"
            )
        return self._spanned_anew(*self._turned_by_holder(subspace, holder))

    def from_export(self, data: bytes, *, holder_salt: str | None = None) -> Enrollment:
        """Enroll the template of an export that a service sealed, without the tenant's rotation.

        As :meth:`from_template`, for a template that was made of photos by the service itself. If a
        holder's rotation still applies, ``holder_salt`` is its salt.
        """
        return self._spanned_anew(self._received(data), holder_salt)

    def _received(self, data: bytes) -> SubspaceBatch:
        """Decode a template, and check whether it is one of the contract."""
        binding = self._contract.binding
        received = wire.decode(data)
        binding.require_contract(received.contract_id, what="the template")
        subspace = received.subspace
        if (subspace.n, subspace.m) != (binding.axes, binding.m):
            raise InvalidTemplate(
                f"a template of this contract has {binding.axes} numbers and m = {binding.m}, "
                f"not {subspace.n} and m = {subspace.m}"
            )
        low, high = self._contract.template_foot_point_norm
        if not low <= subspace.foot_norm <= high:
            raise InvalidTemplate(
                "the template's foot point is outside the range that the contract recorded: "
                "lift a unit-norm embedding with the contract's decoys"
            )
        return subspace

    def _spanned_anew(self, subspace: SubspaceBatch, holder_salt: str | None) -> Enrollment:
        # The client knows its rows. Turned as they are, they would be pairs (x, R x) of the
        # template's rotation for whoever sees them stored; of a fresh basis only the set is known.
        stream = Keystream.fresh()
        spanned = SubspaceBatch.through(subspace.foot, subspace.basis, stream=stream)
        return self._enrollment(spanned, holder_salt)

    def _turned_by_holder(
        self, subspace: SubspaceBatch, holder: Holder | None
    ) -> tuple[SubspaceBatch, str | None]:
        """Turn a template by a new rotation of its holder's; returns it with the salt."""
        if holder is None:
            return subspace, None
        salt = secrets.token_hex(16)
        rotation = holder_rotation(holder.key, salt, self._contract.binding.axes)
        return subspace.turned_by(rotation.turned), salt

    def _enrollment(self, subspace: SubspaceBatch, holder_salt: str | None) -> Enrollment:
        """Turn a template by a rotation of the tenant's, and encode it."""
        contract_id, template_id = self._contract.contract_id, secrets.token_hex(16)
        turned = subspace.turned_by(self._rotation.of(template_id).turned)
        data = wire.encode(turned, contract_id=contract_id, dtype=WIRE_DTYPE)
        return Enrollment(data, template_id, contract_id, holder_salt)
