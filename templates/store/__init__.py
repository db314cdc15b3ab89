"""The template store: tables, migrations and repository on SQLite or PostgreSQL.

Everything that a secret could be read from is encrypted; see ``docs/storage.md``.
"""

from templates.store.receipts import Receipt, verify_receipt
from templates.store.repository import TemplateStore
from templates.store.subjects import (
    Erasure,
    Source,
    StoredTemplate,
    SubjectPage,
    SubjectRecord,
    SubjectTemplate,
)

__all__ = [
    "Erasure",
    "Receipt",
    "Source",
    "StoredTemplate",
    "SubjectPage",
    "SubjectRecord",
    "SubjectTemplate",
    "TemplateStore",
    "verify_receipt",
]
