"""Attacks on stored templates and on the decision about probes: one file each.

Whatever a module here declares by :func:`attacks.attack.attack` is run by ``veilface audit
templates``.
"""

from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

from attacks.attack import Attack


def attacks_on_templates() -> Iterator[Attack]:
    """Yield the attacks that the modules of this package declare, by module name."""
    for module in sorted(one.name for one in iter_modules(__path__)):
        for declared in vars(import_module(f"{__name__}.{module}")).values():
            if isinstance(declared, Attack) and declared.run.__module__ == f"{__name__}.{module}":
                yield declared
