"""After a theft of the database together with its master key: every secret made anew.

For a service that is stopped. The audit log goes into an archive, which the old key signs, and a
new chain begins where it ended. API keys get MACs under the new secret, receipts are signed again,
and both only where they were good under the old one. Pseudonyms stay, because receipts and archives
name people by them, and lifts: under another secret the same photos, enrolled again, would give
another template, and two of them meet in the embedding.
"""

from dataclasses import dataclass
from pathlib import Path

from templates.store.audit_archive import Archive, write_archive
from templates.store.audit_chain import begin_chain
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.receipts import sign_again
from templates.store.repository import TemplateStore
from templates.store.secrets import SecretName

KEPT = frozenset({SecretName.PSEUDONYM, SecretName.LIFTS})


@dataclass(frozen=True)
class Renewed:
    """The lines of the old chain, receipts signed again, and prefixes of keys that were altered."""

    archive: Archive
    receipts: int
    refused: tuple[str, ...]


def renew_secrets(store: TemplateStore, archive: Path, *, by: By = PROGRAM) -> Renewed:
    """Draw every secret but those that stay anew, in one write.

    Put a new master key in force first, and drop the old one afterwards. `archive` is a new file
    for the audit log so far; the new chain begins with a line of the renewal.

    Raises
    ------
    BrokenAuditLog
        If the audit log is not whole: what it hides must be looked at first.
    StoreError
        If the archive cannot be written.
    """
    old_receipt_key = store.secrets.get(SecretName.RECEIPT)

    with store.database.write() as session:
        fresh = {name: store.secrets.draw(session, name) for name in SecretName if name not in KEPT}
        refused = store.api_keys.authenticate_again(session, fresh[SecretName.API_KEYS])
        receipts = sign_again(session, old_receipt_key, fresh[SecretName.RECEIPT])
        # After all that may refuse: an archive that is left would stop the next try.
        archived = write_archive(session, store, archive, None)
        key = fresh[SecretName.CHAIN]
        begin_chain(session, key, archived.last)
        store.audit_log.append(session, Entry("secrets-renew", "renewed", by), key=key)
    store.secrets.load()
    store.database.purge_log()
    return Renewed(archived, receipts, refused)
