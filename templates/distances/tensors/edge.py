"""What comes in from outside this package: arrays or tensors, checked, on one device."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from templates.distances.tensors.subspaces import SubspaceTensors
from templates.errors import InvalidEmbedding, InvalidTemplate, TemplateError
from templates.space.subspace import SubspaceBatch


def place(
    probes: Any, templates: SubspaceBatch | SubspaceTensors, device: str | None
) -> tuple[Tensor | SubspaceTensors, SubspaceTensors]:
    """Check and bring probes and templates to one device.

    Parameters
    ----------
    probes : ndarray (P, n), SubspaceBatch, Tensor (P, n) or SubspaceTensors
    templates : SubspaceBatch or SubspaceTensors
    device
        Where arrays go; ``None`` where the templates are tensors: there.

    Raises
    ------
    TemplateError
        There is no such device, or probes and templates are on two.
    InvalidEmbedding, InvalidTemplate
        A shape does not fit, or a number is not finite.
    """
    there = torch.device("cpu")
    try:
        there = (
            templates.device
            if isinstance(templates, SubspaceTensors)
            else torch.device(device or "cpu")
        )
        theirs = _moved(templates, there)
        mine = _moved(probes, there)
    except (RuntimeError, AssertionError) as error:
        if isinstance(error, torch.OutOfMemoryError):
            raise
        raise TemplateError(
            f"torch cannot use the device {device or there}: {str(error).splitlines()[0]}"
        ) from None
    # Not the device that was asked for: torch tells "cuda" from "cuda:0".
    if mine.device != theirs.device:
        raise TemplateError(f"the probes are on {mine.device}, the templates on {theirs.device}")
    n = theirs.n
    if isinstance(mine, SubspaceTensors):
        if mine.n != n:
            raise InvalidTemplate(f"a probe in R^{mine.n} does not fit templates in R^{n}")
        _check(mine)
    elif mine.ndim != 2 or mine.shape[1] != n:
        raise InvalidEmbedding(f"expected probes of shape (P, {n}), seen {tuple(mine.shape)}")
    elif not torch.isfinite(mine).all():
        raise InvalidEmbedding("a probe holds a number that is not finite")
    _check(theirs)
    return mine, theirs


def _moved(side: Any, device: torch.device) -> Any:
    if isinstance(side, SubspaceBatch):
        return SubspaceTensors.of(side, device)
    if isinstance(side, np.ndarray):
        return torch.tensor(side, dtype=torch.float32, device=device)
    return side.float() if isinstance(side, Tensor) else side


def _check(batch: SubspaceTensors) -> None:
    if not torch.isfinite(batch.feet.sum()) or not torch.isfinite(batch.bases.sum()):
        raise InvalidTemplate("a template holds a number that is not finite")
