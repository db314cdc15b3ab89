"""The tables of the store.

A secret is stored sealed: a column ``wrapped_key`` by a master key, whose id it begins with.
Receipts and audit lines outlive a subject: they name it by a keyed pseudonym only.
"""

from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated, Any, ClassVar

from sqlalchemy import (
    BigInteger,
    DateTime,
    Dialect,
    Enum,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Text,
    TypeDecorator,
    UniqueConstraint,
    false,
)
from sqlalchemy.orm import DeclarativeBase, Load, Mapped, mapped_column

from templates.errors import StoreError

PSEUDONYM = String(64)
UUID_HEX = String(32)

# Ordered by code point on every database, so that a page cursor means the same on each of them.
SUBJECT_ID = String(128).with_variant(String(128, collation="C"), "postgresql")
SERIAL = BigInteger().with_variant(Integer, "sqlite")

RowId = Annotated[str, mapped_column(UUID_HEX, primary_key=True)]
TenantId = Annotated[str, mapped_column(UUID_HEX, ForeignKey("tenants.id", ondelete="CASCADE"))]
Sealed = Annotated[
    bytes, mapped_column(deferred=True, deferred_group="sealed", deferred_raiseload=True)
]


class Source(StrEnum):
    """What a template was made from."""

    PHOTOS = "photos"
    TEMPLATE = "template"


class Checked(TypeDecorator[Any]):
    """A type of which no error quotes a cell; SQLite keeps any value in any column."""

    def result_processor(self, dialect: Dialect, coltype: object) -> Any:
        """Read a cell, or raise a StoreError."""
        read = super().result_processor(dialect, coltype)

        def checked(value: Any) -> Any:
            try:
                return read(value)  # type: ignore[misc]
            except (LookupError, ValueError, TypeError):
                raise StoreError(
                    "a row of the database was altered and cannot be read: run `veilface audit-log "
                    "verify`; erase a subject whose row it is, and enroll it again"
                ) from None

        return checked


class Kind(Checked):
    """An enumeration, as text."""

    impl = Enum
    cache_ok = True


class Whole(Checked):
    """A whole number."""

    impl = Integer
    cache_ok = True

    def process_result_value(self, value: Any, dialect: Dialect) -> int | None:  # noqa: ARG002
        """Refuse a text or a fraction."""
        if not isinstance(value, int | None):
            raise TypeError
        return value


class Blob(TypeDecorator[bytes]):
    """Bytes; anything else is read as none, which no MAC and no seal fits."""

    impl = LargeBinary
    cache_ok = True

    def result_processor(self, dialect: Dialect, coltype: object) -> Any:  # noqa: ARG002
        """Read a cell."""
        return lambda value: value if isinstance(value, bytes | None) else b""


class UtcDateTime(Checked):
    """An aware time, in UTC on both sides; SQLite would otherwise hand back a naive one."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Convert to UTC; a naive time has no meaning here."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("times in the store carry a time zone")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Attach UTC where the database dropped the zone."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of the mapped tables; constraint names are fixed so that migrations can name them."""

    type_annotation_map: ClassVar[dict[Any, Any]] = {
        bytes: Blob,
        datetime: UtcDateTime,
        int: Whole,
    }
    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class TenantRow(Base):
    """A tenant: one rotation, one set of subjects, its own API keys."""

    __tablename__ = "tenants"

    id: Mapped[RowId]
    name: Mapped[str] = mapped_column(String(64), unique=True)
    rotation_epoch: Mapped[int]
    template_enrollment: Mapped[bool] = mapped_column(server_default=false())


class RotationKeyRow(Base):
    """The key of a tenant's rotation, one row for each epoch that templates still belong to."""

    __tablename__ = "rotation_keys"

    tenant_id: Mapped[TenantId] = mapped_column(primary_key=True)
    epoch: Mapped[int] = mapped_column(primary_key=True)
    wrapped_key: Mapped[bytes]


class ApiKeyRow(Base):
    """An API key: the hash of its token, and a MAC of everything that gives rights."""

    __tablename__ = "api_keys"

    id: Mapped[RowId]
    tenant_id: Mapped[TenantId] = mapped_column(index=True)
    prefix: Mapped[str] = mapped_column(String(16), unique=True)
    token_hash: Mapped[bytes]
    rights: Mapped[str] = mapped_column(String(128))
    label: Mapped[str] = mapped_column(String(128))
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
    lowest_level: Mapped[str | None] = mapped_column(String(64))
    mac: Mapped[bytes]


