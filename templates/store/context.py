"""What every part of the store works with."""

from dataclasses import dataclass

from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import AuditLog
from templates.store.database import Database
from templates.store.identifiers import Clock
from templates.store.receipts import ReceiptSigner
from templates.store.secrets import Secrets


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
    def open(cls, database: Database, keyring: MasterKeyring, clock: Clock) -> "StoreContext":
        """Derive secrets, signer and audit log."""
        secrets = Secrets(database, keyring, clock)
        audit_log = AuditLog(database, secrets, clock)
        return cls(database, keyring, secrets, ReceiptSigner(secrets), audit_log, clock)
