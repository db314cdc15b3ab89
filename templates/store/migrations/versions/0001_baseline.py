"""The tables of the store, as the mapped classes have them: the first release freezes them here."""

from alembic import op

from templates.store.schema import Base

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    Base.metadata.create_all(op.get_bind())
