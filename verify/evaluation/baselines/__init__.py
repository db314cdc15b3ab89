"""Cancelable hashing schemes of the literature, to compare private templates with."""

from verify.evaluation.baselines.hashing import (
    Hash,
    hash_comparison,
    hash_similarities,
    packed_bytes,
)

__all__ = ["Hash", "hash_comparison", "hash_similarities", "packed_bytes"]
