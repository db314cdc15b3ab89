"""What every part of the store works with."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from sqlalchemy.engine import Connection

from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import AuditLog
from templates.store.database import Database
from templates.store.deployment import Secrets
from templates.store.identifiers import Clock
from templates.store.receipts import ReceiptSigner

T = TypeVar("T")


@dataclass(frozen=True)
class StoreContext:
    """The database of a deployment, its keys, its audit log and its clock."""

    database: Database
    keyring: MasterKeyring
    secrets: Secrets
    signer: ReceiptSigner
    audit_log: AuditLog
    clock: Clock

    @classmethod
    def of(cls, database: Database, keyring: MasterKeyring, clock: Clock) -> "StoreContext":
        """Derive secrets, signer and audit log."""
        secrets = Secrets(database, keyring, clock)
        audit_log = AuditLog(database, secrets, clock)
        return cls(database, keyring, secrets, ReceiptSigner(secrets), audit_log, clock)

    def read(self, work: Callable[[Connection], T]) -> T:
        """:meth:`Secrets.read`, after opening the keys that rows are authenticated with."""
        self._prepare()
        return self.secrets.read(work)

    def write(self, work: Callable[[Connection], T], *, lock: str | None = None) -> T:
        """:meth:`Secrets.write`, after opening the keys that lines and rows are written with."""
        self._prepare()
        return self.secrets.write(work, lock=lock)

    def write_alone(self, work: Callable[[Connection], T]) -> T:
        """:meth:`Secrets.write_alone`, after opening the same keys."""
        self._prepare()
        return self.secrets.write_alone(work)

    def _prepare(self) -> None:
        self.audit_log.prepare()
        self.signer.prepare()
