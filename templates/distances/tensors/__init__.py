"""Distances on torch tensors: the same numbers as ``templates.distances``, on a GPU.

Import it only where a device is asked for: torch is an optional extra of the project.
"""

from templates.distances.tensors.subspaces import SubspaceTensors
from templates.distances.tensors.tiles import counts_within, nearest, pairwise

__all__ = ["SubspaceTensors", "counts_within", "nearest", "pairwise"]
