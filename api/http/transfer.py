"""Export and import of one subject.

An export is::

    "VEILEXP1" | contract id (32 bytes) | sealed blob

The sealed blob (``MasterKeyring.seal``: AES-256-GCM, with the id of its key in front) opens only
with the same contract id, and where the deployment's own key sealed it, only for the same tenant.
It holds::

    length of the header (4 bytes, big-endian) | header (canonical JSON) | wire bytes

The template inside is without the tenant's rotation, float32: it gets one of the importing
tenant's, and no second rounding to half precision takes place. A holder's rotation stays, and the
header names its salt: the enrollment needs the same key after the import.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import ClassVar

from api.http.errors import StartError
from templates.contract.canonical import Json, canonical_json, parse_object
from templates.contract.parsing import JsonValue
from templates.errors import ContractError, ContractMismatch, InvalidTemplate, SealError
from templates.keys.sealing import MasterKeyring
from templates.store.identifiers import InvalidIdentifier
from templates.store.subject_rows import Source

MAGIC = b"VEILEXP1"
CONTRACT_ID_BYTES = 32
LENGTH_BYTES = 4
MAX_HEADER_BYTES = 4096
PURPOSE = "export"
HOLDER_SALT = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class ExportKey:
    """The key of exports: an operator's file, or a secret of this deployment.

    Parameters
    ----------
    keyring
        Seals with its first key, opens with all of them.
    tenant_bound
        True for the deployment's own key: one tenant's export does not open for another.
    """

    keyring: MasterKeyring
    tenant_bound: bool

    @classmethod
    def from_file(cls, path: Path) -> "ExportKey":
        """Load an operator's key file, in the format of the master key file.

        Raises
        ------
        StartError
            If the file cannot be used.
        """
        try:
            return cls(MasterKeyring.load(path), tenant_bound=False)
        except SealError as error:
            raise StartError(f"the export key cannot be used: {error}") from error

    @classmethod
    def from_secret(cls, secret: bytes) -> "ExportKey":
        """Make the key from a secret of the deployment, 32 bytes."""
        keyring = MasterKeyring([secret], source="the deployment's export key")
        return cls(keyring, tenant_bound=True)

    @property
    def key_id(self) -> str:
        """Id of the key that seals."""
        return self.keyring.current

    def _bound_to(self, contract_id: str, tenant: str) -> Sequence[str]:
        return [contract_id, tenant if self.tenant_bound else ""]


@dataclass(frozen=True)
class Exported:
    """One subject as it travels: ``wire`` is a template without the tenant's rotation.

    ``holder_salt`` is None where no key is needed.
    """

    subject_id: str
    contract_id: str
    source: str
    photos: int
    wire: bytes = field(repr=False)
    holder_salt: str | None = None


@dataclass(frozen=True)
class _Header(JsonValue):
    """What stands before the template."""

    what: ClassVar[str] = "the export's header"

    subject_id: str
    contract_id: str
    source: str
    photos: int
    holder_salt: str | None = None

    def to_json(self) -> dict[str, Json]:
        """JSON form, without a salt where no key is needed."""
        return {name: value for name, value in super().to_json().items() if value is not None}


def seal_export(exported: Exported, *, key: ExportKey, tenant: str) -> bytes:
    """Encrypt one subject."""
    named = {entry.name: getattr(exported, entry.name) for entry in fields(_Header)}
    header = canonical_json(_Header(**named).to_json())
    plain = len(header).to_bytes(LENGTH_BYTES, "big") + header + exported.wire
    sealed = key.keyring.seal(
        plain, purpose=PURPOSE, bound_to=key._bound_to(exported.contract_id, tenant)
    )
    return MAGIC + bytes.fromhex(exported.contract_id) + sealed


def open_export(data: bytes, *, key: ExportKey, tenant: str, contract_id: str) -> Exported:
    """Decrypt an export that a client sent.

    Raises
    ------
    InvalidTemplate
        If it is no export, was altered, or was sealed with another key or for another tenant.
    ContractMismatch
        If it belongs to another contract.
    """
    start = len(MAGIC) + CONTRACT_ID_BYTES
    if len(data) < start or not data.startswith(MAGIC):
        raise InvalidTemplate("this is not an export of Veilface")
    named = data[len(MAGIC) : start].hex()
    if named != contract_id:
        raise ContractMismatch(
            f"the export belongs to contract {named[:16]}, the service to {contract_id[:16]}; the "
            "subject must enroll again"
        )
    try:
        plain = key.keyring.open(
            data[start:], purpose=PURPOSE, bound_to=key._bound_to(contract_id, tenant)
        )
    except SealError:
        raise InvalidTemplate(
            "the export does not open: it was altered, or sealed with another export key or for "
            "another tenant"
        ) from None
    return _parse(plain, contract_id)


def _parse(plain: bytes, contract_id: str) -> Exported:
    """Read what was sealed. Whoever has the key may still have sealed nonsense."""
    length = int.from_bytes(plain[:LENGTH_BYTES], "big")
    if not 0 < length <= MAX_HEADER_BYTES or len(plain) <= LENGTH_BYTES + length:
        raise InvalidTemplate("the export's header has an impossible length")
    try:
        header = _Header.from_json(
            parse_object(plain[LENGTH_BYTES : LENGTH_BYTES + length], what="the header")
        )
        exported = Exported(**vars(header), wire=plain[LENGTH_BYTES + length :])
    except (ContractError, InvalidIdentifier) as error:
        raise InvalidTemplate(f"the export's header is broken: {error}") from None
    if exported.contract_id != contract_id:
        raise InvalidTemplate("the export names one contract outside and another one inside")
    if exported.holder_salt is not None and not HOLDER_SALT.fullmatch(exported.holder_salt):
        raise InvalidTemplate("the export's header names no salt of a holder's rotation")
    if exported.source not in list(Source) or not 0 <= exported.photos <= 10:
        raise InvalidTemplate("the export's header is not one of a subject")
    return exported
