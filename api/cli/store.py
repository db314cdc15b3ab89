"""The store that a command opens, and the key that receipts and archives are checked with."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from api.cli.errors import UsageError
from api.cli.files import MAX_CONTRACT_BYTES
from api.http.receipts import read_receipt_key
from api.service.opening import open_keyring, open_store, prepare_database
from api.settings import Settings
from templates.contract.canonical import parse_object
from templates.errors import StoreError
from templates.keys.private_file import read_bounded
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore


@contextmanager
def opened_store(
    settings: Settings, keyring: MasterKeyring | None = None
) -> Iterator[TemplateStore]:
    """Open the store for the block, after making it or bringing it to the newest schema."""
    with closing(open_store(settings, keyring or open_keyring(settings))) as store:
        prepare_database(store)
        yield store


def read_public_key(text: str) -> bytes:
    """Read base64, or the file of ``GET /v1/contract``; :class:`UsageError` for anything else."""
    path = Path(text)
    entry: Any = {"public_key": text}
    if path.is_file():
        document = parse_object(read_bounded(path, MAX_CONTRACT_BYTES), what="the contract")
        entry = document.get("receipt_key")
    try:
        return read_receipt_key(entry)
    except StoreError:
        raise UsageError(
            "--public-key takes base64, or a file with the JSON of GET /v1/contract"
        ) from None
