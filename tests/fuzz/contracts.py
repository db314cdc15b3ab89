"""Hostile contract files: documents that were changed, with a sealed part that was sealed anew."""

import base64
import json
import random
from pathlib import Path
from typing import Any

from templates.contract.document import Contract, _seal_context
from templates.errors import ContractError
from tests.fuzz.documents import deep, hostile, twisted, written
from tests.fuzz.mutations import mutated
from tests.fuzz.tensors import SEALER, repeatable
from tests.templates.contract.test_contract import make_contract


class Contracts:
    """Makes cases for the reader of contract files.

    Parameters
    ----------
    folder
        Where the program's own writer may write a file.
    """

    def __init__(self, folder: Path) -> None:
        file = folder / "sound.contract"
        self.contract: Contract = make_contract()
        with repeatable(random.Random(0)):
            self.contract.save(file, SEALER)
        self.sound = file.read_bytes()
        self.document: dict[str, Any] = json.loads(self.sound)
        sealed = self.document.pop("sealed")
        self.plain = SEALER.open(base64.b64decode(sealed), context=_seal_context(self.document))
        self.document["sealed"] = sealed

    def make(self, rng: random.Random) -> bytes:
        """One case."""
        chance = rng.random()
        if chance < 0.01:
            return self.sound
        if chance < 0.2:
            return mutated(rng, self.sound, [self.sound])
        if chance < 0.4:
            return hostile(rng, self.document)
        if chance < 0.42:
            return deep(rng).encode()
        return self._sealed(rng)

    def _sealed(self, rng: random.Random) -> bytes:
        """A document whose sealed part opens, whatever it says."""
        document = {key: value for key, value in self.document.items() if key != "sealed"}
        if rng.random() < 0.7:
            changed = twisted(rng, document)
            document = changed if isinstance(changed, dict) else document
        inside = self.plain
        if rng.random() < 0.7:
            inside = mutated(rng, inside, [inside])
        try:
            plain = json.loads(written(rng, document))
            context = _seal_context(plain)
        except (ContractError, ValueError, KeyError, TypeError, RecursionError):
            return written(rng, {**document, "sealed": self.document["sealed"]})
        with repeatable(rng):
            sealed = SEALER.seal(inside, context=context)
        return json.dumps({**plain, "sealed": base64.b64encode(sealed).decode()}).encode()
