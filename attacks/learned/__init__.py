"""Attacks that learn: a network from template to embedding. They need the extra ``torch``.

A network is trained on the attacker's own faces, lifted as the service lifts, and meets the
victims' templates once, at the end.
"""

from attacks.learned.inverter import invert

__all__ = ["invert"]
