"""The exceptions of templates, enrollment, verification and the service.

::

    VeilfaceError
    ├── TemplateError
    │   ├── InvalidTemplate      wire bytes, a subspace or a probe that breaks the format
    │   ├── InvalidEmbedding     a raw probe that is not a finite unit vector of n numbers
    │   ├── LiftingError         a lifting request that cannot be met
    │   └── DecoyError           a decoy source that is broken, or lacks what a strategy needs
    ├── ContractError            a contract file that is broken
    │   ├── ContractMismatch     a template, pack or decoy source of another contract
    │   └── Uncalibrated         no calibration for the requested mode, metric, dimension or level
    ├── SealError                a ciphertext that does not open, or a key that cannot be used
    ├── StoreError
    │   ├── StoreUnavailable     the database does not answer
    │   │   └── StoreBusy        it answers, but this request not now
    │   ├── InvalidIdentifier    a subject id, tenant name or cursor that breaks the rules [1]
    │   ├── UnknownTenant        no tenant of this name [1]
    │   │   └── RetiredRotation  no rotation key of this epoch any more [11]
    │   ├── LockedOut            too many failed attempts on the subject [12]
    │   ├── Replayed             a challenge or a token that was seen before [12]
    │   ├── BrokenAuditLog       an audit log whose head or key is missing or forged [13]
    │   └── EnrollmentConflict   another template than the one that a write may replace [17]
    ├── InconsistentImages [3]   photos that do not show one and the same person
    ├── DatasetError [4]         a dataset that cannot be read
    ├── EvaluationError [5]      an evaluation that cannot be made as it was asked for
    ├── ClusterError [6]         a Dask cluster that cannot be used
    ├── AuditError [7]           an attack or an audit that cannot be made as it was asked for
    ├── StartError [8]           the service or a command cannot start
    ├── PreparationError [9]     decoys or a contract that cannot be made
    └── CommandError [10]        a command that cannot be done
        └── UsageError           wrong usage of a command

Each is defined here, or next to what raises it: [1] ``templates.store.identifiers``,
[3] ``templates.space.agreement``, [4] ``verify.datasets``,
[5] ``verify.evaluation.plan``, [6] ``verify.evaluation.cluster``, [7] ``attacks.outcomes``,
[8] ``api.http.errors``, [9] ``verify.preparation``, [10] ``api.cli.errors``,
[11] ``templates.store.tenants``, [12] ``templates.store.lockout``,
[13] ``templates.store.audit_chain``, [17] ``templates.store.subjects``.

Messages name the cause and the remedy. They never hold a number of a descriptor, a template or
an image, nor a key.
"""


class VeilfaceError(Exception):
    """Base of all errors that Veilface raises on purpose outside ``models``."""


class TemplateError(VeilfaceError):
    """A template, probe or decoy source that cannot be used."""


class InvalidTemplate(TemplateError):
    """Template bytes, or a subspace, that break the format or its tolerances."""


class InvalidEmbedding(TemplateError):
    """A raw probe that is not a finite unit vector of the contract's dimension."""


class LiftingError(TemplateError):
    """A lifting request that cannot be met."""


class DecoyError(TemplateError):
    """A decoy source that is broken, or that lacks what a strategy needs."""


class ContractError(VeilfaceError):
    """A contract file that is broken."""


class ContractMismatch(ContractError):
    """A template, a pack or a decoy source that belongs to another contract."""


class Uncalibrated(ContractError):
    """The contract has no calibration for what was asked."""


class SealError(VeilfaceError):
    """A ciphertext that does not open, or a key that cannot be used."""


class StoreError(VeilfaceError):
    """The template store cannot do what was asked."""


class StoreUnavailable(StoreError):
    """The database does not respond."""


class StoreBusy(StoreUnavailable):
    """The database answers, but cannot do this now: the same request may succeed in a moment."""
