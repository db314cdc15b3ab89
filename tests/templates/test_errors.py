"""The trees in the docstrings of the errors modules are the trees of classes."""

import re
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType

import pytest

from models import errors as model_errors
from templates import errors as template_errors

PACKAGES = ("templates", "models", "enroll", "verify", "attacks", "api")


def drawn(text: str) -> Iterator[tuple[str, str | None]]:
    """Every class of the tree with the one it hangs from."""
    above: list[str] = []
    for line in text.splitlines():
        found = re.match(r"    ([│├└─ ]*)([A-Z]\w+)", line)
        if found is not None:
            depth = len(found[1]) // 4
            yield found[2], above[depth - 1] if depth else None
            above[depth:] = [found[2]]


def defined(kind: type[Exception]) -> Iterator[tuple[str, str | None]]:
    """Every subclass that the packages define, with its base."""
    for child in kind.__subclasses__():
        if child.__module__.split(".")[0] in PACKAGES:
            yield child.__name__, kind.__name__
            yield from defined(child)


@pytest.mark.parametrize(
    ("errors", "root"),
    [(template_errors, template_errors.VeilfaceError), (model_errors, model_errors.ModelError)],
)
def test_the_tree_is_true(errors: ModuleType, root: type[Exception]) -> None:
    assert errors.__doc__ is not None
    for module in re.findall(r"``([a-z]+\.[\w.]+)``", errors.__doc__):
        import_module(module)
    tree = sorted(drawn(errors.__doc__), key=str)
    assert tree == sorted([(root.__name__, None), *defined(root)], key=str)
