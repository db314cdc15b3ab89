"""A template whose ciphertext its holder keeps has none in the store."""

import sqlalchemy as sa
from alembic import op

from templates.errors import StoreError

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def _ciphertext_nullable(nullable: bool) -> None:
    # SQLite cannot alter a column: the table is rebuilt there, with whatever it holds.
    with op.batch_alter_table("templates") as table:
        table.alter_column("ciphertext", existing_type=sa.LargeBinary(), nullable=nullable)


def upgrade() -> None:
    """Apply."""
    _ciphertext_nullable(True)


def downgrade() -> None:
    """Take back, while the store keeps every template."""
    templates = sa.table("templates", sa.column("ciphertext"))
    held = sa.select(sa.func.count()).where(templates.c.ciphertext.is_(None))
    if op.get_bind().execute(held).scalar_one():
        raise StoreError(
            "holders keep templates, and an earlier version could not verify their subjects: "
            "enroll these with storage=service, or erase them, before the schema goes back"
        )
    _ciphertext_nullable(False)
