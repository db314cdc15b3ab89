"""Client of Veilface, a face-authentication service that never stores a face embedding.

:class:`Client` sends photos; :class:`PrivateClient` embeds and lifts on this machine and sends
private templates only. Both exist with ``Async`` before the name. What the service answers is in
:mod:`veilface_client.results`.
"""

from veilface_client import results
from veilface_client.client import AsyncClient, AsyncPrivateClient, Client, PrivateClient
from veilface_client.errors import (
    Conflict,
    ConnectionFailed,
    ContractMismatch,
    EnrollmentConflict,
    Forbidden,
    InvalidRequest,
    LiftFailed,
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
from veilface_client.flows import Retries, new_holder_key
from veilface_client.photos import Photo
from veilface_client.results import Enrollable, Probe

__all__ = [
    "AsyncClient",
    "AsyncPrivateClient",
    "Client",
    "Conflict",
    "ConnectionFailed",
    "ContractMismatch",
    "Enrollable",
    "EnrollmentConflict",
    "Forbidden",
    "InvalidRequest",
    "LiftFailed",
    "LiftUnavailable",
    "LockedOut",
    "NotEnrolled",
    "NotFound",
    "Photo",
    "PhotoRefused",
    "PrivateClient",
    "Probe",
    "RateLimited",
    "Retries",
    "ServerFailed",
    "ServiceError",
    "Unauthorized",
    "Unavailable",
    "UnexpectedAnswer",
    "VeilfaceError",
    "new_holder_key",
    "results",
]
