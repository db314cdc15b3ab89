"""The order that retention reads subjects in, their last use, and how far a tenant is erased."""

from datetime import UTC, datetime

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_index("ix_subjects_updated_at_id", "subjects", ["updated_at", "id"], unique=False)
    op.create_table(
        "tenant_erasures",
        sa.Column("tenant_id", sa.String(length=32), nullable=False),
        sa.Column("begun_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("removed", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["tenant_id"],
            ["tenants.id"],
            name=op.f("fk_tenant_erasures_tenant_id_tenants"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("tenant_id", name=op.f("pk_tenant_erasures")),
    )
    _count_disuse_from_now()


def _count_disuse_from_now() -> None:
    # Nothing noted a use before 0002, so who is used daily looks like who never was. Without this,
    # a retention of unused subjects would erase both at its first run.
    subjects = sa.table("subjects", sa.column("last_used_at", sa.DateTime(timezone=True)))
    op.execute(
        subjects.update()
        .where(subjects.c.last_used_at.is_(None))
        .values(last_used_at=sa.bindparam("now", datetime.now(UTC), sa.DateTime(timezone=True)))
    )


def downgrade() -> None:
    """Take back."""
    op.drop_table("tenant_erasures")
    op.drop_index("ix_subjects_updated_at_id", table_name="subjects")
