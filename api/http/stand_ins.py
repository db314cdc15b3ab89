"""Stand-ins of unknown subjects: what opening a real template costs, and what is told of them."""

import hashlib
import hmac
import secrets
from collections.abc import Callable

from enroll.enroller import WIRE_DTYPE
from templates.contract import wire
from templates.contract.nobody import Nobody
from templates.errors import SealError
from templates.keys.sealing import MasterKeyring, encode_parts
from templates.space.subspace import AffineSubspace
from templates.store.envelope import Envelope, Owner, close_envelope, open_envelope
from verify import StandIn, lift_stand_in


class StandIns:
    """Gives every unknown subject of every tenant a template of nobody, always the same one.

    Parameters
    ----------
    nobody
        What they are lifted from.
    contract_id
        Of the contract in force.
    keyring
        What seals the template that is opened for all of them, as the store keeps real ones.
    key
        Tells 32 secret bytes, the same in all processes: without them nobody can tell which
        template an unknown subject gets. Asked each time, as a renewal changes them.
    """

    def __init__(
        self,
        nobody: Nobody,
        keyring: MasterKeyring,
        *,
        contract_id: str,
        key: Callable[[], bytes],
    ) -> None:
        self._nobody = nobody
        self._contract_id = contract_id
        self._keyring = keyring
        self._key = key
        self._owner = Owner("", "stand-in", "", contract_id, "", 0)
        self._sealed = self._seal()

    def lift(self, tenant: str, subject: str) -> AffineSubspace:
        """Lift the template that an unknown subject's distances are told of."""
        digest = hmac.digest(self._key(), encode_parts(tenant, subject), hashlib.sha256)
        return lift_stand_in(self._nobody, digest)

    def open(self, lifted: AffineSubspace | None) -> StandIn:
        """Decrypt a template of nobody: the work that a stored one would have cost."""
        try:
            plain = open_envelope(self._sealed, self._owner, self._keyring)
        except SealError:
            # The master key that it was sealed with was retired since.
            self._sealed = self._seal()
            plain = open_envelope(self._sealed, self._owner, self._keyring)
        return StandIn(plain, lifted)

    def _seal(self) -> Envelope:
        lifted = lift_stand_in(self._nobody, secrets.token_bytes(32))
        data = wire.encode(lifted, contract_id=self._contract_id, dtype=WIRE_DTYPE)
        return close_envelope(data, self._owner, self._keyring)

    def __repr__(self) -> str:
        return "StandIns()"
