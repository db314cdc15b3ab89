"""Client of Veilface, a face-authentication service that never stores a face embedding.

:class:`Client` sends photos; :class:`PrivateClient` embeds and lifts on this machine and sends
private templates only. Both exist with ``Async`` before the name.
"""

from veilface_client.async_client import AsyncClient, AsyncPrivateClient
from veilface_client.client import Client, PrivateClient
from veilface_client.errors import (
    Conflict,
    ConnectionFailed,
    ContractMismatch,
    Forbidden,
    IdempotencyConflict,
    InvalidRequest,
    LiftFailed,
    LiftTimeout,
    LiftUnavailable,
    LockedOut,
    NotEnrolled,
    NotFound,
    PhotoRefused,
    RateLimited,
    ServerFailed,
    ServiceError,
    Unauthorized,
    Unavailable,
    UnexpectedAnswer,
    VeilfaceError,
)
from veilface_client.lifts import Enrollable, Probe
from veilface_client.photos import Photo
from veilface_client.results import (
    Contract,
    Decision,
    Enrollment,
    Export,
    Generator,
    Health,
    Imported,
    Lockout,
    Receipt,
    Subject,
    SubjectPage,
    Unlocked,
)
from veilface_client.retries import Retries

__all__ = [
    "AsyncClient",
    "AsyncPrivateClient",
    "Client",
    "Conflict",
    "ConnectionFailed",
    "Contract",
    "ContractMismatch",
    "Decision",
    "Enrollable",
    "Enrollment",
    "Export",
    "Forbidden",
    "Generator",
    "Health",
    "IdempotencyConflict",
    "Imported",
    "InvalidRequest",
    "LiftFailed",
    "LiftTimeout",
    "LiftUnavailable",
    "LockedOut",
    "Lockout",
    "NotEnrolled",
    "NotFound",
    "Photo",
    "PhotoRefused",
    "PrivateClient",
    "Probe",
    "RateLimited",
    "Receipt",
    "Retries",
    "ServerFailed",
    "ServiceError",
    "Subject",
    "SubjectPage",
    "Unauthorized",
    "Unavailable",
    "UnexpectedAnswer",
    "Unlocked",
    "VeilfaceError",
]