class SubjectRow(Base):
    """A subject with its one template, sealed under a data key that a master key wraps.

    `holder_salt` is NULL where the template needs no holder's key. What is sealed is loaded only by
    a query with the option :data:`SEALED`.
    """

    __tablename__ = "subjects"
    __table_args__ = (
        UniqueConstraint("tenant_id", "subject_id"),
        Index("ix_subjects_updated_at", "updated_at"),
    )

    id: Mapped[RowId]
    tenant_id: Mapped[TenantId]
    subject_id: Mapped[str] = mapped_column(SUBJECT_ID)
    template_id: Mapped[str] = mapped_column(String(64))
    contract_id: Mapped[str] = mapped_column(String(64))
    rotation_epoch: Mapped[int]
    source: Mapped[Source] = mapped_column(Kind(Source, native_enum=False, length=16))
    photos: Mapped[int]
    holder_salt: Mapped[str | None] = mapped_column(UUID_HEX)
    created_at: Mapped[datetime]
    updated_at: Mapped[datetime]
    last_used_at: Mapped[datetime | None]
    wrapped_key: Mapped[Sealed]
    ciphertext: Mapped[Sealed]


SEALED = Load(SubjectRow).undefer_group("sealed")
# These columns are readable whatever was altered.
IDS = Load(SubjectRow).load_only(
    SubjectRow.tenant_id, SubjectRow.subject_id, SubjectRow.template_id, SubjectRow.contract_id
)


class FailedAttemptsRow(Base):
    """Failed verifications of a subject, enrolled or not; its lock follows from them."""

    __tablename__ = "failed_attempts"

    tenant_id: Mapped[TenantId] = mapped_column(primary_key=True)
    pseudonym: Mapped[str] = mapped_column(PSEUDONYM, primary_key=True)
    consecutive: Mapped[int]
    last_failed_at: Mapped[datetime] = mapped_column(index=True)


class ReceiptRow(Base):
    """A signed erasure receipt. No foreign key: it outlives the subject and the tenant."""

    __tablename__ = "receipts"
    __table_args__ = (Index("ix_receipts_pseudonym_sequence", "pseudonym", "sequence"),)

    sequence: Mapped[int] = mapped_column(SERIAL, primary_key=True, autoincrement=True)
    pseudonym: Mapped[str] = mapped_column(PSEUDONYM)
    body: Mapped[str] = mapped_column(Text)
    signature: Mapped[bytes]


class AuditRow(Base):
    """One line of the audit log; its MAC covers the MAC of the line before.

    `at` is ISO 8601 text in UTC with microseconds, as the MAC covers it. `token` is the digest of
    the one-use token or challenge that the line used up: the database takes each one once.
    """

    __tablename__ = "audit_log"
    __table_args__ = (
        Index("ix_audit_log_tenant_sequence", "tenant", "sequence"),
        Index("ix_audit_log_pseudonym_sequence", "pseudonym", "sequence"),
    )

    sequence: Mapped[int] = mapped_column(SERIAL, primary_key=True, autoincrement=False)
    at: Mapped[str] = mapped_column(String(32))
    tenant: Mapped[str | None] = mapped_column(String(64))
    actor: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(64))
    pseudonym: Mapped[str | None] = mapped_column(PSEUDONYM)
    outcome: Mapped[str] = mapped_column(String(64))
    request_id: Mapped[str | None] = mapped_column(String(64))
    detail: Mapped[str | None] = mapped_column(String(64))
    token: Mapped[str | None] = mapped_column(String(64), unique=True)
    mac: Mapped[bytes]


class AuditHeadRow(Base):
    """One row: where the chain of the audit log begins and ends, under a MAC.

    The chain begins after line `base_sequence`, whose MAC was `base_mac`: 0 and zeros, until older
    lines were archived. It ends with line `sequence`, whose MAC is `line_mac`.
    """

    __tablename__ = "audit_head"

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    base_sequence: Mapped[int] = mapped_column(SERIAL)
    base_mac: Mapped[bytes]
    sequence: Mapped[int] = mapped_column(SERIAL)
    line_mac: Mapped[bytes]
    mac: Mapped[bytes]


class SecretRow(Base):
    """A secret of the deployment, made once and wrapped by a master key."""

    __tablename__ = "secrets"

    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    wrapped_key: Mapped[bytes]
