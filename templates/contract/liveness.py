"""The liveness of a contract: the threshold, its graphs and error rates.

It is no part of the ``contract_id``: another threshold, or other liveness graphs, leave stored
templates as they are.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from pydantic import Field

from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.contract.parsing import JsonValue, Sha256
from templates.errors import Uncalibrated

SPECIES_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]{0,63}")
Species = Annotated[str, Field(pattern=f"^{SPECIES_NAME.pattern}$")]


@dataclass(frozen=True)
class LivenessCalibration(JsonValue):
    """A threshold of passive presentation attack detection (ISO/IEC 30107-3).

    A photo is taken for live where its score is at or above the threshold.

    Parameters
    ----------
    graphs
        Ids of the liveness graphs, sorted: each the SHA-256 of the graph's file and of what it is
        fed (``models.liveness.LivenessGraph.graph_id``).
    threshold
        On their mean score.
    bpcer
        Share of the live photos that fall below the threshold.
    target_bpcer
        What the threshold was set for.
    apcer
        Share of the attack photos of each species that pass; empty where there were none.
    calibrated_on
        The photos: names, counts, those without a face.
    """

    what: ClassVar[str] = "the liveness calibration"

    graphs: Annotated[tuple[Sha256, ...], Field(min_length=1)]
    threshold: float
    bpcer: Rate
    target_bpcer: Annotated[float, Field(gt=0, lt=1)]
    apcer: Mapping[Species, Rate] = field(default_factory=dict)
    calibrated_on: Mapping[str, Json] = field(default_factory=dict)

    @property
    def worst_species(self) -> str | None:
        """Species with the highest APCER; None where no attack was tried."""
        return max(self.apcer, key=lambda name: self.apcer[name].value, default=None)

    def is_live(self, score: float) -> bool:
        """Whether a score reaches the threshold."""
        return score >= self.threshold

    def require_graphs(self, graphs: Sequence[str]) -> None:
        """Refuse graphs that the threshold is not of, or that the pack feeds otherwise."""
        if tuple(graphs) != self.graphs:
            raise Uncalibrated(
                "the contract's liveness threshold belongs to other liveness graphs, or to another "
                "pack.toml, than the pack's: run `veilface calibrate --liveness` with this pack"
            )
