"""The template store: SQLAlchemy tables, migrations and repository."""
