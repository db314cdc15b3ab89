"""What a verification must pass as a sign of a living person, and whether the service can tell."""

from collections.abc import Mapping

from api.http.errors import ApiError, StartError
from models.errors import PackError
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.contract.liveness_policy import LivenessPolicy, joined
from templates.errors import Uncalibrated


class LivenessRules:
    """The liveness policies of a deployment, its contract and its levels.

    Parameters
    ----------
    contract, pack
        What the service checks with; the contract may have a policy of its own.
    deployment
        What every verification must pass by the settings.
    levels
        What those at single security levels must pass beside it.

    Raises
    ------
    StartError
        A policy asks for what contract and pack cannot tell, or is of a level that there is not.
    """

    def __init__(
        self,
        contract: Contract,
        pack: ModelPack | None,
        *,
        deployment: LivenessPolicy,
        levels: Mapping[str, LivenessPolicy],
    ) -> None:
        known = {level.name for entry in contract.calibrations for level in entry.levels}
        if unknown := sorted(set(levels) - known):
            raise StartError(
                f"setting liveness_levels: the contract has no level {unknown[0]}; it has "
                + ", ".join(sorted(known))
            )
        self._deployment = deployment_policy(deployment, contract)
        self._levels = dict(levels)
        self._lacking_active = _lacking_active(pack)
        asked = joined([self._deployment, *levels.values()])
        try:
            # The liveness graphs are loaded only where a policy asks for them.
            why = _lacking_passive(contract, pack) if asked.passive else None
        except PackError as error:
            why = str(error)
        if why is None and asked.active:
            why = self._lacking_active
        if why is not None:
            raise StartError(f"setting liveness, or the contract, asks for {asked}: {why}")

    def policy(self, level: str) -> LivenessPolicy:
        """Return what a verification at a level must pass."""
        return joined([self._deployment, self._levels.get(level)])

    def require_challenges(self) -> None:
        """Refuse a challenge that the service could not hold frames against.

        Raises
        ------
        ApiError
            ``not_found``.
        """
        if self._lacking_active is not None:
            raise ApiError("not_found", self._lacking_active)

    def require(self, level: str, *, photos: bool, challenge: bool) -> LivenessPolicy:
        """Return what is to be checked of a probe, where the probe can show it.

        Parameters
        ----------
        photos
            Whether the probe is photos, or frames; embeddings and lifted probes show nothing.
        challenge
            Whether it answers a challenge.

        Raises
        ------
        ApiError
            ``forbidden``: the policy cannot be met with such a probe.
        """
        policy = self.policy(level)
        details = {"liveness": str(policy)}
        if policy is not LivenessPolicy.OFF and not photos:
            raise ApiError(
                "forbidden",
                "liveness is asked for here, which embeddings and lifted probes cannot show: send "
                "photos, with a challenge if the details say active or both",
                details,
            )
        if policy.active and not challenge:
            raise ApiError(
                "forbidden",
                "a challenge is asked for here: get one from POST /v1/challenges, and send its "
                "challenge_id with the frames as images",
                details,
            )
        return policy


def deployment_policy(setting: LivenessPolicy, contract: Contract) -> LivenessPolicy:
    """Return what every verification must pass: what the settings or the contract ask for."""
    return joined([setting, None if contract.liveness is None else contract.liveness.policy])


def _lacking_passive(contract: Contract, pack: ModelPack | None) -> str | None:
    if pack is None or pack.liveness is None:
        return (
            "the model pack has no liveness graph, which passive needs: add one to its folder "
            "(docs/liveness.md), or choose active or off"
        )
    if contract.liveness is None:
        return (
            "the contract has no liveness threshold, which passive needs: run `veilface calibrate "
            "--liveness`, or choose active or off"
        )
    try:
        contract.liveness.require_graphs(pack.liveness.graphs)
    except Uncalibrated as error:
        return str(error)
    return None


def _lacking_active(pack: ModelPack | None) -> str | None:
    if pack is None or pack.info.detector is None:
        return (
            "the service has no model pack with a detector, which a challenge needs: add a SCRFD "
            "or YuNet .onnx file to the pack's folder, or choose off"
        )
    return None
