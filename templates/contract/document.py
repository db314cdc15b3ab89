"""The contract: what a template and a threshold belong to, and the file that carries it.

``contract_id`` is the SHA-256 of the canonical JSON of the binding. Every stored template carries
it, and a template of another contract is refused (docs/contract.md). Recalibrating changes the
calibrations, their ids and perhaps the cohort, never the ``contract_id``.

The file is JSON. The cohort is a secret: who has it can search for a probe that passes the cohort
test; and so are the strangers whom templates of clients are held against. Both are sealed inside
the file, and the seal's context holds the digest of everything else in the file, so that an edited
threshold is refused as well.
"""

import base64
import binascii
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from templates.contract.binding import Binding
from templates.contract.canonical import Fields, Json, digest, free_object, parse_object
from templates.contract.levels import (
    LEVEL_NAME,
    Calibration,
    Level,
    Mode,
    Rate,
    check_norm_range,
    norm_range,
)
from templates.contract.nobody import Nobody
from templates.distances import Metric
from templates.errors import ContractError, DecoyError, SealError, Uncalibrated
from templates.keys.bounded_file import read_at_most
from templates.keys.private_file import replace_private
from templates.keys.sealing import Sealer
from templates.space.subspace import SubspaceBatch

__all__ = ["Binding", "Calibration", "Contract", "Level", "Mode", "Rate"]

FORMAT = "veilface-contract"
VERSION = 2
MAX_FILE_BYTES = 256 * 2**20
MAX_CALIBRATIONS = 64
COHORT_SIZES = (2, 4096)
BASIS_TOLERANCE = 1e-4
SEALED = frozenset({"feet", "bases", "people", "means", "spreads", "generator"})


