"""What every part of the store works with."""

from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import AuditLog
from templates.store.database import Database
from templates.store.identifiers import Clock
from templates.store.receipts import ReceiptSigner
from templates.store.secrets import Secrets


class StoreContext:
    """The database of a deployment, its keys, its audit log and its clock."""

    def __init__(self, database: Database, keyring: MasterKeyring, clock: Clock) -> None:
        self.database = database
        self.keyring = keyring
        self.clock = clock
        self.secrets = Secrets(database, keyring)
        self.signer = ReceiptSigner(self.secrets)
        self.audit_log = AuditLog(database, self.secrets, clock)
