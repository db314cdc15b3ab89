"""The tree in the docstring of ``templates.errors`` is the tree of classes."""

import re
from collections.abc import Iterator
from importlib import import_module

from templates import errors

ROOMS = ("templates", "enroll", "verify", "attacks", "api")


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
        if child.__module__.split(".")[0] in ROOMS:
            yield child.__name__, kind.__name__
            yield from defined(child)


def test_the_tree_is_true() -> None:
    assert errors.__doc__ is not None
    for module in re.findall(r"``([a-z]+\.[\w.]+)``", errors.__doc__):
        import_module(module)
    tree = sorted(drawn(errors.__doc__), key=str)
    assert tree == sorted([("VeilfaceError", None), *defined(errors.VeilfaceError)], key=str)
