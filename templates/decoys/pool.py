"""Real descriptors as decoys: a secret of the deployment, kept sealed.

Who holds the pool can strip its decoys from a template (docs/method.md §4.2), and the people in it
are accepted by every template that uses them (docs/method.md §4.3). `DecoyGenerator` has neither
fault; the pool exists for the paper's strategies, hybrid+ and sub-databases among them.
"""

import hashlib
import json
from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.decoys import container
from templates.decoys.fitting import MIN_DESCRIPTORS
from templates.decoys.generator import DecoyGenerator
from templates.decoys.source import (
    MAX_DIMENSION,
    Attributes,
    DecoySource,
    checked_made_with,
)
from templates.errors import DecoyError
from templates.keys.randomness import Keystream
from templates.keys.sealing import Sealer
from templates.space.embedding import UNIT_TOLERANCE, unit_rows

POOL_MAGIC = b"VEILFACE DECOY POOL 1\n"
POOL_CONTEXT = "veilface decoy pool 1"
MAX_POOL_BYTES = 2 * 1024**3
MAX_ENTRIES = 1_000_000
_FORMAT = "veilface decoy pool"
_VERSION = 2


class DecoyPool:
    """A database W of real descriptors, optionally labelled.

    Parameters
    ----------
    descriptors
        float32, shape (N, n), unit rows (tolerance 1e-3).
    labels
        One `Attributes` per row, or None. Needed for ``unlike``.
    made_with
        `templates.contract.binding.embedding_id` of the pack that gave the descriptors.

    Raises
    ------
    DecoyError
        Wrong shape, a row that is not a finite unit vector, labels that do not fit, or a
        `made_with` that is not 64 lower-case hexadecimal digits.
    """

    def __init__(
        self,
        descriptors: NDArray[np.floating],
        *,
        labels: Sequence[Attributes] | None = None,
        made_with: str | None = None,
    ) -> None:
        array = np.array(descriptors, dtype="<f4", order="C", copy=True)
        if array.ndim != 2 or not 1 <= array.shape[0] <= MAX_ENTRIES:
            raise DecoyError(
                f"a decoy pool needs embeddings of shape (N, n) with 1 ≤ N ≤ {MAX_ENTRIES}; "
                f"seen {array.shape}"
            )
        if not 2 <= array.shape[1] <= MAX_DIMENSION:
            raise DecoyError(f"embeddings must have 2 to {MAX_DIMENSION} numbers each")
        # Written so that a NaN fails it too.
        if not (np.abs(np.linalg.norm(array, axis=1) - 1) <= UNIT_TOLERANCE).all():
            raise DecoyError("the embeddings of a decoy pool are not all finite unit vectors")
        if labels is not None and len(labels) != len(array):
            raise DecoyError(f"{len(labels)} labels for {len(array)} embeddings")
        array.flags.writeable = False
        self._descriptors = array
        self._labels = None if labels is None else tuple(labels)
        self.n: int = array.shape[1]
        self.k: int = self.n
        self.made_with = checked_made_with(made_with)
        self.source_id: str = hashlib.sha256(self._encode()).hexdigest()

    def __len__(self) -> int:
        return len(self._descriptors)

    def __repr__(self) -> str:
        labelled = "unlabelled" if self._labels is None else "labelled"
        return f"DecoyPool({len(self)} {labelled} entries, n={self.n}, id {self.source_id[:12]})"

    @cached_property
    def fitted(self) -> DecoyGenerator:
        """A generator fitted to the entries, always the same for the same pool."""
        if len(self) < MIN_DESCRIPTORS:
            raise DecoyError(
                f"the decoy pool has {len(self)} entries; calibrating needs {MIN_DESCRIPTORS}, "
                "because strangers' scores and lifting clients take a generator that is fitted to "
                "them: build the pool of more photos"
            )
        ordered = self._descriptors[np.lexsort(self._descriptors.T)]
        return DecoyGenerator.fit(ordered).in_coordinates_of_embeddings()

    def reduced(self, k: int) -> Self:
        """Return the pool itself: its templates have all n numbers."""
        if k != self.n:
            raise DecoyError(
                f"a pool has no axes: its templates have all {self.n} numbers, not {k}"
            )
        return self

    def project(self, descriptors: ArrayLike) -> NDArray[np.float32]:
        """Return unit rows (N, n) as they are: with a pool, templates have all n numbers."""
        return unit_rows(np.asarray(descriptors), n=self.n, most=len(np.asarray(descriptors)))

    @property
    def labelled(self) -> bool:
        """Whether the entries have labels, as hybrid+ needs."""
        return self._labels is not None

    @property
    def entries(self) -> tuple[NDArray[np.float32], tuple[Attributes, ...] | None]:
        """The descriptors, shape (N, n) and read-only, and their labels, None where unlabelled.

        They are a secret of the deployment, and never leave memory.
        """
        return self._descriptors, self._labels

    def subset(self, positions: NDArray[np.int64] | Sequence[int]) -> Self:
        """Keep distinct entries, in the order given, with their labels and ``made_with``."""
        chosen = np.asarray(positions)
        labels = self._labels
        return type(self)(
            self._descriptors[chosen],
            labels=None if labels is None else [labels[i] for i in chosen.tolist()],
            made_with=self.made_with,
        )

    def draw(
        self,
        rows: int,
        k: int,
        *,
        stream: Keystream,
        unlike: Sequence[Attributes] | None = None,
        sub_databases: int | None = None,
    ) -> NDArray[np.float32]:
        """Draw entries; see `DecoySource.draw`.

        Raises
        ------
        DecoyError
            Fewer than `k` entries qualify, the pool has no labels, or `unlike` and
            `sub_databases` are asked for together (no strategy of docs/method.md §2.1 does).
        """
        if unlike is not None and sub_databases is not None:
            raise DecoyError("choose either decoys unlike the subject or sub-databases, not both")
        if unlike is not None:
            chosen = self._choose_unlike(rows, k, unlike, stream)
        elif sub_databases is not None:
            chosen = self._choose_in_parts(rows, k, sub_databases, stream)
        else:
            self._require(len(self), k, "in the pool")
            chosen = stream.choose(len(self), rows, k)
        return self._descriptors[chosen].reshape(rows, k, self.n)

    def parts(self, sub_databases: int) -> list[NDArray[np.int64]]:
        """Split the pool into disjoint parts, arrays of entry numbers, whose sizes differ by one.

        The split looks random, and is a function of the pool alone: entries are ordered by a
        hash of the pool's id and their position, so two processes agree without a stored seed.
        """
        if not 1 <= sub_databases <= len(self):
            raise DecoyError(
                f"a pool of {len(self)} entries cannot be split into {sub_databases} parts"
            )
        prefix = f"{self.source_id}|sub-databases|".encode()
        keys = [hashlib.sha256(prefix + str(i).encode()).digest() for i in range(len(self))]
        order = np.array(sorted(range(len(self)), key=keys.__getitem__), dtype=np.int64)
        return list(np.array_split(order, sub_databases))

    def _choose_in_parts(
        self, rows: int, k: int, sub_databases: int, stream: Keystream
    ) -> NDArray[np.int64]:
        parts = self.parts(sub_databases)
        self._require(min(map(len, parts)), k, f"in each of {sub_databases} sub-databases")
        part_of_row = stream.choose(sub_databases, rows, 1).reshape(rows)
        chosen = np.empty((rows, k), dtype=np.int64)
        for number, part in enumerate(parts):
            inside = np.flatnonzero(part_of_row == number)
            if len(inside):
                chosen[inside] = part[stream.choose(len(part), len(inside), k)]
        return chosen

    def _choose_unlike(
        self, rows: int, k: int, unlike: Sequence[Attributes], stream: Keystream
    ) -> NDArray[np.int64]:
        if self._labels is None:
            raise DecoyError(
                "hybrid+ needs a decoy pool with gender and race labels; build the pool from a "
                "folder with FairFace labels"
            )
        if len(unlike) != rows:
            raise DecoyError(f"{len(unlike)} attributes for {rows} rows")
        rows_of: defaultdict[Attributes, list[int]] = defaultdict(list)
        for row, attributes in enumerate(unlike):
            rows_of[attributes].append(row)
        chosen = np.empty((rows, k), dtype=np.int64)
        for attributes, alike in rows_of.items():
            allowed = np.array(
                [i for i, label in enumerate(self._labels) if _differs(label, attributes)],
                dtype=np.int64,
            )
            self._require(len(allowed), k, "of another gender and race in the pool")
            chosen[alike] = allowed[stream.choose(len(allowed), len(alike), k)]
        return chosen

    @staticmethod
    def _require(available: int, k: int, where: str) -> None:
        if available < k:
            raise DecoyError(f"{k} decoys are needed, but only {available} entries are {where}")

    def _encode(self) -> bytes:
        fields: dict[str, str | int] = {"format": _FORMAT, "version": _VERSION}
        if self.made_with is not None:
            fields["made_with"] = self.made_with
        arrays: dict[str, NDArray[np.generic]] = {"descriptors": self._descriptors}
        if self._labels is not None:
            text = json.dumps([[label.gender, label.race] for label in self._labels])
            arrays["labels"] = np.frombuffer(text.encode(), dtype=np.uint8)
        return container.encode(fields, arrays)

    def save(self, path: Path, sealer: Sealer) -> None:
        """Write the pool, sealed, to a file that only its owner may read."""
        container.write_private(
            path, POOL_MAGIC + sealer.seal(self._encode(), context=POOL_CONTEXT)
        )

    @classmethod
    def open(cls, data: bytes, sealer: Sealer) -> Self:
        """Read what `save` wrote; :class:`SealError` where the sealer's key does not open it."""
        plain = sealer.open(data.removeprefix(POOL_MAGIC), context=POOL_CONTEXT)
        fields, arrays = container.decode(plain, what="decoy pool", max_bytes=MAX_POOL_BYTES)
        if (fields.get("format"), fields.get("version")) != (_FORMAT, _VERSION):
            raise DecoyError(
                f"this is not a decoy pool of version {_VERSION}: build it with "
                "`veilface decoys build`"
            )
        labels = None
        if "labels" in arrays:
            labels = [Attributes(*label) for label in json.loads(arrays["labels"].tobytes())]
        return cls(
            arrays["descriptors"].astype(np.float32),
            labels=labels,
            made_with=fields.get("made_with"),  # type: ignore[arg-type]
        )


def _differs(label: Attributes, subject: Attributes) -> bool:
    """Whether an entry is surely of another gender and race; an unlabelled entry is not."""
    pairs = ((label.gender, subject.gender), (label.race, subject.race))
    return all(other is None or (own is not None and own != other) for own, other in pairs)


def load_source(path: Path, sealer: Sealer) -> DecoyPool | DecoyGenerator:
    """Load a sealed pool or a plain generator, told apart by the first bytes of the file."""
    try:
        with path.open("rb") as file:
            is_pool = file.read(len(POOL_MAGIC)) == POOL_MAGIC
    except OSError as error:
        raise DecoyError(f"cannot read {path.name}: {error.strerror}") from error
    if is_pool:
        return DecoyPool.open(container.read_bounded(path, MAX_POOL_BYTES), sealer)
    return DecoyGenerator.load(path)


def client_source(source: DecoySource) -> DecoyGenerator:
    """Return the generator that lifting clients receive: of a pool the one fitted to it."""
    if isinstance(source, DecoyPool):
        return source.fitted
    if not isinstance(source, DecoyGenerator):
        raise DecoyError("clients lift with a decoy generator, and this source is another kind")
    return source
