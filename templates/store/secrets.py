"""Secrets of the whole deployment: drawn once, wrapped by the master key, the same everywhere."""

import os
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.database import Database
from templates.store.identifiers import Clock
from templates.store.schema import SecretRow

SECRET_PURPOSE = "store-secret"  # noqa: S105 - a label, not a secret
SECRET_BYTES = 32


class SecretName(StrEnum):
    """Every secret of a deployment; each is 32 random bytes."""

    CHAIN = "audit-chain"
    PSEUDONYM = "pseudonym"
    RECEIPT = "receipt-signing"
    EXPORT = "export"
    LIFTS = "lifts"
    API_KEYS = "api-keys"


class Secrets:
    """The secrets of a deployment, opened at the first use and kept in memory."""

    def __init__(self, database: Database, keyring: MasterKeyring, clock: Clock) -> None:
        self._database = database
        self._keyring = keyring
        self._clock = clock
        self._opened: dict[str, bytes] = {}

    def get(self, name: SecretName) -> bytes:
        """Return a secret; :class:`StoreError` where the database has none of this name."""
        if name not in self._opened:
            self.load()
        if name not in self._opened:
            raise StoreError(
                f"the database has no secret {name!r}: run `veilface db upgrade` on a new "
                "database, and restore any other from a backup"
            )
        return self._opened[name]

    def load(self) -> None:
        """Read and open all secrets; :class:`SealError` under another master key."""
        query = sa.select(SecretRow.name, SecretRow.wrapped_value)
        rows = self._database.read(lambda connection: connection.execute(query).all())
        try:
            self._opened = {
                name: self._keyring.open(sealed, purpose=SECRET_PURPOSE, bound_to=[name])
                for name, sealed in rows
            }
        except SealError as error:
            raise SealError(f"this is not the master key of this database: {error}") from None

    def make_missing(self, connection: Connection) -> dict[SecretName, bytes]:
        """Draw the secrets that the database lacks, in a write; returns them by name."""
        present = set(connection.execute(sa.select(SecretRow.name)).scalars())
        made = {}
        for name in SecretName:
            if name not in present:
                made[name], columns = self._drawn(name)
                row = {"name": name, "created_at": self._clock(), **columns}
                connection.execute(sa.insert(SecretRow).values(row))
        return made

    def renew(self, connection: Connection, name: SecretName) -> bytes:
        """Draw a secret anew, in a write; every process reads it when it starts again."""
        secret, columns = self._drawn(name)
        connection.execute(sa.update(SecretRow).where(SecretRow.name == name).values(columns))
        return secret

    def _drawn(self, name: SecretName) -> tuple[bytes, dict[str, Any]]:
        """A new secret, and the columns that it is kept in."""
        secret = os.urandom(SECRET_BYTES)
        sealed = self._keyring.seal(secret, purpose=SECRET_PURPOSE, bound_to=[name])
        return secret, {"wrapped_value": sealed, "wrapping_key": sealed_key_id(sealed)}

    def __repr__(self) -> str:
        return "Secrets()"
