"""Similarities that were computed before: an evaluation goes on where it was interrupted.

Only similarities of pairs are kept: they are what the results are about, and tell no descriptor.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.decoys import Attributes
from templates.keys.private_file import make_folder, replace_public
from templates.space.lifting import Strategy
from verify.evaluation.runs import Run
from verify.evaluation.units import LiftUnit, RawUnit, Unit

FOLDER = "units"


class Checkpoints:
    """Finished units in a folder.

    Parameters
    ----------
    folder
        Of the results; ``units/`` is made inside it.
    base
        All that similarities of every unit depend on: descriptors, pairs, software. A unit that
        was computed on another base is not found.
    sources
        Ids of the decoy sources, of which a unit depends on its own.
    attributes, flipped
        On which units of hybrid+, and raw descriptors with the mirror image, depend.
    """

    def __init__(
        self,
        folder: Path,
        base: dict[str, Any],
        *,
        sources: Sequence[str] = (),
        attributes: Sequence[Attributes] = (),
        flipped: NDArray[np.float32] | None = None,
    ) -> None:
        self._folder = folder / FOLDER
        make_folder(self._folder)
        self._base = base
        self._sources = sources
        self._attributes = [[labels.gender, labels.race] for labels in attributes]
        self._flipped = None if flipped is None else hashlib.sha256(flipped.tobytes()).hexdigest()

    def _file(self, unit: Unit) -> Path:
        facts = asdict(unit)
        if isinstance(unit, LiftUnit):
            facts["source"] = None if unit.source is None else self._sources[unit.source]
            if unit.strategy is Strategy.HYBRID_PLUS:
                facts["attributes"] = self._attributes
        if isinstance(unit, RawUnit) and unit.flip:
            facts["flipped"] = self._flipped
        described = {"base": self._base, "kind": type(unit).__name__, "unit": facts}
        text = json.dumps(described, sort_keys=True)
        return self._folder / f"{hashlib.sha256(text.encode()).hexdigest()[:40]}.npz"

    def load(self, unit: Unit, *, columns: int, pairs: int) -> list[NDArray[np.float64]] | None:
        """Return the similarities of a unit; None where they are not there or not whole."""
        try:
            # Opened here, because NumPy leaves a file open that is no archive.
            with self._file(unit).open("rb") as file, np.load(file, allow_pickle=False) as saved:
                columns_found = [np.asarray(saved[f"column_{i}"]) for i in range(columns)]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        whole = all(
            column.shape == (pairs,) and column.dtype == np.float64 for column in columns_found
        )
        return columns_found if whole else None

    def save(self, unit: Unit, runs: Sequence[Run]) -> None:
        """Write the similarities of a unit, at once or not at all."""
        exact = [run.similarities for run in runs if run.search == "exact"]
        stream = io.BytesIO()
        np.savez(
            stream,
            allow_pickle=False,
            **{f"column_{i}": column for i, column in enumerate(exact)},
        )
        replace_public(self._file(unit), stream.getvalue())
