"""The template store: tables, migrations and repository on SQLite or PostgreSQL.

Everything that a secret could be read from is encrypted; see ``docs/storage.md``.
"""

from templates.store.api_keys import ApiKey, NewApiKey, Right, probe_key
from templates.store.erasure import Erasure
from templates.store.idempotency import Answer, Claim, IdempotencyConflict
from templates.store.identifiers import InvalidIdentifier, UnknownTenant
from templates.store.receipts import Receipt, verify_receipt
from templates.store.repository import TemplateStore
from templates.store.subjects import (
    Source,
    StoredTemplate,
    SubjectPage,
    SubjectRecord,
    SubjectTemplate,
)
from templates.store.tenants import RotationKey, Tenant

__all__ = [
    "Answer",
    "ApiKey",
    "Claim",
    "Erasure",
    "IdempotencyConflict",
    "InvalidIdentifier",
    "NewApiKey",
    "Receipt",
    "Right",
    "RotationKey",
    "Source",
    "StoredTemplate",
    "SubjectPage",
    "SubjectRecord",
    "SubjectTemplate",
    "TemplateStore",
    "Tenant",
    "UnknownTenant",
    "probe_key",
    "verify_receipt",
]
