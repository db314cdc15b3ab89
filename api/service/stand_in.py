"""The sealed template of nobody that a decision on an unknown subject opens and compares with."""

import secrets

from enroll.enroller import WIRE_DTYPE
from templates.contract import wire
from templates.contract.nobody import Nobody
from templates.errors import SealError
from templates.keys.randomness import Keystream
from templates.keys.sealing import MasterKeyring
from templates.store.envelope import open_template, seal_template
from templates.store.schema import SubjectRow
from verify import StandIn


class SealedStandIn:
    """A template of nobody, sealed as real ones are, so that opening it costs the same."""

    def __init__(self, nobody: Nobody, keyring: MasterKeyring, *, contract_id: str) -> None:
        stream = Keystream(secrets.token_bytes(32))
        lifted = nobody.lift(stream)
        self._wire = wire.encode(lifted, contract_id=contract_id, dtype=WIRE_DTYPE)
        self._keyring = keyring
        self._subject = SubjectRow(id="stand-in", tenant_id="", subject_id="", template_id="")
        self._subject.contract_id, self._subject.rotation_epoch = contract_id, 0
        seal_template(self._subject, self._wire, keyring)

    def open(self) -> StandIn:
        """Decrypt it."""
        try:
            return StandIn(open_template(self._subject, self._keyring))
        except SealError:
            # The master key that it was sealed with was retired since.
            seal_template(self._subject, self._wire, self._keyring)
            return StandIn(open_template(self._subject, self._keyring))

    def __repr__(self) -> str:
        return "SealedStandIn()"
