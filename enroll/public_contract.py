"""What a client that lifts on its own machine knows of a contract, and the lift that it describes.

No secret of the service is needed: `GET /v1/contract`, `GET /v1/contract/generator` and the model
pack are enough.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import Binding
from templates.decoys import DecoyGenerator
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.agreement import mean_embedding
from templates.space.lifting import lift


class PublicContract:
    """What a client may know of a contract.

    Parameters
    ----------
    document
        The JSON object of ``GET /v1/contract``, or of the contract file.

    Raises
    ------
    ContractError
        It is no contract, or contradicts itself.
    """

    def __init__(self, document: Mapping[str, object]) -> None:
        self.binding = Binding.from_json(document.get("binding"))
        if document.get("contract_id") != self.binding.contract_id:
            raise ContractError("the contract_id is not the hash of the binding")
        self._document = document
        entries = document.get("calibrations")
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ContractError("the contract lacks its calibrations")
        self.probe_dimensions: list[int] = sorted(
            {
                int(entry["probe_m"])
                for entry in entries
                if entry.get("mode") == "s2s" and isinstance(entry.get("probe_m"), int)
            }
        )

    @property
    def contract_id(self) -> str:
        """What its templates name, 64 hexadecimal digits."""
        return self.binding.contract_id

    def consistency(self, *, probe: bool) -> float:
        """Return the least agreement of the photos of one probe, or of one enrollment."""
        name = "probe_consistency" if probe else "photo_consistency"
        consistency = self._document.get(name)
        if not isinstance(consistency, int | float) or not -1 <= consistency <= 1:
            raise ContractError(f"the contract lacks its {name}")
        return float(consistency)

    def probe_dimension(self, dim: int | None) -> int:
        """Return the dimension of a probe: `dim`, or the largest that the contract takes."""
        if not self.probe_dimensions:
            raise ContractError(
                "the contract takes no lifted probes; calibrate it with --probe-dims"
            )
        if dim not in (None, *self.probe_dimensions):
            known = ", ".join(map(str, self.probe_dimensions))
            raise ContractError(f"the contract takes lifted probes of dimension {known}, not {dim}")
        return dim or self.probe_dimensions[-1]

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
        self.binding.require_source(source_id=source.source_id, made_with=source.made_with)
        return source

    def lift(
        self,
        embeddings: NDArray[np.float32],
        decoys: DecoyGenerator,
        *,
        m: int,
        probe: bool,
    ) -> bytes:
        """Average unit embeddings (N, n) of one person, lift the mean, and encode the template.

        Parameters
        ----------
        decoys
            What :meth:`require_decoys` returned.
        m
            Dimension: the binding's, or one of :meth:`probe_dimension`.
        """
        mean = mean_embedding(embeddings, consistency=self.consistency(probe=probe))
        stream = Keystream.fresh()
        batch = lift(
            decoys.project(mean[None]),
            strategy=self.binding.strategy,
            m=m,
            source=decoys,
            stream=stream,
        )
        return wire.encode(batch[0], contract_id=self.contract_id)
