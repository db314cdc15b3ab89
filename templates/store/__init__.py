"""The template store: tables, migrations and repository on SQLite or PostgreSQL.

Everything that a secret could be read from is encrypted; see ``docs/storage.md``.
"""

from templates.store.api_keys import ApiKey, NewApiKey, Right
from templates.store.attempts import Attempt
from templates.store.audit_chain import Anchor, Line, Problem, Verification
from templates.store.audit_log import AuditLog, BrokenAuditLog, By, Entry
from templates.store.erasure import Erasure
from templates.store.identifiers import InvalidIdentifier, UnknownTenant
from templates.store.lockout import LockedOut, LockoutPolicy, Nonce, Replayed, Superseded
from templates.store.receipts import Receipt, verify_receipt
from templates.store.repository import TemplateStore
from templates.store.retention import Retention
from templates.store.standing import AttemptsStatus
from templates.store.subject_rows import (
    Source,
    SubjectRecord,
    SubjectTemplate,
)
from templates.store.subjects import StoredTemplate, SubjectPage
from templates.store.tenant_erasure import TenantErasure
from templates.store.tenants import RetiredRotation, RotationKey, Tenant

__all__ = [
    "Anchor",
    "ApiKey",
    "Attempt",
    "AttemptsStatus",
    "AuditLog",
    "BrokenAuditLog",
    "By",
    "Entry",
    "Erasure",
    "InvalidIdentifier",
    "Line",
    "LockedOut",
    "LockoutPolicy",
    "NewApiKey",
    "Nonce",
    "Problem",
    "Receipt",
    "Replayed",
    "Retention",
    "RetiredRotation",
    "Right",
    "RotationKey",
    "Source",
    "StoredTemplate",
    "SubjectPage",
    "SubjectRecord",
    "SubjectTemplate",
    "Superseded",
    "TemplateStore",
    "Tenant",
    "TenantErasure",
    "UnknownTenant",
    "Verification",
    "verify_receipt",
]
