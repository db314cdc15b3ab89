"""The contract: what a template and a threshold belong to, and the file that carries it.

``contract_id`` is the SHA-256 of the canonical JSON of the binding. Every stored template carries
it, and a template of another contract is refused (docs/formats.md). Recalibrating changes the
calibrations, their ids and perhaps the cohort, never the ``contract_id``.

The file is JSON. The seed of the cohort that lifted probes are held against is a secret, because
with it one can search for what the cohort passes. It is sealed inside the file. The seal's context
holds the digest of everything else in the file, so that an edited threshold is refused as well.
"""

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, computed_field

from templates.contract.binding import Binding
from templates.contract.canonical import Json, digest, parse_object
from templates.contract.levels import Calibration, Level, LevelName, Mode, Rate
from templates.contract.liveness import LivenessCalibration
from templates.contract.nobody import Nobody
from templates.contract.parsing import Cosine, JsonValue, Share
from templates.contract.verdict import Verdict
from templates.decoys import DecoySource, client_source
from templates.distances import Metric
from templates.errors import ContractError, SealError, Uncalibrated
from templates.keys.private_file import read_bounded, replace_private
from templates.keys.randomness import KEY_BYTES
from templates.keys.sealing import Sealer

__all__ = [
    "Binding",
    "Calibration",
    "Contract",
    "Level",
    "LivenessCalibration",
    "Mode",
    "Rate",
]

FORMAT = "veilface-contract"
VERSION = 4
MAX_FILE_BYTES = 8 * 2**20
MAX_CALIBRATIONS = 64