@dataclass(frozen=True, eq=False)
class Contract:
    """A binding with its calibrations, its cohort and its enrollment limits.

    Parameters
    ----------
    binding
        What the ``contract_id`` hashes.
    recorded
        Facts that are recorded but not bound: pack name, detector and its input size, dates.
    calibrations
        One per (mode, metric, probe m); ids are computed here where they are empty, and checked
        where they are not.
    default_level
        Level of a request that names none.
    photo_consistency
        Least raw cosine between any two photos of one enrollment.
    template_foot_point_norm
        Range of ‖p‖ that an honest template of this contract has.
    template_stranger_score
        Largest ``Nobody.score`` that an honest template of this contract has.
    cohort
        Templates that belong to nobody, un-rotated; (C, n) feet and (C, m, n) bases. Secret.
    nobody
        Strangers who do not exist. Secret.

    Raises
    ------
    ContractError
        Where a part contradicts another one.
    """

    binding: Binding
    recorded: Mapping[str, Json]
    calibrations: tuple[Calibration, ...]
    default_level: str
    photo_consistency: float
    template_foot_point_norm: tuple[float, float]
    template_stranger_score: float
    cohort: SubspaceBatch = field(repr=False)
    nobody: Nobody = field(repr=False)

    def __post_init__(self) -> None:
        recorded = free_object(self.recorded, what="the record")
        object.__setattr__(self, "recorded", recorded)
        if not -1.0 <= self.photo_consistency <= 1.0:
            raise ContractError("photo_consistency is a cosine and must lie in [-1, 1]")
        if not LEVEL_NAME.fullmatch(self.default_level):
            raise ContractError("the default level's name must match " + LEVEL_NAME.pattern)
        check_norm_range(self.template_foot_point_norm)
        if not math.isfinite(self.template_stranger_score):
            raise ContractError("template_stranger_score is not a finite number")
        self._check_cohort()
        self.nobody.check(self.binding.n)
        self._check_calibrations()

    def _check_cohort(self) -> None:
        feet, bases = self.cohort.feet, self.cohort.bases
        least, most = COHORT_SIZES
        if not least <= len(self.cohort) <= most:
            raise ContractError(f"the cohort must have {least} to {most} templates")
        if (self.cohort.n, self.cohort.m) != (self.binding.n, self.binding.m):
            raise ContractError("the cohort's dimensions differ from the binding's")
        if not (np.isfinite(feet).all() and np.isfinite(bases).all()):
            raise ContractError("the cohort holds a number that is not finite")
        # No entry of a unit row is larger, and the products below must not overflow: infinity less
        # infinity is no number, which no tolerance refuses.
        if max(np.abs(feet).max(), np.abs(bases).max()) > 1 + BASIS_TOLERANCE:
            raise ContractError("a cohort template holds a number larger than 1")
        gram = np.matmul(bases, bases.transpose(0, 2, 1)) - np.eye(self.binding.m, dtype=np.float32)
        dots = np.matmul(bases, feet[:, :, None])
        if max(np.abs(gram).max(), np.abs(dots).max()) > BASIS_TOLERANCE:
            raise ContractError("a cohort template is not in canonical, orthonormal form")

    def _check_calibrations(self) -> None:
        if not 1 <= len(self.calibrations) <= MAX_CALIBRATIONS:
            raise ContractError(f"a contract needs 1 to {MAX_CALIBRATIONS} calibrations")
        keys = {(entry.mode, entry.metric, entry.probe_m) for entry in self.calibrations}
        if len(keys) != len(self.calibrations):
            raise ContractError("two calibrations share mode, metric and probe m")
        if any(entry.probe_m >= self.binding.n for entry in self.calibrations):
            raise ContractError("a calibration's probe m is not below the embedding dimension")
        names = {level.name for entry in self.calibrations for level in entry.levels}
        if self.default_level not in names:
            raise ContractError("no calibration has the default level")
        contract_id, cohort_id = self.contract_id, self.cohort_id
        identified = tuple(
            entry.identified(contract_id=contract_id, cohort_id=cohort_id)
            for entry in self.calibrations
        )
        for given, computed in zip(self.calibrations, identified, strict=True):
            if given.calibration_id not in ("", computed.calibration_id):
                raise ContractError("a calibration_id is not the hash of its calibration")
        object.__setattr__(self, "calibrations", identified)

    @property
    def contract_id(self) -> str:
        """SHA-256 of the binding's canonical JSON."""
        return self.binding.contract_id

    @cached_property
    def cohort_id(self) -> str:
        """SHA-256 over the cohort's float32 numbers, feet then bases, little-endian."""
        digester = hashlib.sha256(str(self.cohort.bases.shape).encode())
        digester.update(self.cohort.feet.astype("<f4", copy=False).tobytes())
        digester.update(self.cohort.bases.astype("<f4", copy=False).tobytes())
        return digester.hexdigest()

    def calibration(
        self, mode: Mode, metric: Metric | None = None, probe_m: int = 0
    ) -> Calibration:
        """Find the calibration of one mode, metric and probe dimension.

        ``metric`` None takes the first that the contract lists for the mode and dimension.

        Raises
        ------
        Uncalibrated
            Where there is none; the message names those there are.
        """
        for entry in self.calibrations:
            if (entry.mode, entry.probe_m) == (mode, probe_m) and metric in (None, entry.metric):
                return entry
        have = [f"{entry.mode} {entry.metric} m={entry.probe_m}" for entry in self.calibrations]
        wanted = f"{mode} {metric or 'any metric'} with probe m = {probe_m}"
        raise Uncalibrated(f"no calibration for {wanted}; calibrated are: {', '.join(have)}")

    def public(self) -> dict[str, Json]:
        """Everything but the cohort and the strangers, as JSON values."""
        return {
            "contract_id": self.contract_id,
            "binding": self.binding.to_json(),
            "recorded": dict(self.recorded),
            "calibrations": [entry.to_json() for entry in self.calibrations],
            "default_level": self.default_level,
            "photo_consistency": self.photo_consistency,
            "template_foot_point_norm": list(self.template_foot_point_norm),
            "template_stranger_score": self.template_stranger_score,
            "cohort_size": len(self.cohort),
            "cohort_id": self.cohort_id,
        }

    def save(self, path: Path | str, sealer: Sealer) -> None:
        """Write the contract file atomically, readable by its owner only (mode 0600).

        ``public()`` returns the same facts for readers who may not know the cohort.
        """
        document: dict[str, Json] = {"format": FORMAT, "version": VERSION, **self.public()}
        tensors = {
            "feet": np.ascontiguousarray(self.cohort.feet, dtype=np.float32),
            "bases": np.ascontiguousarray(self.cohort.bases, dtype=np.float32),
            **self.nobody.tensors(),
        }
        sealed = sealer.seal(safetensors.numpy.save(tensors), context=_seal_context(document))
        document["cohort"] = base64.b64encode(sealed).decode("ascii")
        replace_private(Path(path), _render(document))

    @classmethod
    def load(cls, path: Path | str, sealer: Sealer) -> "Contract":
        """Read a contract file, treating it as hostile.

        Raises
        ------
        ContractError
            Where the file is absent, too large, of another version, or breaks any rule.
        SealError
            Where the cohort does not open: another master key, or an edited file.
        """
        fields = Fields(
            parse_object(_read_bounded(Path(path)), what="the contract file"), what="it"
        )
        if fields.text("format") != FORMAT or fields.integer("version") != VERSION:
            raise ContractError(f"the file is not a {FORMAT} of version {VERSION}; recalibrate")
        cohort_text = fields.take("cohort")
        if not isinstance(cohort_text, str):
            raise ContractError("the contract file's cohort is not base64 text")
        document = {"format": FORMAT, "version": VERSION, **fields.remaining()}
        binding = Binding.from_json(fields.take("binding"))
        if fields.text("contract_id") != binding.contract_id:
            raise ContractError("the contract_id is not the hash of the binding")
        calibrations = tuple(
            map(Calibration.from_json, fields.items("calibrations", most=MAX_CALIBRATIONS))
        )
        if not all(entry.calibration_id for entry in calibrations):
            raise ContractError("a calibration has no calibration_id")
        cohort, nobody = _open_cohort(cohort_text, sealer, document, binding)
        contract = cls(
            binding=binding,
            recorded=fields.free("recorded"),
            calibrations=calibrations,
            default_level=fields.text("default_level"),
            photo_consistency=fields.number("photo_consistency"),
            template_foot_point_norm=norm_range(fields.take("template_foot_point_norm")),
            template_stranger_score=fields.number("template_stranger_score"),
            cohort=cohort,
            nobody=nobody,
        )
        if fields.integer("cohort_size") != len(cohort):
            raise ContractError("cohort_size is not the size of the cohort")
        if fields.text("cohort_id") != contract.cohort_id:
            raise ContractError("the cohort_id is not the hash of the cohort")
        fields.done()
        return contract


