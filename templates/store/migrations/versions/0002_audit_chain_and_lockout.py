"""The audit log's head and its triggers, the detail of a line, and who is counted as unknown."""

import sqlalchemy as sa
from alembic import op

from templates.errors import StoreError

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

# SQLite removes a row for INSERT OR REPLACE without asking the DELETE trigger: hence the last one.
_SQLITE = {
    "audit_log_no_update": """
        BEFORE UPDATE ON audit_log
        BEGIN SELECT RAISE(ABORT, 'audit_log is append-only'); END""",
    "audit_log_no_delete": """
        BEFORE DELETE ON audit_log
        BEGIN SELECT RAISE(ABORT, 'audit_log is append-only'); END""",
    "audit_log_no_replace": """
        BEFORE INSERT ON audit_log
        WHEN EXISTS (SELECT 1 FROM audit_log WHERE sequence = NEW.sequence)
        BEGIN SELECT RAISE(ABORT, 'audit_log is append-only'); END""",
    "audit_head_no_delete": """
        BEFORE DELETE ON audit_head
        BEGIN SELECT RAISE(ABORT, 'the head of the audit log stays'); END""",
}

_POSTGRESQL = {
    ("audit_log_append_only", "audit_log"): "UPDATE OR DELETE OR TRUNCATE",
    ("audit_head_stays", "audit_head"): "DELETE OR TRUNCATE",
}


def upgrade() -> None:
    """Apply."""
    op.add_column(
        "failed_attempts",
        sa.Column("known", sa.Boolean(), server_default=sa.true(), nullable=False),
    )
    op.add_column("audit_log", sa.Column("detail", sa.String(length=64), nullable=True))
    head = op.create_table(
        "audit_head",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("sequence", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("hash", sa.LargeBinary(length=32), nullable=False),
        sa.Column("mac", sa.LargeBinary(length=32), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_audit_head")),
    )
    # Here, not at the first line: a head that is missing later was removed by somebody. It has no
    # MAC yet: TemplateStore.upgrade, which has a key, writes it.
    op.bulk_insert(head, [{"id": 1, "sequence": 0, "hash": bytes(32), "mac": b""}])
    if op.get_bind().dialect.name == "sqlite":
        for name, body in _SQLITE.items():
            op.execute(f"CREATE TRIGGER {name} {body}")
        return
    op.execute(
        """
        CREATE FUNCTION veilface_append_only() RETURNS trigger LANGUAGE plpgsql AS
        $$ BEGIN RAISE EXCEPTION '% is append-only', TG_TABLE_NAME; END $$
        """
    )
    for (name, table), events in _POSTGRESQL.items():
        op.execute(
            f"CREATE TRIGGER {name} BEFORE {events} ON {table} "
            "FOR EACH STATEMENT EXECUTE FUNCTION veilface_append_only()"
        )


def downgrade() -> None:
    """Take back, while the audit log is empty."""
    lines = sa.select(sa.func.count()).select_from(sa.table("audit_log"))
    if op.get_bind().execute(lines).scalar_one():
        raise StoreError(
            "the audit log has lines, and without its head none could be added after them: "
            "the schema cannot go back; restore a backup from before the upgrade instead"
        )
    # The chain begins anew, and so does its key.
    op.execute("DELETE FROM secrets WHERE name = 'audit-chain'")
    if op.get_bind().dialect.name == "sqlite":
        for name in _SQLITE:
            op.execute(f"DROP TRIGGER {name}")
    else:
        for name, table in _POSTGRESQL:
            op.execute(f"DROP TRIGGER {name} ON {table}")
        op.execute("DROP FUNCTION veilface_append_only()")
    op.drop_table("audit_head")
    op.drop_column("audit_log", "detail")
    op.drop_column("failed_attempts", "known")
