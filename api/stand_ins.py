"""Templates of nobody, kept sealed as the store keeps real ones: opening one costs the same."""

import hashlib
import hmac

from enroll.enroller import WIRE_DTYPE
from templates import wire
from templates.contract import Contract
from templates.errors import SealError
from templates.sealing import MasterKeyring, encode_parts
from templates.store.envelope import Envelope, Owner, close_envelope, open_envelope
from verify import StandIn, pick_stand_in

STAND_IN_SECRET = "stand-ins"  # noqa: S105 - a name, not a secret


class StandIns:
    """Gives every unknown subject of every tenant a template of nobody, always the same one.

    Parameters
    ----------
    contract
        Whose cohort they are.
    keyring
        What seals them.
    key
        32 secret bytes, the same in all processes: without them nobody can tell which template an
        unknown subject gets.
    """

    def __init__(self, contract: Contract, keyring: MasterKeyring, *, key: bytes) -> None:
        self._contract = contract
        self._keyring = keyring
        self._key = key
        self._nobody = Owner("", "stand-in", "", contract.contract_id, "", 0)
        self._sealed = self._seal()

    def open(self, tenant: str, subject: str) -> StandIn:
        """Decrypt the stand-in of a subject: the work that a stored template would have cost."""
        digest = hmac.digest(self._key, encode_parts(tenant, subject), hashlib.sha256)
        index, mirror = pick_stand_in(self._contract.cohort, digest)
        try:
            plain = open_envelope(self._sealed[index], self._nobody, self._keyring)
        except SealError:
            # The master key that they were sealed with was retired since.
            self._sealed = self._seal()
            plain = open_envelope(self._sealed[index], self._nobody, self._keyring)
        return StandIn(plain, mirror)

    def _seal(self) -> list[Envelope]:
        contract_id = self._contract.contract_id
        return [
            close_envelope(
                wire.encode(member, contract_id=contract_id, dtype=WIRE_DTYPE),
                self._nobody,
                self._keyring,
            )
            for member in self._contract.cohort
        ]

    def __repr__(self) -> str:
        return "StandIns()"
