"""What every verification must meet: a security level that is allowed, and the liveness policy."""

from api.http.errors import ApiError, StartError
from api.settings import LivenessPolicy
from models.pack import ModelPack
from templates.contract.document import Contract, Level
from templates.errors import Uncalibrated


class Levels:
    """The levels of one contract, and the lowest that the deployment decides at.

    A level is lower than another one if its false match rate is larger: its target, or where it has
    none the upper bound of what was seen. A lowest one that the contract lacks is a `StartError`.
    """

    def __init__(self, contract: Contract, *, lowest: str | None) -> None:
        self._default = contract.default_level
        self._rates: dict[str, float] = {}
        for calibration in contract.calibrations:
            for level in calibration.levels:
                # Two calibrations may differ in what they saw: the larger rate is the safe one.
                self._rates[level.name] = max(_rate(level), self._rates.get(level.name, 0.0))
        if lowest is not None and lowest not in self._rates:
            raise StartError(
                f"setting lowest_level: the contract has no level {lowest}; it has "
                + ", ".join(self._rates)
            )
        self._lowest = lowest

    def in_force(self, asked: str | None, *, lowest_of_key: str | None = None) -> str:
        """Return the level to decide at: the default, or the lowest allowed if that is stricter.

        A level that was `asked` for and is below the lowest allowed is ``forbidden``.
        """
        level = asked or self._default
        if level not in self._rates:
            raise Uncalibrated("the contract has no such level: it has " + ", ".join(self._rates))
        if lowest_of_key is not None and lowest_of_key not in self._rates:
            raise ApiError(
                "forbidden",
                f"this API key verifies at {lowest_of_key} or above, and the contract has no such "
                "level: ask the operator for another key",
                {"lowest_level": lowest_of_key},
            )
        bounds = [name for name in (self._lowest, lowest_of_key, level) if name is not None]
        lowest = min(bounds, key=self._rates.__getitem__)
        if self._rates[level] <= self._rates[lowest]:
            return level
        if asked is None:
            return lowest
        raise ApiError(
            "forbidden",
            f"{asked} is below {lowest}, the lowest security level allowed here: ask for {lowest} "
            "or a stricter one, or for none",
            {"lowest_level": lowest},
        )

    def allowed(self, *, lowest_of_key: str | None = None) -> list[str]:
        """Return the levels that may be asked for, in the contract's order."""
        bounds = [name for name in (self._lowest, lowest_of_key) if name is not None]
        most = min((self._rates.get(name, -1.0) for name in bounds), default=1.0)
        return [name for name, rate in self._rates.items() if rate <= most]


def _rate(level: Level) -> float:
    return level.fmr.ci_high if level.target_fmr is None else level.target_fmr


class LivenessRules:
    """The liveness policy of a deployment, which binds every caller.

    A policy that asks for what contract and pack cannot tell is a `StartError`.
    """

    def __init__(self, policy: LivenessPolicy, contract: Contract, pack: ModelPack | None) -> None:
        self.policy = policy
        self._has_detector = pack is not None and pack.info.detector is not None
        lacking = None
        if policy.active and not self._has_detector:
            lacking = _NO_DETECTOR
        elif policy.passive:
            lacking = _lacking_passive(contract, pack)
        if lacking is not None:
            raise StartError(f"setting liveness asks for {policy}: {lacking}")

    def require_challenges(self) -> None:
        """Refuse a challenge that the service could not hold frames against."""
        if not self._has_detector:
            raise ApiError("not_found", _NO_DETECTOR)

    def require(self, *, photos: bool, challenge: bool) -> None:
        """Refuse a probe that cannot show what the policy asks for, as ``forbidden``."""
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


_NO_DETECTOR = (
    "the service has no model pack with a detector, which a challenge needs: add a SCRFD or YuNet "
    ".onnx file to the pack's folder, or choose off"
)


def _lacking_passive(contract: Contract, pack: ModelPack | None) -> str | None:
    graphs = None if pack is None else pack.liveness
    if graphs is None:
        return (
            "the model pack has no liveness graph, which passive needs: add one to its folder "
            "(docs/liveness.md), or choose active or off"
        )
    if contract.liveness is None:
        return (
            "the contract has no liveness threshold, which passive needs: run `veilface "
            "calibrate --liveness`, or choose active or off"
        )
    try:
        contract.liveness.require_graphs(graphs.graphs)
    except Uncalibrated as error:
        return str(error)
    return None
