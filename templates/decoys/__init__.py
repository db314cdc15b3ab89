"""Decoys: the directions that hide a descriptor inside its private template.

A source is either a secret pool of real descriptors or a generator of descriptors of nobody.
"""

from templates.decoys.generator import DecoyGenerator
from templates.decoys.pool import DecoyPool, client_source, load_source
from templates.decoys.source import Attributes, DecoySource

__all__ = [
    "Attributes",
    "DecoyGenerator",
    "DecoyPool",
    "DecoySource",
    "client_source",
    "load_source",
]
