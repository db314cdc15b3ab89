"""What makes two templates comparable: the part of a contract that its id hashes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

from pydantic import Field

from templates.contract.canonical import Json, digest, plain_json
from templates.contract.parsing import JsonValue, Sha256
from templates.decoys import DecoySource
from templates.errors import ContractError, ContractMismatch
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy

MAX_N = 4096
MAX_M = 192


def embedding_id(*, embedder_sha256: str, preprocessing: Mapping[str, object]) -> str:
    """Name the space that descriptors lie in: equal for equal weights and equal preprocessing.

    Decoys hide a descriptor only if they lie in its space; this id is how a decoy source says
    which one that is (``DecoySource.made_with``).

    Parameters are those of :class:`Binding`; the id is the SHA-256 of the canonical JSON of both.
    """
    return digest({"embedder_sha256": embedder_sha256, "preprocessing": preprocessing})


@dataclass(frozen=True)
class Binding(JsonValue):
    """What makes two templates comparable; its hash is the ``contract_id``.

    Parameters
    ----------
    embedder_sha256
        SHA-256 of the embedder's ONNX file, 64 hexadecimal digits.
    preprocessing
        Its version, alignment template, size, channel order, mean, scale and flip.
    n
        Numbers of an embedding.
    axes
        Leading axes of faces that embeddings are projected on: numbers of what is lifted and
        compared. ``n`` where nothing is projected.
    strategy, m
        Lifting strategy and subspace dimension of stored templates.
    decoy_source_id
        SHA-256 of the canonical content of the decoy source, reduced to the axes.
    rotation_version
        Version of the derivation that turns stored templates.
    """

    what: ClassVar[str] = "the binding"

    embedder_sha256: Sha256
    preprocessing: Mapping[str, Json]
    n: Annotated[int, Field(ge=2, le=MAX_N)]
    axes: Annotated[int, Field(ge=2, le=MAX_N)]
    strategy: Strategy
    m: Annotated[int, Field(ge=1, le=MAX_M)]
    decoy_source_id: Sha256
    rotation_version: str

    def __post_init__(self) -> None:
        if not self.m < self.axes <= self.n:
            raise ContractError(f"m < axes <= n is needed: {self.m}, {self.axes}, {self.n}")
        if self.rotation_version != ROTATION_VERSION:
            raise ContractError(
                f"this program turns templates by {ROTATION_VERSION!r} only: calibrate and enroll "
                "anew"
            )
        object.__setattr__(self, "preprocessing", plain_json(self.preprocessing))

    @cached_property
    def contract_id(self) -> str:
        """SHA-256 of the canonical JSON, 64 hexadecimal digits; computed once."""
        return digest(self.to_json())

    @property
    def embedding_id(self) -> str:
        """:func:`embedding_id` of the contract's embedder and preprocessing."""
        return embedding_id(embedder_sha256=self.embedder_sha256, preprocessing=self.preprocessing)

    def require_embedder(
        self, *, embedder_sha256: str, preprocessing: Mapping[str, object], n: int
    ) -> None:
        """Refuse a pack whose embeddings this contract does not describe, naming both sides."""
        if n != self.n:
            raise ContractMismatch(
                f"the contract is for embeddings of {self.n} numbers, the pack gives {n}; "
                "use the pack that the contract was calibrated with"
            )
        if embedder_sha256 != self.embedder_sha256:
            raise ContractMismatch(
                f"the contract is bound to embedder {self.embedder_sha256[:16]}…, the pack's is "
                f"{embedder_sha256[:16]}…; use the pack that the contract was calibrated with"
            )
        of_pack = {name: plain_json(value) for name, value in preprocessing.items()}
        if of_pack != self.preprocessing:
            keys = sorted(of_pack.keys() | self.preprocessing.keys())
            differing = [key for key in keys if of_pack.get(key) != self.preprocessing.get(key)]
            sides = "; ".join(
                f"{key}: contract {self.preprocessing.get(key)}, pack {of_pack.get(key)}"
                for key in differing
            )
            raise ContractMismatch(
                f"the pack preprocesses otherwise than the contract: {sides}; use the pack and "
                "the settings that it was calibrated with, or, after an upgrade that changed the "
                "version, build the decoys, calibrate and enroll anew"
            )

    def require_source(self, source: DecoySource) -> None:
        """Refuse a decoy source other than the contract's, or of another descriptor space.

        A ``made_with`` of None, as of a source made in code, is not held against the binding.
        """
        if source.made_with not in (None, self.embedding_id):
            raise ContractMismatch(
                "the decoys are embeddings of another model or another preprocessing (made with "
                f"{source.made_with[:16]}…, the contract's is {self.embedding_id[:16]}…), and hide "
                "nothing; build the decoys with this pack and the same --flip, and calibrate "
                "with them"
            )
        if source.source_id != self.decoy_source_id:
            raise ContractMismatch(
                f"the contract is bound to the decoy source {self.decoy_source_id[:16]}…, this one "
                f"is {source.source_id[:16]}…; use the file that the contract was calibrated with"
            )

    def require_contract(self, contract_id: str, *, what: str) -> None:
        """Refuse a template of another contract, naming both sides."""
        if contract_id != self.contract_id:
            raise ContractMismatch(
                f"{what} belongs to the contract {contract_id[:16]}…, the service runs "
                f"{self.contract_id[:16]}…; enroll or lift again under the service's contract"
            )
