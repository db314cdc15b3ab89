"""Hostile JSON: values of the wrong kind, keys too many or too few, depth and width without end."""

import copy
import json
import random
import re
from typing import Any

from tests.fuzz.mutations import CAP, NUMBERS

SCALARS: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 16, 4096, 0.5, 1e308, -1e308, 5e-324, float("nan"),
    float("inf"), -float("inf"), 10**300, 10**18, 2**53, 2**53 + 1, -0.0, "", "x", "\ud800", "\x00",
    "a" * 5000, "F16", "F32", "F64", "I64", "BOOL", "0" * 64, "g" * 64, [], {}, [[]], [None],
    {"": None}, {"a": {"b": {"c": {"d": {"e": {}}}}}}, "random", "p2s", "s2s",
)  # fmt: skip

_RAW = re.compile(r'"\\u0001([0-9]+)\\u0001"')


class Raw(str):
    """JSON text that is written as it is."""


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) in a document."""
    pairs: list[tuple[Any, Any]] = []
    waiting = [value]
    while waiting:
        one = waiting.pop()
        keys = (
            list(one) if isinstance(one, dict) else range(len(one)) if isinstance(one, list) else ()
        )
        for key in keys:
            pairs.append((one, key))
            waiting.append(one[key])
    return pairs


def twisted(rng: random.Random, document: Any) -> Any:
    """Change a copy of a document in one place."""
    document = copy.deepcopy(document)
    everywhere = places(document)
    if not everywhere:
        return rng.choice(SCALARS)
    box, key = rng.choice(everywhere)
    match rng.randrange(8):
        case 0:
            del box[key]
        case 1 if isinstance(box, dict):
            box[rng.choice(("", "x", "\ud800", "format", "m", "n", "a" * 5000))] = box[key]
        case 2:
            other, place = rng.choice(everywhere)
            box[key] = copy.deepcopy(other[place])
        case 3 if isinstance(box[key], (int, float)):
            box[key] = box[key] * rng.choice((-1, 0, 2, 0.5, 1e300, 1 + 1e-9)) + rng.choice(
                (0, 1, -1)
            )
        case 4:
            wide = 65 if isinstance(box[key], (dict, list)) else 5000
            box[key] = [box[key]] * rng.choice((1, 2, 3, 17, wide))
        case 5:
            box[key] = rng.choice(NUMBERS)
        case 6:
            box[key] = Raw(deep(rng))
        case _:
            box[key] = rng.choice(SCALARS)
    return document


def deep(rng: random.Random) -> str:
    """Nesting, or width, beyond any document."""
    count = rng.choice((5, 13, 100, 900, 1100, 20_000, 100_000))
    opened, closed = rng.choice((("[", "]"), ('{"a":', "}"), ("[{", "}]"), ("[", "")))
    if rng.random() < 0.5:
        return opened * count + "0" + closed * count
    return "[" + rng.choice(("[],", "{},", "0,", '"",', '{"":0},', "1e5,")) * count + "0]"


def written(rng: random.Random, document: Any) -> bytes:
    """JSON text; what is :class:`Raw` goes in as it is, and a key may be said twice."""
    raw: list[str] = []

    def marked(value: Any) -> Any:
        if isinstance(value, Raw):
            raw.append(value)
            return f"\x01{len(raw) - 1}\x01"
        if isinstance(value, dict):
            return {key: marked(each) for key, each in value.items()}
        return [marked(each) for each in value] if isinstance(value, list) else value

    separators = rng.choice(((",", ":"), (", ", ": ")))
    text = json.dumps(marked(document), separators=separators, ensure_ascii=rng.random() < 0.8)
    room = 2 * CAP

    def as_it_is(match: re.Match[str]) -> str:
        nonlocal room
        value = raw[int(match[1])]
        room -= len(value)
        return value if room > 0 else "0"

    text = _RAW.sub(as_it_is, text)
    if rng.random() < 0.03 and text.startswith("{") and "," in text:
        text = text[:-1] + "," + text[1 : text.index(",")] + "}"
    return text.encode(rng.choice(("utf-8",) * 30 + ("utf-16", "utf-32")), "surrogatepass")


def hostile(rng: random.Random, document: Any) -> bytes:
    """A document that was changed in one to three places."""
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
        document = twisted(rng, document)
    return written(rng, document)
