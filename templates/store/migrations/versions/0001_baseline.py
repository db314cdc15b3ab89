"""The tables of the store."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_SERIAL = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_TIME = sa.DateTime(timezone=True)
_ID = sa.String(length=32)
_KEY_ID = sa.String(length=16)
_WORD = sa.String(length=64)
_MAC = sa.LargeBinary(length=32)
_SUBJECT_ID = sa.String(length=128).with_variant(sa.String(length=128, collation="C"), "postgresql")


def _column(name: str, kind: Any, **options: Any) -> sa.Column[Any]:
    return sa.Column(name, kind, **{"nullable": False, **options})


def _owned_by(table: str, column: str, owner: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_{table}_{column}_{owner}")
    return sa.ForeignKeyConstraint([column], [f"{owner}.id"], name=name, ondelete="CASCADE")


def _table(name: str, *parts: sa.schema.SchemaItem, key: tuple[str, ...] = ("id",)) -> None:
    op.create_table(name, *parts, sa.PrimaryKeyConstraint(*key, name=op.f(f"pk_{name}")))


def upgrade() -> None:
    """Apply."""
    _table(
        "tenants",
        _column("id", _ID),
        _column("name", _WORD),
        _column("rotation_epoch", sa.Integer()),
        _column("created_at", _TIME),
        _column("template_enrollment", sa.Boolean(), server_default=sa.false()),
        sa.UniqueConstraint("name", name=op.f("uq_tenants_name")),
    )
    _table(
        "rotation_keys",
        _column("tenant_id", _ID),
        _column("epoch", sa.Integer()),
        _column("wrapped_key", sa.LargeBinary()),
        _column("wrapping_key", _KEY_ID),
        _column("created_at", _TIME),
        _owned_by("rotation_keys", "tenant_id", "tenants"),
        key=("tenant_id", "epoch"),
    )
    _table(
        "api_keys",
        _column("id", _ID),
        _column("tenant_id", _ID),
        _column("prefix", sa.String(length=16)),
        _column("token_hash", _MAC),
        _column("rights", sa.String(length=128)),
        _column("label", sa.String(length=128)),
        _column("created_at", _TIME),
        _column("expires_at", _TIME, nullable=True),
        _column("revoked_at", _TIME, nullable=True),
        _column("last_used_at", _TIME, nullable=True),
        _column("lowest_level", _WORD, nullable=True),
        _column("mac", _MAC),
        _owned_by("api_keys", "tenant_id", "tenants"),
        sa.UniqueConstraint("prefix", name=op.f("uq_api_keys_prefix")),
    )
    op.create_index(op.f("ix_api_keys_tenant_id"), "api_keys", ["tenant_id"])
    _table(
        "subjects",
        _column("id", _ID),
        _column("tenant_id", _ID),
        _column("subject_id", _SUBJECT_ID),
        _column("wrapped_key", sa.LargeBinary()),
        _column("wrapping_key", _KEY_ID),
        _column("created_at", _TIME),
        _column("updated_at", _TIME),
        _column("last_used_at", _TIME, nullable=True),
        _owned_by("subjects", "tenant_id", "tenants"),
        sa.UniqueConstraint(
            "tenant_id", "subject_id", name=op.f("uq_subjects_tenant_id_subject_id")
        ),
    )
    op.create_index("ix_subjects_wrapping_key", "subjects", ["wrapping_key"])
    op.create_index("ix_subjects_updated_at", "subjects", ["updated_at"])
    _table(
        "templates",
        _column("subject_pk", _ID),
        _column("template_id", _WORD),
        _column("contract_id", _WORD),
        _column("rotation_epoch", sa.Integer()),
        _column("ciphertext", sa.LargeBinary()),
        _column("n", sa.Integer()),
        _column("m", sa.Integer()),
        _column("dtype", sa.String(length=16)),
        _column("source", sa.String(length=16)),
        _column("photos", sa.Integer()),
        _column("holder_salt", _ID, nullable=True),
        _column("created_at", _TIME),
        _owned_by("templates", "subject_pk", "subjects"),
        key=("subject_pk",),
    )
    op.create_index(op.f("ix_templates_contract_id"), "templates", ["contract_id"])
    _table(
        "failed_attempts",
        _column("tenant_id", _ID),
        _column("pseudonym", _WORD),
        _column("consecutive", sa.Integer()),
        _column("total", sa.Integer()),
        _column("last_failed_at", _TIME),
        _owned_by("failed_attempts", "tenant_id", "tenants"),
        key=("tenant_id", "pseudonym"),
    )
    op.create_index(
        op.f("ix_failed_attempts_last_failed_at"), "failed_attempts", ["last_failed_at"]
    )
    _table(
        "receipts",
        _column("sequence", _SERIAL, autoincrement=True),
        _column("pseudonym", _WORD),
        _column("body", sa.Text()),
        _column("signature", sa.LargeBinary(length=64)),
        _column("created_at", _TIME),
        key=("sequence",),
    )
    op.create_index("ix_receipts_pseudonym_sequence", "receipts", ["pseudonym", "sequence"])
    _table(
        "audit_log",
        _column("sequence", _SERIAL, autoincrement=False),
        _column("at", sa.String(length=32)),
        _column("tenant", _WORD, nullable=True),
        _column("actor", _WORD),
        _column("action", _WORD),
        _column("pseudonym", _WORD, nullable=True),
        _column("outcome", _WORD),
        _column("request_id", _WORD, nullable=True),
        _column("detail", _WORD, nullable=True),
        _column("token", _WORD, nullable=True),
        _column("mac", _MAC),
        sa.UniqueConstraint("token", name=op.f("uq_audit_log_token")),
        key=("sequence",),
    )
    op.create_index("ix_audit_log_tenant_sequence", "audit_log", ["tenant", "sequence"])
    op.create_index("ix_audit_log_pseudonym_sequence", "audit_log", ["pseudonym", "sequence"])
    _table(
        "audit_head",
        _column("id", sa.Integer(), autoincrement=False),
        _column("base_sequence", _SERIAL),
        _column("base_mac", _MAC),
        _column("sequence", _SERIAL),
        _column("line_mac", _MAC),
        _column("mac", _MAC),
    )
    _table(
        "secrets",
        _column("name", _WORD),
        _column("wrapped_value", sa.LargeBinary()),
        _column("wrapping_key", _KEY_ID),
        _column("created_at", _TIME),
        key=("name",),
    )
