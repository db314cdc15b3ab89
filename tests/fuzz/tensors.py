"""Hostile safetensors: templates, exports and decoy sources with headers and numbers that lie."""

import json
import random
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.contract import wire
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.fuzz.documents import Raw, hostile
from tests.fuzz.mutations import mutated, some, span

CONTRACT = "ab" * 32

SPECIAL = (0.0, -0.0, 1.0, -1.0, 1.0001, 2.0, 1e-45, 1e-38, 6e4, 3e38, -3e38,
           float("nan"), float("inf"), -float("inf"))  # fmt: skip


def subspace(n: int, m: int, seed: int = 0, *, norm: float = 0.5) -> SubspaceBatch:
    """A template of nobody."""
    stream = Keystream.seeded("fuzz", seed)
    point = stream.normal((n,))
    made = SubspaceBatch.through(
        point / np.linalg.norm(point), stream.normal((m, n)), stream=stream
    )
    foot = made.foot.astype(np.float64)
    foot -= made.basis.T.astype(np.float64) @ (made.basis @ foot)
    return SubspaceBatch((foot * norm / np.linalg.norm(foot)).astype(np.float32), made.basis)


def container(header: bytes, payload: bytes) -> bytes:
    return len(header).to_bytes(8, "little") + header + payload


def taken_apart(data: bytes) -> tuple[Any, bytes]:
    """Header and payload of a sound file."""
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def hostile_numbers(rng: random.Random, payload: bytes) -> bytes:
    """Numbers that are no template's: not finite, not orthonormal, dependent, too long."""
    size = rng.choice((2, 4))
    kind: Any = {2: "<f2", 4: "<f4"}[size]
    numbers: NDArray[Any] = np.frombuffer(payload[: len(payload) // size * size], kind).copy()
    if not numbers.size:
        return payload
    part = span(rng, bytes(numbers.size))
    with np.errstate(all="ignore"):
        match rng.randrange(7):
            case 0:
                numbers[part] = rng.choice(SPECIAL)
            case 1:
                numbers[rng.randrange(numbers.size)] = rng.choice(SPECIAL)
            case 2:
                numbers *= kind[1:] and np.dtype(kind).type(
                    rng.choice((-1, 0.5, 1.0005, 1.01, 100))
                )
            case 3:
                numbers[part] = numbers[: part.stop - part.start][: numbers[part].size]
            case 4:
                numbers[part] = 0
            case 5:
                numbers[part] += np.dtype(kind).type(rng.choice((1e-7, 1e-5, 1e-4, 1e-3)))
            case _:
                rng.shuffle(listed := numbers.tolist())
                numbers[:] = listed
    return numbers.tobytes() + payload[len(numbers) * size :]


def hostile_tensors(rng: random.Random, data: bytes, others: list[bytes]) -> bytes:
    """A safetensors file that was changed in its header, its numbers, or anywhere."""
    chance = rng.random()
    if chance < 0.02:
        return data
    if chance < 0.3:
        return mutated(rng, data, others)
    header, payload = taken_apart(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    if chance < 0.65:
        text = hostile(rng, header if rng.random() < 0.9 else {**header, "more": Raw("[" * 2000)})
    if chance > 0.6:
        for _ in range(some(rng, 3)):
            payload = hostile_numbers(rng, payload)
    text += b" " * (rng.choice((-len(text) % 8,) * 9 + (0, 1, 5000)))
    whole = container(text, payload)
    if rng.random() < 0.1:
        lie = rng.choice(
            (0, 1, len(text) - 1, len(text) + 1, len(whole), 4096, 4097, 2**32, 2**63, 2**64 - 1)
        )
        whole = struct.pack("<Q", lie) + whole[8:]
    return whole


class Templates:
    """Makes cases for the template decoder."""

    def __init__(self, contract_id: str = CONTRACT) -> None:
        shapes = ((2, 1), (8, 3), (16, 3), (16, 2), (64, 8), (128, 16))
        self.sound = [
            wire.encode(subspace(n, m, norm=norm), contract_id=contract_id, dtype=dtype)
            for n, m in shapes
            for norm in (0.5, 1.0)
            for dtype in wire.TOLERANCES
        ]
        self.large = [
            wire.encode(subspace(4096, 128), contract_id=contract_id, dtype="float32"),
            wire.encode(subspace(129, 128), contract_id=contract_id, dtype="float16"),
        ]

    def make(self, rng: random.Random) -> bytes:
        """One case."""
        data = rng.choice(self.large if rng.random() < 0.002 else self.sound)
        return hostile_tensors(rng, data, self.sound)
