"""The public key that receipts and archives are verified with, as a command line names it."""

from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.errors import UsageError
from api.cli.files import MAX_CONTRACT_BYTES, read_bounded
from api.http.receipts import read_receipt_key
from templates.contract.canonical import parse_object
from templates.errors import StoreError

PublicKey = Annotated[
    str,
    typer.Option(
        help="The service's receipt key in base64, or a file with the JSON of `GET /v1/contract`."
    ),
]


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
