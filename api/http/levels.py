"""Which security level decides a verification: what is asked, and what may be asked."""

from api.http.errors import ApiError, StartError
from templates.contract.document import Contract, Level


class Levels:
    """The levels of one contract, and the lowest that the deployment decides at.

    A level is lower than another one if its false match rate is larger: its target, or where it has
    none the upper bound of what was seen.

    Parameters
    ----------
    contract
        Whose calibrations have the levels.
    lowest
        Name of the deployment's lowest level; None for any.

    Raises
    ------
    StartError
        The contract has no such level.
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
        """Return the level to decide at.

        Where none is asked, that is the contract's default, or the lowest allowed if the default
        is below it. A level that the contract does not have is returned as it is: the decision
        refuses it.

        Parameters
        ----------
        asked
            By the client; None for the default.
        lowest_of_key
            Name of the lowest level of the API key; None for any.

        Raises
        ------
        ApiError
            ``forbidden``: what is asked is below the lowest allowed, or the contract does not have
            the key's lowest.
        """
        if lowest_of_key is not None and lowest_of_key not in self._rates:
            raise ApiError(
                "forbidden",
                f"this API key verifies at {lowest_of_key} or above, and the contract has no such "
                "level: ask the operator for another key",
                {"lowest_level": lowest_of_key},
            )
        allowed = [name for name in (self._lowest, lowest_of_key) if name is not None]
        lowest = min(allowed, key=self._rates.__getitem__, default=None)
        level = asked or self._default
        if lowest is None or self._rates.get(level, 0.0) <= self._rates[lowest]:
            return level
        if asked is None:
            return lowest
        raise ApiError(
            "forbidden",
            f"{asked} is below {lowest}, the lowest security level allowed here: ask for {lowest} "
            "or a stricter one, or for none",
            {"lowest_level": lowest},
        )

    def require_known(self, level: str) -> None:
        """Refuse a level that the contract does not have, before anything is decided at it.

        Raises
        ------
        ApiError
            ``uncalibrated``.
        """
        if level not in self._rates:
            raise ApiError(
                "uncalibrated",
                "the contract has no such level: it has " + ", ".join(self._rates),
            )

    def allowed(self, *, lowest_of_key: str | None = None) -> list[str]:
        """Return the levels that may be asked for, in the contract's order."""
        return [name for name in self._rates if self._may_ask(name, lowest_of_key)]

    def _may_ask(self, name: str, lowest_of_key: str | None) -> bool:
        try:
            self.in_force(name, lowest_of_key=lowest_of_key)
        except ApiError:
            return False
        return True


def _rate(level: Level) -> float:
    return level.fmr.ci_high if level.target_fmr is None else level.target_fmr
