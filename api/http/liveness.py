"""What a verification must pass as a sign of a living person, and whether the service can tell."""

from api.http.errors import ApiError, StartError
from api.settings import LivenessPolicy
from models.errors import PackError
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.errors import Uncalibrated


class LivenessRules:
    """The liveness policy of a deployment, which binds every caller.

    Parameters
    ----------
    policy
        What every verification must pass.
    contract, pack
        What the service checks with.

    Raises
    ------
    StartError
        The policy asks for what contract and pack cannot tell.
    """

    def __init__(self, policy: LivenessPolicy, contract: Contract, pack: ModelPack | None) -> None:
        self.policy = policy
        self._lacking_active = _lacking_active(pack)
        why = self._lacking_active if policy.active else None
        # The liveness graphs are loaded only where the policy asks for them.
        if why is None and policy.passive:
            why = _lacking_passive(contract, pack)
        if why is not None:
            raise StartError(f"setting liveness asks for {policy}: {why}")

    def require_challenges(self) -> None:
        """Refuse a challenge that the service could not hold frames against.

        Raises
        ------
        ApiError
            ``not_found``.
        """
        if self._lacking_active is not None:
            raise ApiError("not_found", self._lacking_active)

    def require(self, *, photos: bool, challenge: bool) -> None:
        """Refuse a probe that cannot show what the policy asks for.

        Parameters
        ----------
        photos
            Whether the probe is photos, or frames; embeddings and lifted probes show nothing.
        challenge
            Whether it answers a challenge.

        Raises
        ------
        ApiError
            ``forbidden``.
        """
        details = {"liveness": str(self.policy)}
        if self.policy is not LivenessPolicy.OFF and not photos:
            raise ApiError(
                "forbidden",
                "liveness is asked for here, which embeddings and lifted probes cannot show: send "
                "photos, with a challenge if the details say active or both",
                details,
            )
        if self.policy.active and not challenge:
            raise ApiError(
                "forbidden",
                "a challenge is asked for here: get one from POST /v1/challenges, and send its "
                "challenge_id with the frames as images",
                details,
            )


def _lacking_passive(contract: Contract, pack: ModelPack | None) -> str | None:
    try:
        graphs = None if pack is None else pack.liveness
    except PackError as error:
        return str(error)
    if graphs is None:
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
        contract.liveness.require_graphs(graphs.graphs)
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
