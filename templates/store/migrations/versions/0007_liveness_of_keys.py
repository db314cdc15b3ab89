"""An API key may ask for liveness where the deployment does not."""

import sqlalchemy as sa
from alembic import op

from templates.errors import StoreError

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply. The keys there are ask for nothing; the MACs of their rows stay true."""
    op.add_column("api_keys", sa.Column("liveness", sa.String(length=16), nullable=True))


def downgrade() -> None:
    """Take back, while no key asks for liveness."""
    keys = sa.table("api_keys", sa.column("liveness"), sa.column("revoked_at"))
    asking = sa.select(sa.func.count()).where(keys.c.liveness.is_not(None))
    if count := op.get_bind().execute(asking.where(keys.c.revoked_at.is_(None))).scalar_one():
        raise StoreError(
            f"{count} API keys ask for liveness, which an earlier version does not check: revoke "
            "them before the schema goes back"
        )
    op.drop_column("api_keys", "liveness")
