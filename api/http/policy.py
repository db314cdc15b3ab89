"""What every verification must meet: a security level that is allowed, and the liveness policy."""

from api.http.errors import ApiError, StartError
from api.settings import LivenessPolicy
from models.errors import PackError
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

    A policy that asks for what contract and pack cannot tell is a `StartError`. The liveness graphs
    are loaded only where the policy asks.
    """

    def __init__(self, policy: LivenessPolicy, contract: Contract, pack: ModelPack | None) -> None:
        self.policy = policy
        self._has_detector = pack is not None and pack.info.detector is not None
        try:
            if policy.active and not self._has_detector:
                raise PackError(_NO_DETECTOR)
            if policy.passive:
                _require_passive(contract, pack)
        except (PackError, Uncalibrated) as error:
            raise StartError(f"setting liveness asks for {policy}: {error}") from None

    def require_challenges(self) -> None:
        """Refuse a challenge that the service could not hold frames against."""
        if not self._has_detector:
            raise ApiError("not_found", _NO_DETECTOR)

    def require(self, *, photos: bool, challenge: bool) -> None:
        """Refuse a probe that cannot show what the policy asks for, as ``forbidden``."""
        if (self.policy is LivenessPolicy.OFF or photos) and (challenge or not self.policy.active):
            return
        raise ApiError(
            "forbidden",
            f"liveness ({self.policy}) is asked for here, which embeddings and lifted probes cannot"
            " show: send photos; for active and both they are the frames that answer a challenge "
            "(POST /v1/challenges), sent with its challenge_id",
            {"liveness": str(self.policy)},
        )


_NO_DETECTOR = (
    "the service has no model pack with a detector, which a challenge needs: add a SCRFD or YuNet "
    ".onnx file to the pack's folder, or choose off"
)


def _require_passive(contract: Contract, pack: ModelPack | None) -> None:
    if pack is None or pack.liveness is None:
        raise PackError(
            "the model pack has no liveness graph: add one to its folder (docs/liveness.md)"
        )
    if contract.liveness is None:
        raise Uncalibrated(
            "the contract has no liveness threshold: run `veilface calibrate --liveness`"
        )
    contract.liveness.require_graphs(pack.liveness.graphs)
