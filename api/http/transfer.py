"""Export and import of one subject.

An export is::

    "VEILEXP1" | contract id (32 bytes) | sealed JSON of :class:`Exported`

The sealed part (``MasterKeyring.seal``: AES-256-GCM, with the id of its key in front) opens only
with the same contract id, and where the deployment's own key sealed it, only for the same tenant.

The template inside is without the tenant's rotation, float32: it gets one of the importing
tenant's, and no second rounding to half precision takes place. A holder's rotation stays, and its
salt travels along: the enrollment needs the same key after the import.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from api.http.errors import StartError
from templates.errors import ContractMismatch, InvalidTemplate, SealError
from templates.keys.sealing import MasterKeyring
from templates.store.schema import Source

MAGIC = b"VEILEXP1"
CONTRACT_ID_BYTES = 32
PURPOSE = "export"


@dataclass(frozen=True)
class ExportKey:
    """The key of exports: an operator's file, or a secret of this deployment.

    The deployment's own is `tenant_bound`: one tenant's export does not open for another.
    """

    keyring: MasterKeyring
    tenant_bound: bool

    @classmethod
    def from_file(cls, path: Path) -> "ExportKey":
        """Load an operator's key file, in the format of the master key file."""
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

    def bound_to(self, contract_id: str, tenant: str) -> list[str]:
        """What an export opens for."""
        return [contract_id, tenant if self.tenant_bound else ""]


class Exported(BaseModel):
    """One subject as it travels: ``wire`` is a template without the tenant's rotation.

    ``holder_salt`` is None where no key is needed.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", ser_json_bytes="base64", val_json_bytes="base64"
    )

    subject_id: str
    source: Source
    photos: Annotated[int, Field(ge=0, le=10)]
    wire: bytes = Field(repr=False)
    holder_salt: Annotated[str, Field(pattern="^[0-9a-f]{32}$")] | None = None


def seal_export(exported: Exported, *, key: ExportKey, contract_id: str, tenant: str) -> bytes:
    """Encrypt one subject."""
    plain = exported.model_dump_json().encode()
    sealed = key.keyring.seal(plain, purpose=PURPOSE, bound_to=key.bound_to(contract_id, tenant))
    return MAGIC + bytes.fromhex(contract_id) + sealed


def open_export(data: bytes, *, key: ExportKey, tenant: str, contract_id: str) -> Exported:
    """Decrypt an export that a client sent; `InvalidTemplate` where it does not open here."""
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
            data[start:], purpose=PURPOSE, bound_to=key.bound_to(contract_id, tenant)
        )
        return Exported.model_validate_json(plain)
    except SealError:
        raise InvalidTemplate(
            "the export does not open: it was altered, or sealed with another export key or for "
            "another tenant"
        ) from None
    except ValidationError:
        # A holder of the key may still have sealed nonsense.
        raise InvalidTemplate("the export holds no subject") from None
