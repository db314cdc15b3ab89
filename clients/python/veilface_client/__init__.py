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
from veilface_client.holder_keys import new_holder_key
from veilface_client.lifts import Enrollable, Probe
from veilface_client.photos import Photo
from veilface_client.results import (
    Challenge,
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
    Token,
    TokenOutcome,
    Unlocked,
)
from veilface_client.retries import Retries

__all__ = [
    "AsyncClient",
    "AsyncPrivateClient",
    "Challenge",
    "Client",
    "Conflict",
    "ConnectionFailed",
    "Contract",
    "ContractMismatch",
    "Decision",
    "Enrollable",
    "Enrollment",
    "EnrollmentConflict",
    "Export",
    "Forbidden",
    "Generator",
    "Health",
    "Imported",
    "InvalidRequest",
    "LiftFailed",
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
    "Token",
    "TokenOutcome",
    "Unauthorized",
    "Unavailable",
    "UnexpectedAnswer",
    "Unlocked",
    "VeilfaceError",
    "__version__",
    "new_holder_key",
]

__version__: str


def __getattr__(name: str) -> str:
    # Read when it is asked for: the modules also work where no distribution is installed.
    if name == "__version__":
        from importlib.metadata import version

        return version("veilface-client")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