def _seal_context(document: Mapping[str, object]) -> str:
    """Context of the cohort's seal: the contract id and the digest of all that is not sealed."""
    return f"contract-cohort:{document['contract_id']}:{digest(document)}"


def _open_cohort(
    text: str, sealer: Sealer, document: Mapping[str, object], binding: Binding
) -> tuple[SubspaceBatch, Nobody]:
    try:
        sealed = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise ContractError("the contract file's cohort is not base64 text") from None
    try:
        plain = sealer.open(sealed, context=_seal_context(document))
    except SealError as error:
        raise SealError(
            "the contract's cohort does not open: the master key is not the one that sealed it, "
            "or the file was edited; use the right key file, or run the calibration again"
        ) from error
    try:
        tensors = safetensors.numpy.load(plain)
    except (safetensors.SafetensorError, ValueError, KeyError):
        raise ContractError("the contract's cohort is not a safetensors container") from None
    if set(tensors) != SEALED:
        raise ContractError(
            "the contract's cohort does not hold exactly " + ", ".join(sorted(SEALED))
        )
    feet, bases = tensors["feet"], tensors["bases"]
    count = len(feet) if feet.ndim else 0
    if feet.shape != (count, binding.n) or bases.shape != (count, binding.m, binding.n):
        raise ContractError("the contract's cohort has shapes other than the binding's")
    if feet.dtype != np.float32 or bases.dtype != np.float32:
        raise ContractError("the contract's cohort is not float32")
    try:
        nobody = Nobody.from_tensors(tensors)
    except DecoyError:
        raise ContractError("the contract's generator of decoys of nobody is broken") from None
    return SubspaceBatch(np.ascontiguousarray(feet), np.ascontiguousarray(bases)), nobody


def _read_bounded(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = read_at_most(file, MAX_FILE_BYTES)
    except OSError as error:
        raise ContractError(
            f"the contract file cannot be read ({error.strerror}); `veilface calibrate` writes one"
        ) from None
    if len(data) > MAX_FILE_BYTES:
        raise ContractError(f"the contract file is larger than {MAX_FILE_BYTES} bytes")
    return data


def _render(document: Mapping[str, Json]) -> bytes:
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False).encode("utf-8")
