"""The sealed template of nobody that a decision on an unknown subject opens and compares with."""

import secrets

from enroll.enroller import WIRE_DTYPE
from templates.contract import wire
from templates.contract.nobody import Nobody
from templates.errors import SealError
from templates.keys.randomness import Keystream
from templates.keys.sealing import MasterKeyring
from templates.store.envelope import Envelope, Owner, close_envelope, open_envelope
from verify import StandIn


class SealedStandIn:
    """A template of nobody, sealed as real ones are, so that opening it costs the same."""

    def __init__(self, nobody: Nobody, keyring: MasterKeyring, *, contract_id: str) -> None:
        stream = Keystream(secrets.token_bytes(32))
        lifted = nobody.lift(stream)
        self._wire = wire.encode(lifted, contract_id=contract_id, dtype=WIRE_DTYPE)
        self._keyring = keyring
        self._owner = Owner("", "stand-in", "", contract_id, "", 0)
        self._sealed = self._seal()

    def open(self) -> StandIn:
        """Decrypt it."""
        try:
            return StandIn(open_envelope(self._sealed, self._owner, self._keyring))
        except SealError:
            # The master key that it was sealed with was retired since.
            self._sealed = self._seal()
            return StandIn(open_envelope(self._sealed, self._owner, self._keyring))

    def _seal(self) -> Envelope:
        return close_envelope(self._wire, self._owner, self._keyring)

    def __repr__(self) -> str:
        return "SealedStandIn()"
