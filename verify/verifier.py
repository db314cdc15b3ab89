"""A probe against a stored template becomes a decision."""

import math
import secrets
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from templates.contract import wire
from templates.contract.document import Calibration, Contract, Level
from templates.decoys import DecoySource
from templates.distances import paired_distances, similarity
from templates.errors import InvalidTemplate
from templates.keys.randomness import KEY_BYTES
from templates.keys.rotation import HolderKey, TenantRotation, holder_rotation
from templates.space.embedding import unit_rows
from templates.space.subspace import SubspaceBatch, Turn
from verify.cohort import Probes, expected_similarity
from verify.decision import Decision, StandIn

_NO_SALT = "0" * 32


class OpenedTemplate(Protocol):
    """A stored template, decrypted; a :class:`StandIn` where the subject does not exist."""

    @property
    def wire(self) -> bytes:
        """Its wire bytes."""
        ...

    @property
    def template_id(self) -> str:
        """The id that its rotation is derived from."""
        ...

    @property
    def holder_salt(self) -> str | None:
        """What its holder's rotation is derived from, with their key; None if it needs no key."""
        ...


class Verifier:
    """Decides for one contract and one tenant. Holds no state between calls; threads may share it.

    A probe is accepted where its score reaches the level's threshold (docs/method.md "Scores").
    Each stored template is in a rotation of its own, templates of nobody are in none, so the probe
    is turned for the stored one only. The holder's rotation is derived and applied for every probe,
    whether a key was sent, or is needed, or not: the time tells neither.

    Parameters
    ----------
    source
        The contract's decoys, reduced to its axes. ContractMismatch where they are others.
    rotation
        What gives each template of the tenant its rotation.
    """

    def __init__(
        self, contract: Contract, source: DecoySource, *, rotation: TenantRotation
    ) -> None:
        self._contract = contract
        self._source = source
        self._nobody = contract.nobody(source)
        self._rotation = rotation
        self._nobodys_key = secrets.token_bytes(KEY_BYTES)

    def decide_embedding(
        self,
        embedding: NDArray[np.floating],
        stored: OpenedTemplate,
        *,
        holder_key: HolderKey | None = None,
        level: str | None = None,
        photos: int = 1,
    ) -> Decision:
        """Decide for a unit-norm embedding, (n,), the normalised mean of so many photos.

        Parameters
        ----------
        stored
            The subject's template; a :class:`StandIn` where the subject does not exist. The same
            work is then done on it, and the answer is a rejection.
        holder_key
            The 32 bytes that its holder keeps. A template that needs a key accepts nobody without
            it; one that needs none ignores what is sent.

        Raises
        ------
        InvalidEmbedding
            Where the probe is not a finite unit vector of n numbers.
        Uncalibrated
            Where the contract has no such level.
        ContractMismatch, InvalidTemplate
            Where the stored bytes are not a template that this contract serves.
        """
        name = level or self._contract.default_level
        calibration = self._contract.calibration("p2s", probe_photos=photos, level=name)
        threshold = calibration.level(name)
        probe = self._source.project(unit_rows(embedding, n=self._contract.binding.n, most=1))
        template, turn = self._opened(stored, holder_key, read=wire.decode_as_stored)
        turned = turn(probe.astype(np.float64)).astype(np.float32)
        return self._decide(
            calibration, threshold, probe, turned, template, stored, has_key=holder_key is not None
        )

    def decide_template(
        self,
        probe: bytes,
        stored: OpenedTemplate,
        *,
        holder_key: HolderKey | None = None,
        level: str | None = None,
    ) -> Decision:
        """Decide for a probe that the client lifted, in the wire format, un-rotated.

        As ``decide_embedding``. InvalidTemplate also where the probe's foot point cannot be an
        honest lift's, Uncalibrated where nothing is calibrated for the probe's dimension.
        """
        binding = self._contract.binding
        received = wire.decode(probe)
        binding.require_contract(received.contract_id, what="the lifted probe")
        subspace = received.subspace
        if subspace.n != binding.axes:
            raise InvalidTemplate(
                f"a lifted probe must have {binding.axes} numbers, not {subspace.n}"
            )
        calibration = self._contract.calibration("s2s", probe_m=subspace.m)
        threshold = calibration.level(level or self._contract.default_level)
        self._require_honest_foot(subspace, calibration)
        template, turn = self._opened(stored, holder_key, read=wire.decode)
        turned = subspace.turned_by(turn)
        return self._decide(
            calibration, threshold, subspace, turned, template, stored,
            has_key=holder_key is not None,
        )  # fmt: skip

    def _require_honest_foot(self, subspace: SubspaceBatch, calibration: Calibration) -> None:
        if calibration.foot_point_norm is None:
            raise InvalidTemplate("this calibration takes no lifted probes")
        low, high = calibration.foot_point_norm
        if not low <= subspace.foot_norm <= high:
            raise InvalidTemplate(
                "the probe's foot point is outside the range that the calibration recorded: "
                "lift a unit-norm embedding with the contract's decoys"
            )

    def _opened(
        self,
        stored: OpenedTemplate,
        holder_key: HolderKey | None,
        *,
        read: Callable[[bytes], wire.WireTemplate],
    ) -> tuple[SubspaceBatch, Turn]:
        """Decode a template; returns it with what probes are turned by, a stand-in's too."""
        binding = self._contract.binding
        received = read(stored.wire)
        binding.require_contract(received.contract_id, what="the stored template")
        subspace = received.subspace
        if (subspace.n, subspace.m) != (binding.axes, binding.m):
            raise InvalidTemplate("the stored template has dimensions other than the contract's")
        by_tenant = self._rotation.of(stored.template_id)
        by_holder = holder_rotation(
            holder_key or self._nobodys_key, stored.holder_salt or _NO_SALT, binding.axes
        )
        needs_key = stored.holder_salt is not None

        def turn(points: NDArray[np.float64]) -> NDArray[np.float64]:
            turned = by_holder.turned(points)
            return by_tenant.turned(turned if needs_key else points)

        return subspace, turn

    def _decide(
        self,
        calibration: Calibration,
        level: Level,
        probe: Probes,
        turned: Probes,
        template: SubspaceBatch,
        stored: OpenedTemplate,
        *,
        has_key: bool,
    ) -> Decision:
        unknown = isinstance(stored, StandIn)
        distances = paired_distances(
            turned,
            template,
            metric=calibration.metric,
            steps=calibration.steps,
            as_stored=not isinstance(probe, SubspaceBatch),
        )
        distance = float(distances[0])
        close = float(np.asarray(similarity(distances), dtype=np.float64)[0])
        means, spreads = expected_similarity(
            probe, self._nobody, metric=calibration.metric, steps=calibration.steps
        )
        mean, spread = float(means[0]), float(spreads[0])
        score = (close - mean) / spread
        # The similarity that the threshold asks of this probe, as a distance again.
        least = mean + level.threshold * spread
        # NaN reaches no threshold, so no input is accepted by an exception. A stand-in never is,
        # and neither is a probe without the key that its template needs, not even by chance.
        could_match = not unknown and (has_key or stored.holder_salt is None)
        accepted = bool(score >= level.threshold and could_match)
        return Decision(
            accepted=accepted,
            reason="match" if accepted else "no_match",
            level=level.name,
            fmr=level.stated_fmr,
            contract_id=self._contract.contract_id,
            calibration_id=calibration.calibration_id,
            similarity=close,
            distance=distance,
            score=score,
            distance_threshold=math.sqrt(max(0.0, 2 * (1 - least))),
        )
