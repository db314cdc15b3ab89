"""The optional extra that trained attacks need."""

from importlib import import_module
from types import ModuleType

from attacks.errors import AuditError


def need(module: str) -> ModuleType:
    """Import a module of the ``torch`` extra.

    Raises
    ------
    AuditError
        It is not installed; the message names the remedy.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise AuditError(
            f"a trained attack needs the package {error.name}, which is not installed: "
            'pip install "veilface[torch]"'
        ) from error
