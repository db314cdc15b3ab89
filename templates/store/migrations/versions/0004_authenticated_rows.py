"""Rows that decide carry a MAC and the number of their line in the audit log."""

import sqlalchemy as sa
from alembic import op

from templates.errors import StoreError

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_SERIAL = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

_ERASURES = "'erased', 'nothing_held', 'receipt_repeated'"
_INDEXES = {
    "ix_audit_log_key_lines": (
        ["detail", "sequence"],
        "action IN ('key-create', 'key-replace', 'key-revoke')",
    ),
    "ix_audit_log_tenant_lines": (
        ["tenant", "sequence"],
        "action IN ('tenant-settings', 'tenant-rotate', 'tenant-erase') "
        "AND outcome NOT IN ('moved', 'retired', 'resumed', 'receipt_repeated')",
    ),
    "ix_audit_log_attempt_lines": (
        ["pseudonym", "sequence"],
        "action IN ('verify', 'lockout-reset', 'erase') AND "
        f"outcome IN ('accept', 'reject', 'reset', {_ERASURES})",
    ),
    "ix_audit_log_enrollment_lines": (
        ["pseudonym", "sequence"],
        f"outcome IN ('created', 'replaced', {_ERASURES})",
    ),
    "ix_audit_log_nonce": (["nonce"], "nonce IS NOT NULL"),
}


def _mac() -> sa.Column[bytes]:
    return sa.Column("mac", sa.LargeBinary(length=32), nullable=True)


def _line() -> sa.Column[int]:
    return sa.Column("line", _SERIAL, server_default="0", nullable=False)


def upgrade() -> None:
    """Apply. The MACs of rows there are: TemplateStore.upgrade, which has a key, writes them."""
    op.add_column("api_keys", sa.Column("lowest_level", sa.String(length=64), nullable=True))
    op.add_column(
        "tenants",
        sa.Column("template_enrollment", sa.Boolean(), server_default=sa.false(), nullable=False),
    )
    for table in ("api_keys", "tenants", "failed_attempts"):
        op.add_column(table, _line())
        op.add_column(table, _mac())
    op.add_column("idempotency", _mac())
    # Added, never rebuilt: on SQLite a rebuilt table would lose its triggers.
    op.add_column("audit_log", sa.Column("nonce", sa.String(length=64), nullable=True))
    # Nothing looks a line up by these alone, and every write of a line pays for them.
    op.drop_index("ix_audit_log_at", table_name="audit_log")
    op.drop_index("ix_audit_log_pseudonym", table_name="audit_log")
    for name, (columns, which) in _INDEXES.items():
        where = sa.text(which)
        op.create_index(name, "audit_log", columns, sqlite_where=where, postgresql_where=where)
    op.create_table(
        "known_calibrations",
        sa.Column("contract_id", sa.String(length=64), nullable=False),
        sa.Column("position", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("calibration_ids", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        _mac(),
        sa.PrimaryKeyConstraint("contract_id", "position", name=op.f("pk_known_calibrations")),
    )


def downgrade() -> None:
    """Take back, while the audit log is empty."""
    lines = sa.select(sa.func.count()).select_from(sa.table("audit_log"))
    if op.get_bind().execute(lines).scalar_one():
        raise StoreError(
            "the audit log has lines, and an earlier version could not add any after them: "
            "the schema cannot go back; restore a backup from before the upgrade instead"
        )
    # The chain begins anew, and so does its key.
    op.execute("DELETE FROM secrets WHERE name = 'audit-chain'")
    op.execute(sa.text("UPDATE audit_head SET mac = :none").bindparams(none=b""))
    op.drop_table("known_calibrations")
    for name in _INDEXES:
        op.drop_index(name, table_name="audit_log")
    op.create_index("ix_audit_log_pseudonym", "audit_log", ["pseudonym"])
    op.create_index("ix_audit_log_at", "audit_log", ["at"])
    op.drop_column("audit_log", "nonce")
    op.drop_column("idempotency", "mac")
    for table in ("api_keys", "tenants", "failed_attempts"):
        op.drop_column(table, "mac")
        op.drop_column(table, "line")
    op.drop_column("tenants", "template_enrollment")
    op.drop_column("api_keys", "lowest_level")
