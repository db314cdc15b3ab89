"""The liveness of a contract: the threshold, its graphs and error rates.

It is no part of the ``contract_id``: another threshold, or other liveness graphs, leave stored
templates as they are.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from templates.contract.canonical import Json, free_object
from templates.contract.levels import SHA256_HEX, Rate
from templates.contract.parsing import JsonValue
from templates.errors import ContractError, Uncalibrated

MAX_LIVENESS_GRAPHS = 8
MAX_SPECIES = 64
SPECIES_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]{0,63}")


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

    graphs: tuple[str, ...]
    threshold: float
    bpcer: Rate
    target_bpcer: float
    apcer: Mapping[str, Rate] = field(default_factory=dict)
    calibrated_on: Mapping[str, Json] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 1 <= len(self.graphs) <= MAX_LIVENESS_GRAPHS:
            raise ContractError(f"a liveness threshold is of 1 to {MAX_LIVENESS_GRAPHS} graphs")
        if not all(SHA256_HEX.fullmatch(graph) for graph in self.graphs):
            raise ContractError("the id of a liveness graph is not a SHA-256")
        if list(self.graphs) != sorted(set(self.graphs)):
            raise ContractError("the liveness graphs are not sorted, or one is named twice")
        if not math.isfinite(self.threshold):
            raise ContractError("the liveness threshold is not a finite number")
        if not 0.0 < self.target_bpcer < 1.0:
            raise ContractError("the target BPCER must lie between 0 and 1")
        if not self.bpcer.trials:
            raise ContractError("a liveness threshold needs live photos")
        if len(self.apcer) > MAX_SPECIES or not all(map(SPECIES_NAME.fullmatch, self.apcer)):
            raise ContractError(
                f"attack species are at most {MAX_SPECIES}, with names that match "
                f"{SPECIES_NAME.pattern}"
            )
        object.__setattr__(self, "apcer", dict(sorted(self.apcer.items())))
        stated = free_object(self.calibrated_on, what="what liveness was calibrated on")
        object.__setattr__(self, "calibrated_on", stated)

    @property
    def worst_species(self) -> str | None:
        """Species with the highest APCER; None where no attack was tried."""
        return max(self.apcer, key=lambda name: self.apcer[name].value, default=None)

    def is_live(self, score: float) -> bool:
        """Whether a score reaches the threshold."""
        return score >= self.threshold

    def require_graphs(self, graphs: Sequence[str]) -> None:
        """Refuse graphs that the threshold is not of.

        Raises
        ------
        Uncalibrated
            Where the pack has others, or feeds them otherwise.
        """
        if tuple(graphs) != self.graphs:
            raise Uncalibrated(
                "the contract's liveness threshold belongs to other liveness graphs, or to another "
                "pack.toml, than the pack's: run `veilface calibrate --liveness` with this pack"
            )
