"""Renewing every secret of the deployment, after somebody took the database and its master key.

A new master key comes first (``templates.store.rewrap``): what is drawn here is sealed under it, so
that a second theft of the database opens none of it. Then everything changes in one transaction
while no other write runs, so that nobody sees half of it, and a run that is killed has done nothing
or all:

==================  ================================================================================
audit chain         a line ends the time of the old key, the next begins that of the new one
rows                those that are authentic get a MAC under the new key
pseudonyms          new lines name subjects by new pseudonyms; counts of failures and receipts
                    are brought forward, lines of before are found by the old pseudonyms
receipts            those that are kept are signed again; the old key stays known, with the time
exports, stand-ins  made with the new secret from now on
==================  ================================================================================

One secret stays, that of lifts (:data:`KEPT`).

What the thief did before, with write access to the database, stays as it was: rows and lines from
before are good if they were good under the old keys.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any, cast

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.audit_chain import Anchor, Line, LineKeys, is_true_line
from templates.store.audit_log import PROGRAM, By, is_digest
from templates.store.authenticity import (
    AUTHENTICATED,
    TENANT_OF_KEY,
    columns_of,
    is_authentic,
    row_mac,
    warn,
)
from templates.store.context import StoreContext
from templates.store.receipts import (
    SUBJECT_KIND,
    Receipt,
    sign_claims,
    verify_receipt,
)
from templates.store.record_check import read_rows
from templates.store.schema import (
    KEY_LINES,
    ApiKeyRow,
    AuditRow,
    Base,
    FailedAttemptsRow,
    ReceiptRow,
    SecretRow,
    TenantRow,
)
from templates.store.secret import Secret, SecretName, digest_again
from templates.store.tenants import Tenants

Fresh = dict[SecretName, Secret]

KEPT = frozenset({SecretName.LIFTS})
"""Who has it and a person's very photos has their decoys, and needs none of them. Under another
one the same photos, enrolled again, would give another template: two that meet in the embedding."""


@dataclass(frozen=True)
class Renewed:
    """What :meth:`Renewal.renew` did.

    Attributes
    ----------
    names
        Secrets that were there and were renewed.
    at
        When the old ones were retired.
    ended
        Number of the last line of the audit log under its old key.
    anchor
        The head of the audit log under its new key.
    rows, receipts
        Rows that got a MAC under the new key, and receipts that were signed again.
    refused
        Prefixes of API keys that the audit log contradicts, which are good for nothing now.
    """

    names: tuple[str, ...]
    at: datetime
    ended: int
    anchor: Anchor
    rows: int
    receipts: int
    refused: tuple[str, ...]


class Renewal:
    """Renews the secrets of a deployment."""

    def __init__(self, context: StoreContext, tenants: Tenants) -> None:
        self._context = context
        self._tenants = tenants

    def renew(self, *, by: By = PROGRAM) -> Renewed:
        """Draw every secret anew, and bring whatever depends on one forward.

        Workers take it up at their next look at the database. Call it when nothing is wrapped by
        the stolen master key any more.

        Raises
        ------
        BrokenAuditLog
            If the audit log's key is gone, or its head was altered.
        StoreError
            If the database holds a secret that this program does not know.
        StoreUnavailable
            If a write that is under way takes longer than the timeout.
        """
        renewed = self._context.write_alone(lambda connection: self._renew(connection, by))
        self._chain()  # this process takes it up as well
        return renewed

    def is_done(self) -> bool:
        """Whether the secrets were renewed under the master key that is in force."""
        return self._context.secrets.was_drawn_now(SecretName.CHAIN, self._chain())

    def last(self) -> datetime | None:
        """When the secrets were renewed for the last time; None for never."""
        retired = self._chain().retired
        return retired[-1].at if retired else None

    def tenants_left(self) -> tuple[str, ...]:
        """Names of the tenants whose rotation key is older than the last renewal."""
        chain = self._chain()
        ended = chain.retired[-1].line if chain.retired else 0
        keys = self._context.audit_log.line_keys()

        def is_left(connection: Connection, tenant: str) -> bool:
            lines = connection.execute(_ROTATIONS, {"tenant": tenant, "after": ended})
            return not any(is_true_line(keys, Line(**line._mapping)) for line in lines)

        names = [tenant.name for tenant in self._tenants.all()]
        return tuple(
            self._context.read(
                lambda connection: [name for name in names if is_left(connection, name)]
            )
        )

    def _chain(self) -> Secret:
        chain = self._context.read(lambda _: self._context.secrets.opened(SecretName.CHAIN))
        assert chain is not None, "a read prepares it"  # noqa: S101
        return chain

    def _renew(self, connection: Connection, by: By) -> Renewed:
        audit_log, secrets = self._context.audit_log, self._context.secrets
        names = set(connection.execute(sa.select(SecretRow.name)).scalars())
        if unknown := names - set(SecretName):
            raise StoreError(
                f"this program does not know the secret {min(unknown)!r} of the database: "
                "renew with the newest version that has used it"
            )
        before = audit_log.row_key()
        refused = tuple(_contradicted_keys(connection, audit_log.line_keys()))
        for prefix in refused:
            warn("an API key that the audit log contradicts was not authenticated", key_id=prefix)
        chain, anchor = audit_log.hand_over(connection, by)
        at, ended = chain.retired[-1].at, chain.retired[-1].line
        fresh = {SecretName.CHAIN: chain}
        for name in set(SecretName) - {SecretName.CHAIN} - KEPT:
            secret = secrets.renew(connection, name, at=at, line=ended)
            if secret is not None:
                fresh[name] = secret
        keys = before, audit_log.row_key_of(chain.value)
        return Renewed(
            names=tuple(sorted(fresh)),
            at=at,
            ended=ended,
            anchor=anchor,
            rows=sum(
                _authenticate_again(connection, table, keys, fresh, refused)
                for table in AUTHENTICATED
            ),
            receipts=self._sign_again(connection, fresh),
            refused=refused,
        )

    def _sign_again(self, connection: Connection, fresh: Fresh) -> int:
        """Sign receipts again, and file them under the new pseudonyms; returns how many."""
        if SecretName.RECEIPT not in fresh:
            return 0
        public, private = self._context.signer.public_key(), fresh[SecretName.RECEIPT].value
        query = sa.select(
            ReceiptRow.sequence, ReceiptRow.pseudonym, ReceiptRow.body, ReceiptRow.signature
        )
        changed = []
        for row in read_rows(connection, query, ReceiptRow):
            try:
                claims = verify_receipt(Receipt(row.body, row.signature), public)
            except StoreError:
                warn("a receipt in the database is none and was passed over")
                continue
            receipt = sign_claims(claims, private)
            is_subjects = claims["kind"] == SUBJECT_KIND
            changed.append(
                {
                    "of_sequence": row.sequence,
                    "pseudonym": _again(row.pseudonym, fresh) if is_subjects else row.pseudonym,
                    "body": receipt.body,
                    "signature": receipt.signature,
                }
            )
        if changed:
            statement = sa.update(ReceiptRow.__table__)  # type: ignore[arg-type]
            of_sequence = ReceiptRow.sequence == sa.bindparam("of_sequence")
            connection.execute(statement.where(of_sequence), changed)
        return len(changed)


def _authenticate_again(
    connection: Connection,
    table: type[Base],
    keys: tuple[bytes, bytes],
    fresh: Fresh,
    refused: tuple[str, ...],
) -> int:
    """Bring the rows of a table under the new keys; returns how many are authentic."""
    old_key, new_key = keys
    rows = cast(sa.Table, table.__table__)
    columns = list(columns_of(table))
    if table is ApiKeyRow:
        columns.append(TENANT_OF_KEY.label("tenant"))
    authentic, changed = 0, []
    # Read whole before it is written: a cursor over rows that change meanwhile is not defined.
    for row in read_rows(connection, sa.select(*columns), table):
        values = row._asdict()
        whose = {f"of_{column.key}": values[column.key] for column in rows.primary_key}
        is_good = is_authentic(old_key, table, values) and values.get("prefix") not in refused
        forward = {
            name: move(values[name], fresh) for name, move in _FORWARD.get(table, {}).items()
        }
        mac = row_mac(new_key, table, {**values, **forward}) if is_good else None
        authentic += is_good
        changed.append({**whose, **forward, "mac": mac})
    if changed:
        statement = sa.update(rows).where(
            *(column == sa.bindparam(f"of_{column.key}") for column in rows.primary_key)
        )
        connection.execute(statement, changed)
    return authentic


def _contradicted_keys(connection: Connection, line_keys: LineKeys) -> Iterator[str]:
    """Prefixes of the keys that the audit log does not know, or knows otherwise."""
    keys = sa.select(ApiKeyRow.prefix, ApiKeyRow.revoked_at, TenantRow.name.label("tenant"))
    query = keys.outerjoin(TenantRow, TenantRow.id == ApiKeyRow.tenant_id)
    for key in connection.execute(query.order_by(ApiKeyRow.prefix)).all():
        lines = [
            line
            for row in connection.execute(_LINES_OF_KEY, {"prefix": key.prefix})
            if is_true_line(line_keys, line := Line(**row._mapping))
        ]
        created = any((line.action, line.tenant) == ("key-create", key.tenant) for line in lines)
        revoked = any((line.action, line.outcome) == ("key-revoke", "revoked") for line in lines)
        if not created or (revoked and key.revoked_at is None):
            yield key.prefix


def _again(pseudonym: str | None, fresh: Fresh) -> str | None:
    secret = fresh.get(SecretName.PSEUDONYM)
    # Whoever can write the database can write anything in its place.
    if secret is None or pseudonym is None or not is_digest(pseudonym):
        return pseudonym
    return digest_again(secret.value, bytes.fromhex(pseudonym)).hex()


_FORWARD: dict[type[Base], dict[str, Callable[[Any, Fresh], Any]]] = {
    FailedAttemptsRow: {"pseudonym": _again},
}
"""Columns that hold keyed digests."""

_ROTATIONS: Any = sa.select(*(getattr(AuditRow, name) for name in Line.__dataclass_fields__)).where(
    AuditRow.tenant == sa.bindparam("tenant"),
    AuditRow.action == "tenant-rotate",
    AuditRow.outcome == "begun",
    AuditRow.sequence > sa.bindparam("after"),
)
_LINES_OF_KEY: Any = sa.select(
    *(getattr(AuditRow, name) for name in Line.__dataclass_fields__)
).where(AuditRow.detail == sa.bindparam("prefix"), KEY_LINES)
