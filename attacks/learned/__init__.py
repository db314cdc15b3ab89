"""Attacks that train networks on faces of the attacker: needs the ``torch`` extra.

Nothing here imports torch before an attack is made.
"""

from attacks.learned.crops import FaceCrops
from attacks.learned.inverter import invert
from attacks.learned.reconstruction import reconstruct

__all__ = ["FaceCrops", "invert", "reconstruct"]
