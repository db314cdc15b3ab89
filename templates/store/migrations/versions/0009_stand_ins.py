"""What is read of a subject who has no stored template."""

import sqlalchemy as sa
from alembic import op

revision = "0009_serves_0008"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "stand_ins",
        sa.Column("contract_id", sa.String(length=64), nullable=False),
        sa.Column("ciphertext", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("contract_id", name=op.f("pk_stand_ins")),
    )


def downgrade() -> None:
    """Take back."""
    op.drop_table("stand_ins")
