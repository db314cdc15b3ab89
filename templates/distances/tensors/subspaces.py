"""Templates as tensors, and the products of their rows that every distance starts from."""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Self

import torch
from torch import Tensor

from templates.errors import InvalidTemplate
from templates.space.subspace import SubspaceBatch

TILE_BYTES = {"cpu": 8 << 20, "cuda": 128 << 20}
"""Size of the products that are made at a time; the whole computation holds a few times that."""


@dataclass(frozen=True, eq=False, repr=False)
class SubspaceTensors:
    """N templates of one dimension on one device.

    Parameters
    ----------
    feet : Tensor of float32, shape (N, n)
    bases : Tensor of float32, shape (N, m, n)
    """

    feet: Tensor
    bases: Tensor

    def __post_init__(self) -> None:
        if self.bases.ndim != 3 or self.feet.shape != (self.bases.shape[0], self.bases.shape[2]):
            raise InvalidTemplate(
                f"feet of shape {tuple(self.feet.shape)} do not fit bases of shape "
                f"{tuple(self.bases.shape)}"
            )
        if self.feet.dtype != torch.float32 or self.bases.dtype != torch.float32:
            raise InvalidTemplate(
                f"templates are float32, not {self.feet.dtype} and {self.bases.dtype}"
            )

    @classmethod
    def of(cls, batch: SubspaceBatch, device: torch.device | str) -> Self:
        """Copy a batch to a device."""
        return cls(
            torch.tensor(batch.feet, device=device), torch.tensor(batch.bases, device=device)
        )

    def __repr__(self) -> str:
        return f"SubspaceTensors({len(self)} of n={self.n}, m={self.m} on {self.device})"

    def __len__(self) -> int:
        return self.feet.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Self:
        return type(self)(self.feet[index], self.bases[index])

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return self.bases.shape[2]

    @property
    def m(self) -> int:
        """Subspace dimension."""
        return self.bases.shape[1]

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.feet.device


def tile_bytes(device: torch.device) -> int:
    """Size of one tile of products on a device."""
    return TILE_BYTES.get(device.type, TILE_BYTES["cuda"])


def chunks(count: int, numbers_each: int, device: torch.device) -> Iterator[slice]:
    """Split ``count`` pairs so that ``numbers_each`` float64 numbers per pair fit in a tile."""
    step = max(1, tile_bytes(device) // (8 * numbers_each))
    return (slice(start, min(start + step, count)) for start in range(0, count, step))


def stacked(feet: Tensor, bases: Tensor) -> Tensor:
    """Rows [p; D] with all feet first, then all first directions, shape ((m + 1) · N, n).

    In this order the products of one component lie side by side for neighbouring templates, as
    the threads of a GPU want to read them.
    """
    return torch.cat([feet[None], bases.transpose(0, 1)]).flatten(0, 1)


def products(mine: tuple[Tensor, Tensor], theirs: tuple[Tensor, Tensor]) -> Tensor:
    """Cross-Gram matrix of rows [p; D] and [q; E], shape (m_D + 1, P, m_E + 1, T).

    Parameters
    ----------
    mine, theirs : pair of Tensor
        Feet (P, n) and bases (P, m_D, n), feet (T, n) and bases (T, m_E, n).
    """
    (p, d), (q, e) = mine, theirs
    matrix = stacked(p, d) @ stacked(q, e).T
    return matrix.view(d.shape[1] + 1, len(p), e.shape[1] + 1, len(q))


def blocks(gram: Tensor) -> Tensor:
    """Products of every pair, probe by probe, shape (P · T, m_D + 1, m_E + 1)."""
    return gram.permute(1, 3, 0, 2).flatten(0, 1).contiguous()


def fused(device: torch.device, m: int) -> ModuleType | None:
    """Return the Triton kernels where they can solve systems of m unknowns, else None.

    On the CPU they run in Triton's interpreter (``TRITON_INTERPRET=1``), for tests only.
    """
    if device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        return None
    try:
        module = importlib.import_module("templates.distances.tensors.fused")
    except ImportError:  # torch has wheels without triton
        return None
    return module if m <= module.LARGEST else None


@contextmanager
def ieee_products(device: torch.device) -> Iterator[None]:
    """Compute float32 products in float32: no TF32, no bfloat16, no autocast, no gradients.

    Notes
    -----
    torch has an older and a newer setting for this and refuses to read the older one where only
    the newer has been changed. Setting the older one sets both.
    """
    backends = [
        getattr(part, "matmul", None) for part in (torch.backends.cuda, torch.backends.mkldnn)
    ]
    newer = [getattr(backend, "fp32_precision", None) for backend in backends]
    try:
        older = torch.get_float32_matmul_precision()
    except RuntimeError:
        older = None
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.no_grad(), torch.autocast(device.type, enabled=False):
            yield
    finally:
        if older is not None:
            torch.set_float32_matmul_precision(older)
        else:
            for backend, precision in zip(backends, newer, strict=True):
                if backend is not None:
                    backend.fp32_precision = precision
