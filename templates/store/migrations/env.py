"""Alembic environment: migrates over the one connection that `templates.store.migrate` hands in."""

from alembic import context

from templates.store.schema import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    render_as_batch=True,
    # SQLite can roll back DDL too; Alembic only assumes that its driver cannot.
    transactional_ddl=True,
)
with context.begin_transaction():
    context.run_migrations()
