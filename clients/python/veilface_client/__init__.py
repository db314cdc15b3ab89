"""Client of Veilface, a face-authentication service that never stores a face embedding.

:class:`Client` sends photos, and so does :class:`AsyncClient` on asyncio; :class:`PrivateClient`
embeds and lifts on this machine and sends private templates only. What the service answers is in
:mod:`veilface_client.results`.
"""

from veilface_client import results
from veilface_client.calls import Retries, new_holder_key
from veilface_client.client import AsyncClient, Client, PrivateClient
from veilface_client.errors import (
    ConnectionFailed,
    ContractMismatch,
    EnrollmentConflict,
    Forbidden,
    LiftFailed,
    LockedOut,
    NotEnrolled,
    PhotoRefused,
    RateLimited,
    ServiceError,
    Unauthorized,
    Unavailable,
    UnexpectedAnswer,
    VeilfaceError,
)
from veilface_client.photos import Photo
from veilface_client.results import Enrollable, Probe

__all__ = [
    "AsyncClient",
    "Client",
    "ConnectionFailed",
    "ContractMismatch",
    "Enrollable",
    "EnrollmentConflict",
    "Forbidden",
    "LiftFailed",
    "LockedOut",
    "NotEnrolled",
    "Photo",
    "PhotoRefused",
    "PrivateClient",
    "Probe",
    "RateLimited",
    "Retries",
    "ServiceError",
    "Unauthorized",
    "Unavailable",
    "UnexpectedAnswer",
    "VeilfaceError",
    "new_holder_key",
    "results",
]
