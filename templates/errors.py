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
    └── StoreError
        ├── StoreUnavailable     the database does not answer
        └── NotEnrolled          no such subject

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
    """The database does not answer."""


class NotEnrolled(StoreError):
    """The tenant has no such subject."""
