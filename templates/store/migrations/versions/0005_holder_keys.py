"""Templates that need their holder's key name the salt of the holder's rotation."""

import sqlalchemy as sa
from alembic import op

from templates.errors import StoreError

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply. The templates there are need no key."""
    op.add_column("templates", sa.Column("holder_salt", sa.String(length=32), nullable=True))


def downgrade() -> None:
    """Take back, while no template needs a key."""
    templates = sa.table("templates", sa.column("holder_salt"))
    needing = sa.select(sa.func.count()).where(templates.c.holder_salt.is_not(None))
    if count := op.get_bind().execute(needing).scalar_one():
        raise StoreError(
            f"{count} templates need their holder's key, which an earlier version does not ask "
            "for: the schema cannot go back; erase these subjects, or enroll them without a key"
        )
    op.drop_column("templates", "holder_salt")
