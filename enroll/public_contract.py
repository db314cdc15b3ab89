"""What a client that lifts on its own machine knows of a contract, and the lift that it describes.

No secret of the service is needed: `GET /v1/contract`, `GET /v1/contract/generator` and the model
pack are enough.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PlainValidator, ValidationError

from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import Binding
from templates.contract.parsing import Cosine, refused
from templates.decoys import DecoyGenerator
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.agreement import mean_embedding
from templates.space.lifting import lift


class ProbeCalibration(BaseModel):
    """A kind of probe that the contract is calibrated for."""

    mode: str
    probe_m: int


class PublicContract(BaseModel):
    """What a client may know of a contract: its binding, its limits, and the probes it takes."""

    contract_id: str
    binding: Annotated[Binding, PlainValidator(Binding.from_json)]
    photo_consistency: Cosine
    probe_consistency: Cosine
    calibrations: list[ProbeCalibration]

    @classmethod
    def read(cls, document: object) -> Self:
        """Read the JSON object of ``GET /v1/contract``, or of the contract file.

        Raises
        ------
        ContractError
            It is no contract, or contradicts itself.
        """
        if not isinstance(document, Mapping):
            raise ContractError("the contract is not a JSON object")
        try:
            contract = cls.model_validate(document)
        except ValidationError as error:
            raise refused("the contract", error) from None
        if contract.contract_id != contract.binding.contract_id:
            raise ContractError("the contract_id is not the hash of the binding")
        return contract

    def probe_dimension(self, dim: int | None) -> int:
        """Return the dimension of a probe: `dim`, or the largest that the contract takes."""
        known = sorted({entry.probe_m for entry in self.calibrations if entry.mode == "s2s"})
        if not known:
            raise ContractError(
                "the contract takes no lifted probes; calibrate it with --probe-dims"
            )
        if dim not in (None, *known):
            listed = ", ".join(map(str, known))
            raise ContractError(
                f"the contract takes lifted probes of dimension {listed}, not {dim}"
            )
        return dim or known[-1]

    def load_pack(self, folder: Path) -> ModelPack:
        """Load the contract's model pack, and refuse another."""
        pack = ModelPack.load(folder, threads=1, flip=bool(self.binding.preprocessing.get("flip")))
        info = pack.info
        self.binding.require_embedder(
            embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing, n=info.n
        )
        return pack

    def require_decoys(self, generator: DecoyGenerator) -> DecoyGenerator:
        """Reduce a generator to the contract's axes; one that is not the contract's is refused."""
        source = generator.reduced(self.binding.axes)
        self.binding.require_source(source)
        return source

    def lift(
        self, embeddings: NDArray[np.float32], decoys: DecoyGenerator, *, m: int, probe: bool
    ) -> bytes:
        """Average unit embeddings (N, n) of one person, lift the mean, and encode the template.

        ``decoys`` is what :meth:`require_decoys` returned; ``m`` is the binding's, or one of
        :meth:`probe_dimension`.
        """
        consistency = self.probe_consistency if probe else self.photo_consistency
        mean = mean_embedding(embeddings, consistency=consistency)
        batch = lift(
            decoys.project(mean[None]),
            strategy=self.binding.strategy,
            m=m,
            source=decoys,
            stream=Keystream.fresh(),
        )
        return wire.encode(batch[0], contract_id=self.contract_id)
