"""A probe against a stored template becomes a decision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.decoding import DEFAULT_LIMITS, ImageLimits
from models.pack import FacePolicy, ModelPack
from models.quality import DEFAULT_QUALITY, QualityLimits
from templates.contract import wire
from templates.contract.document import Calibration, Contract, Level
from templates.distances import Metric, paired_distances, similarity
from templates.errors import ContractMismatch, InvalidTemplate
from templates.space.embedding import unit_rows
from templates.space.subspace import AffineSubspace, SubspaceBatch
from verify.cohort import Probes, cohort_statistics
from verify.decision import Decision
from verify.stand_ins import StandIn


@dataclass(frozen=True)
class _Rule:
    """The calibration and level that one decision is taken by."""

    calibration: Calibration
    level: Level


class Verifier:
    """Decides for one contract and one tenant. Holds no state between calls; threads may share it.

    Every decision needs both the similarity threshold and the cohort test of its level
    (docs/method.md §6). Stored templates are rotated, the cohort is not, so the probe is turned for
    the template only.

    Parameters
    ----------
    contract
        Whose calibrations and cohort decide.
    rotation : (n, n) float64
        The tenant's orthogonal rotation.

    Raises
    ------
    ContractMismatch
        Where the rotation is of another dimension.
    """

    def __init__(self, contract: Contract, *, rotation: NDArray[np.float64]) -> None:
        n = contract.binding.n
        if rotation.shape != (n, n):
            raise ContractMismatch(
                f"the contract is for embeddings of {n} numbers, the rotation turns "
                f"{rotation.shape[0]}"
            )
        self._contract = contract
        self._rotation = rotation

    def decide_photo(
        self,
        pack: ModelPack,
        photo: bytes,
        stored: bytes | StandIn,
        *,
        level: str | None = None,
        policy: FacePolicy = FacePolicy.SINGLE,
        quality: QualityLimits | None = DEFAULT_QUALITY,
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> Decision:
        """Decide for a photo file: :meth:`embed_photo`, then :meth:`decide_embedding`."""
        embedding = self.embed_photo(pack, photo, policy=policy, quality=quality, limits=limits)
        return self.decide_embedding(embedding, stored, level=level)

    def embed_photo(
        self,
        pack: ModelPack,
        photo: bytes,
        *,
        policy: FacePolicy = FacePolicy.SINGLE,
        quality: QualityLimits | None = DEFAULT_QUALITY,
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> NDArray[np.float32]:
        """Make a probe, (n,), of the face in a photo file.

        Raises
        ------
        ContractMismatch
            Where the pack is not the contract's.
        ModelError
            Where the photo has no usable face.
        """
        info = pack.info
        self._contract.binding.require_embedder(
            embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing, n=info.n
        )
        sample = pack.embed_photo(photo, policy=policy, quality=quality, limits=limits)
        return sample.embedding

    def decide_embedding(
        self,
        embedding: NDArray[np.floating],
        stored: bytes | StandIn,
        *,
        level: str | None = None,
        metric: Metric | None = None,
    ) -> Decision:
        """Decide for a unit-norm embedding, (n,).

        Parameters
        ----------
        stored
            Wire bytes of the subject's template; a :class:`StandIn` where the subject does not
            exist. The same work is then done on it, and the answer is a rejection.
        level
            Name of a level; the contract's default where None.
        metric
            The contract's first p-to-s calibration decides where None.

        Raises
        ------
        InvalidEmbedding
            Where the probe is not a finite unit vector of n numbers.
        Uncalibrated
            Where the contract has no such level or metric.
        ContractMismatch, InvalidTemplate
            Where the stored bytes are not a template of this contract.
        """
        calibration = self._contract.calibration("p2s", metric)
        rule = _Rule(calibration, calibration.level(level or self._contract.default_level))
        probe = unit_rows(embedding, n=self._contract.binding.n, most=1)
        turned = (probe.astype(np.float64) @ self._rotation.T).astype(np.float32)
        return self._decide(rule, probe, turned, stored)

    def decide_template(
        self,
        probe: bytes,
        stored: bytes | StandIn,
        *,
        level: str | None = None,
        metric: Metric | None = None,
    ) -> Decision:
        """Decide for a probe that the client lifted, in the wire format, un-rotated.

        Parameters as in ``decide_embedding``.

        Raises
        ------
        InvalidTemplate
            Where the probe's bytes break the format, or its foot point cannot be an honest lift's.
        Uncalibrated
            Where the contract has no calibration for the probe's dimension.
        ContractMismatch
            Where the probe belongs to another contract.
        """
        binding = self._contract.binding
        received = wire.decode(probe)
        binding.require_contract(received.contract_id, what="the lifted probe")
        subspace = received.subspace
        if subspace.n != binding.n:
            raise InvalidTemplate(f"a lifted probe must have n = {binding.n}, not {subspace.n}")
        calibration = self._contract.calibration("s2s", metric, subspace.m)
        rule = _Rule(calibration, calibration.level(level or self._contract.default_level))
        self._require_honest_foot(subspace, calibration)
        turned = SubspaceBatch.of([subspace.rotated(self._rotation)])
        return self._decide(rule, SubspaceBatch.of([subspace]), turned, stored)

    def _require_honest_foot(self, subspace: AffineSubspace, calibration: Calibration) -> None:
        if calibration.foot_point_norm is None:
            raise InvalidTemplate("this calibration takes no lifted probes")
        low, high = calibration.foot_point_norm
        if not low <= subspace.foot_norm <= high:
            raise InvalidTemplate(
                "the probe's foot point is outside the range that the calibration recorded: "
                "lift a unit-norm embedding with the contract's decoys"
            )

    def _template(self, stored: bytes | StandIn) -> SubspaceBatch:
        binding = self._contract.binding
        received = wire.decode(stored.wire if isinstance(stored, StandIn) else stored)
        binding.require_contract(received.contract_id, what="the stored template")
        subspace = received.subspace
        if (subspace.n, subspace.m) != (binding.n, binding.m):
            raise InvalidTemplate("the stored template has dimensions other than the contract's")
        if isinstance(stored, StandIn) and stored.lifted is not None:
            subspace = stored.lifted
        return SubspaceBatch.of([subspace])

    def _decide(
        self, rule: _Rule, probe: Probes, turned: Probes, stored: bytes | StandIn
    ) -> Decision:
        calibration, level = rule.calibration, rule.level
        unknown = isinstance(stored, StandIn)
        # A stand-in is not in the tenant's rotation, so neither is the probe: turning both leaves
        # their distance as it is. The turned probe was computed in either case.
        distances = paired_distances(
            probe if unknown else turned,
            self._template(stored),
            metric=calibration.metric,
            steps=calibration.steps,
        )
        distance = float(distances[0])
        score = float(np.asarray(similarity(distances), dtype=np.float64)[0])
        means, spreads = cohort_statistics(
            probe, self._contract.cohort, metric=calibration.metric, steps=calibration.steps
        )
        cohort_score = (score - float(means[0])) / float(spreads[0])
        # Both tests are evaluated, and NaN fails either, so no input is accepted by an exception.
        similar = score >= level.similarity_threshold
        singular = cohort_score >= level.cohort_threshold
        # The cohort test of a member of the cohort is no independent one: never accept by it.
        accepted = bool(similar and singular and not unknown)
        return Decision(
            accepted=accepted,
            reason="match" if accepted else "no_match",
            level=level.name,
            fmr=level.fmr.value if level.target_fmr is None else level.target_fmr,
            contract_id=self._contract.contract_id,
            calibration_id=calibration.calibration_id,
            similarity=score,
            distance=distance,
            cohort_score=cohort_score,
        )
