"""The template store: tables, migrations and repository on SQLite or PostgreSQL.

Everything that a secret could be read from is encrypted; see ``docs/storage.md``.
"""

from templates.store.api_keys import ApiKey, Right
from templates.store.attempts import Attempt
from templates.store.audit_archive import Archive, archive_audit_log, verify_archive
from templates.store.audit_chain import Anchor, BrokenAuditLog
from templates.store.audit_log import By, Entry, Line
from templates.store.audit_verification import verify_audit_log
from templates.store.identifiers import InvalidIdentifier, UnknownTenant
from templates.store.lockout import AttemptsStatus, LockedOut, LockoutPolicy, Replayed
from templates.store.receipts import Receipt, verify_receipt
from templates.store.renewal import renew_secrets
from templates.store.repository import TemplateStore
from templates.store.retention import Retention
from templates.store.rewrap import count_wrapped, rewrap_keys
from templates.store.schema import Source
from templates.store.tenants import RetiredRotation

__all__ = [
    "Anchor",
    "ApiKey",
    "Archive",
    "Attempt",
    "AttemptsStatus",
    "BrokenAuditLog",
    "By",
    "Entry",
    "InvalidIdentifier",
    "Line",
    "LockedOut",
    "LockoutPolicy",
    "Receipt",
    "Replayed",
    "Retention",
    "RetiredRotation",
    "Right",
    "Source",
    "TemplateStore",
    "UnknownTenant",
    "archive_audit_log",
    "count_wrapped",
    "renew_secrets",
    "rewrap_keys",
    "verify_archive",
    "verify_audit_log",
    "verify_receipt",
]
