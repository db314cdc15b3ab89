"""Secrets of the whole deployment: drawn once, wrapped by the master key, the same everywhere."""

import os
from enum import StrEnum

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store.database import Database
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

    def __init__(self, database: Database, keyring: MasterKeyring) -> None:
        self._database = database
        self._keyring = keyring
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
        with self._database.read() as session:
            rows = session.scalars(sa.select(SecretRow)).all()
        try:
            self._opened = {
                row.name: self._keyring.open(
                    row.wrapped_key, purpose=SECRET_PURPOSE, bound_to=[row.name]
                )
                for row in rows
            }
        except SealError as error:
            raise SealError(f"this is not the master key of this database: {error}") from None

    def make_missing(self, session: Session) -> dict[SecretName, bytes]:
        """Draw the secrets that the database lacks, in a write; returns them by name."""
        present = set(session.scalars(sa.select(SecretRow.name)))
        return {name: self.draw(session, name) for name in SecretName if name not in present}

    def draw(self, session: Session, name: SecretName) -> bytes:
        """Draw a secret, in a write, in place of an earlier one.

        Every process that runs has to start again to read it.
        """
        secret = os.urandom(SECRET_BYTES)
        sealed = self._keyring.seal(secret, purpose=SECRET_PURPOSE, bound_to=[name])
        session.merge(SecretRow(name=name, wrapped_key=sealed))
        return secret