@dataclass(frozen=True, eq=False)
class Contract(JsonValue):
    """A binding with its calibrations and limits, and the seed of the cohort.

    Parameters
    ----------
    binding
        What the ``contract_id`` hashes.
    recorded
        Facts that are recorded but not bound: pack name, detector and its input size, dates.
    calibrations
        One per (mode, metric, probe m, probe photos); their ids are computed here.
    default_level
        Level of a request that names none.
    photo_consistency, probe_consistency
        Least agreement of the photos of one enrollment, and of one probe
        (``templates.space.agreement``).
    template_foot_point_norm
        Range of ‖p‖ that an honest template of this contract has.
    template_stranger_similarity
        Largest ``Nobody.stranger_similarity`` that an honest template of this contract has.
    cohort_seed
        32 bytes that the cohort of lifted probes is lifted from. Secret.
    verdict
        How private and how accurate the calibration found it; None where that was not measured.
    liveness
        The threshold of passive presentation attack detection; None where there is none.

    Raises
    ------
    ContractError
        Where a part contradicts another one.
    """

    what: ClassVar[str] = "the contract"

    binding: Binding
    recorded: Mapping[str, Json]
    calibrations: Annotated[tuple[Calibration, ...], Field(max_length=MAX_CALIBRATIONS)]
    default_level: LevelName
    photo_consistency: Cosine
    probe_consistency: Cosine
    template_foot_point_norm: tuple[Share, Share]
    template_stranger_similarity: float
    cohort_seed: Annotated[
        bytes, Field(min_length=KEY_BYTES, max_length=KEY_BYTES, exclude=True)
    ] = field(repr=False)
    verdict: Verdict | None = None
    liveness: LivenessCalibration | None = None

    def __post_init__(self) -> None:
        keys = {
            (entry.mode, entry.metric, entry.probe_m, entry.probe_photos)
            for entry in self.calibrations
        }
        if len(keys) != len(self.calibrations):
            raise ContractError("two calibrations share mode, metric, probe m and probe photos")
        if len({entry.metric for entry in self.calibrations if entry.mode == "p2s"}) > 1:
            raise ContractError("points are decided by one metric")
        levels = {level.name for entry in self.calibrations for level in entry.levels}
        if self.default_level not in levels:
            raise ContractError("no calibration has the default level")
        identified = tuple(entry.identified(self.contract_id) for entry in self.calibrations)
        object.__setattr__(self, "calibrations", identified)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def contract_id(self) -> str:
        """SHA-256 of the binding's canonical JSON."""
        return self.binding.contract_id

    @property
    def takes_lifted_probes(self) -> bool:
        """Whether it has a calibration for them."""
        return any(entry.mode == "s2s" for entry in self.calibrations)

    def nobody(self, source: DecoySource) -> Nobody:
        """Templates of nobody under this contract, with the decoys that lifting clients take.

        They are made once: enrollers and verifiers of all tenants share the cohort. `source` is the
        contract's, reduced to its axes; another one is a ContractMismatch.
        """
        binding = self.binding
        binding.require_source(source)
        made = self.__dict__.get("_nobody")
        if made is None:
            made = Nobody(client_source(source), binding.strategy, binding.m, self.cohort_seed)
            self.__dict__["_nobody"] = made
        nobody: Nobody = made
        return nobody

    def calibration(
        self,
        mode: Mode,
        metric: Metric | None = None,
        probe_m: int = 0,
        probe_photos: int = 1,
        *,
        level: str | None = None,
    ) -> Calibration:
        """Find the calibration of one mode, metric, probe dimension and number of photos.

        Parameters
        ----------
        metric
            None takes the first that the contract lists for the mode and dimension.
        probe_photos
            Photos that the probe is the mean of. The calibration of the most photos that are not
            more serves: a mean of more photos is rejected less often.
        level
            Prefer calibrations with this level, if any has it.

        Raises
        ------
        Uncalibrated
            Where there is none; the message names those there are.
        """
        fitting = [
            entry
            for entry in self.calibrations
            if (entry.mode, entry.probe_m) == (mode, probe_m)
            and metric in (None, entry.metric)
            and entry.probe_photos <= probe_photos
        ]
        fitting = [entry for entry in fitting if entry.metric == fitting[0].metric]
        having = [entry for entry in fitting if level in {one.name for one in entry.levels}]
        if fitting:
            return max(having or fitting, key=lambda entry: entry.probe_photos)
        have = [
            f"{entry.mode} {entry.metric} m={entry.probe_m}"
            for entry in self.calibrations
            if entry.probe_photos == 1
        ]
        wanted = f"{mode} {metric or 'any metric'} with probe m = {probe_m}"
        raise Uncalibrated(f"no calibration for {wanted}; calibrated are: {', '.join(have)}")

    def save(self, path: Path | str, sealer: Sealer) -> None:
        """Write the contract file atomically, readable by its owner only (mode 0600).

        :meth:`to_json` gives the same facts, but for the seed.

        Raises
        ------
        ContractError
            Where :meth:`load` would refuse the file.
        """
        self.from_json(self.to_json(), cohort_seed=self.cohort_seed.hex())
        document: dict[str, Json] = {"format": FORMAT, "version": VERSION, **self.to_json()}
        sealed = sealer.seal(self.cohort_seed, context=_seal_context(document))
        document["sealed"] = base64.b64encode(sealed).decode("ascii")
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
        replace_private(Path(path), text.encode())

    @classmethod
    def load(cls, path: Path | str, sealer: Sealer) -> "Contract":
        """Read a contract file: its seal is opened first, so what is parsed is what was sealed.

        Raises
        ------
        ContractError
            Where the file is absent, too large, of another version, or breaks any rule.
        SealError
            Where the sealed part does not open: another master key, or an edited file.
        """
        try:
            data = read_bounded(Path(path), MAX_FILE_BYTES)
        except OSError as error:
            raise ContractError(
                f"the contract file cannot be read ({error.strerror}); `veilface calibrate` writes "
                "one"
            ) from None
        document = parse_object(data, what="the contract file")
        if document.get("format") != FORMAT:
            raise ContractError(f"the file is not a {FORMAT}")
        if document.get("version") != VERSION:
            raise ContractError(
                "the contract file was written by another version of this program: run "
                "`veilface calibrate` again"
            )
        seed = _open_sealed(document.pop("sealed", None), sealer, document)
        del document["format"], document["version"]
        return cls.from_json(document, cohort_seed=seed.hex())


def _seal_context(document: Mapping[str, object]) -> str:
    """Context of the seal: the contract id and the digest of all that is not sealed."""
    return f"contract-cohort:{document.get('contract_id')}:{digest(document)}"


def _open_sealed(text: object, sealer: Sealer, document: Mapping[str, object]) -> bytes:
    try:
        if not isinstance(text, str):
            raise ValueError("no text")
        sealed = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise ContractError("the contract file's sealed part is not base64 text") from None
    try:
        return sealer.open(sealed, context=_seal_context(document))
    except SealError as error:
        raise SealError(
            "the contract does not open: the master key is not the one that sealed it, or the file "
            "was edited; use the right key file, or run the calibration again"
        ) from error
