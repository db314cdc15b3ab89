"""Synthetic faces whose attributes are in their descriptors, and faces that are raw noise."""

import numpy as np

from attacks.attributes.faces import LabelledFaces

CLASSES = {"gender": ("Male", "Female"), "race": ("A", "B", "C")}


def faces(count: int, *, n: int = 64, seed: int = 0, strength: float = 0.28) -> LabelledFaces:
    """Unit rows around directions of their gender and race, of length ``strength`` each.

    With strength 0 the labels have nothing to do with the rows: the negative control.
    """
    chance = np.random.default_rng(seed)
    directions = np.random.default_rng(99).standard_normal((5, n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gender = chance.integers(2, size=count)
    race = chance.choice(3, p=(0.5, 0.3, 0.2), size=count)
    noise = chance.standard_normal((count, n)) / np.sqrt(n)
    rows = noise + strength * (directions[gender] + directions[2 + race])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return LabelledFaces(rows.astype(np.float32), {"gender": gender, "race": race}, CLASSES)
