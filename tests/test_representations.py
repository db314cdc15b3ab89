"""No dataclass shows numbers of a descriptor, a template or a score, nor bytes, in its repr."""

import dataclasses
import importlib
import inspect
import pkgutil
import typing
from collections.abc import Iterator

import numpy as np
import pytest

from templates.space.subspace import SubspaceBatch
from verify.thresholds import Genuine

PACKAGES = ("templates", "enroll", "verify", "models")
PRIVATE = (np.ndarray, np.generic, SubspaceBatch, bytes, bytearray, memoryview)


def dataclasses_of(name: str) -> Iterator[type]:
    package = importlib.import_module(name)
    for entry in pkgutil.walk_packages(package.__path__, prefix=f"{name}."):
        if ".migrations." in entry.name:
            continue  # scripts that run inside alembic only
        module = importlib.import_module(entry.name)
        for _, kind in inspect.getmembers(module, inspect.isclass):
            if kind.__module__ == module.__name__ and dataclasses.is_dataclass(kind):
                yield kind


def holds_private(annotation: object) -> bool:
    parts = typing.get_args(annotation)
    plain = typing.get_origin(annotation) or annotation
    if plain is typing.Literal:
        return False
    return (isinstance(plain, type) and issubclass(plain, PRIVATE)) or any(
        holds_private(part) for part in parts
    )


def shown(kind: type) -> list[str]:
    """Fields that the repr which `dataclass` generated would show, and should not."""
    if not hasattr(kind.__repr__, "__wrapped__"):
        return []  # repr=False, or a __repr__ of its own
    types = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    return [f.name for f in fields if f.repr and holds_private(types[f.name])]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_dataclass_shows_private_numbers(package: str) -> None:
    kinds = list(dataclasses_of(package))
    assert kinds, f"the package {package} has no dataclass: is it still found?"
    assert {kind.__qualname__: names for kind in kinds if (names := shown(kind))} == {}


def test_scores_do_not_show() -> None:
    scores = np.full(3, 0.123, dtype=np.float32)
    assert "0.123" not in repr(Genuine(scores, scores, np.arange(3), np.zeros(3, np.bool_)))
