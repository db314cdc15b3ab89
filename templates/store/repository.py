"""The store of a deployment, opened from a URL and a keyring."""

from templates.sealing import MasterKeyring
from templates.store import deployment, migrate
from templates.store.database import Database
from templates.store.deployment import Secrets
from templates.store.identifiers import Clock, utc_now
from templates.store.receipts import ReceiptSigner
from templates.store.subjects import Subjects
from templates.store.tenants import Tenants


class TemplateStore(Subjects):
    """Everything that Veilface keeps, in SQLite or PostgreSQL.

    Subjects are reached directly (:meth:`put`, :meth:`get`, :meth:`list`, :meth:`erase`), the rest
    by its own part: `tenants`, `api_keys`, `idempotency`, `secrets`.
    """

    def __init__(
        self,
        url: str,
        keyring: MasterKeyring,
        *,
        pool_size: int = 5,
        max_overflow: int = 10,
        timeout: float = 10.0,
        clock: Clock = utc_now,
    ) -> None:
        database = Database(url, pool_size=pool_size, max_overflow=max_overflow, timeout=timeout)
        self.secrets = Secrets(database, keyring, clock)
        signer = ReceiptSigner(self.secrets)
        super().__init__(database, keyring, signer, clock)
        self.tenants = Tenants(database, keyring, clock)

    def upgrade(self) -> None:
        """Bring the schema to this program's version; safe when several workers start at once."""
        migrate.upgrade(self._database)
        deployment.mark_master_key(self._database, self._keyring, self._clock)
        self.check()

    def check(self) -> None:
        """Raise, naming the remedy, unless schema and master key are the right ones."""
        migrate.check(self._database)
        deployment.check_master_key(self._database, self._keyring)

    def close(self) -> None:
        """Close the idle connections of this process."""
        self._database.close()
