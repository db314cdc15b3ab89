"""Embedding and lifting in this process, by the packages of the service's own program."""

import importlib.util
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from veilface_client.calls import Face
from veilface_client.errors import LiftFailed, LiftUnavailable
from veilface_client.lifts import Enrollable, Probe
from veilface_client.results import Contract, Generator

if TYPE_CHECKING:
    from enroll.public_contract import PublicContract
    from models.pack import ModelPack
    from templates.decoys import DecoyGenerator

_REMEDY = 'pip install "veilface-client[private]"'


@dataclass(frozen=True, repr=False)
class LiftInputs:
    """What lifting under one contract needs."""

    contract: "PublicContract"
    decoys: "DecoyGenerator"
    pack: "ModelPack"

    @property
    def contract_id(self) -> str:
        """What its templates name."""
        return self.contract.contract_id


class Lifter:
    """Embeds and lifts; keeps in memory what the contract in force needs.

    Parameters
    ----------
    pack
        The user's model pack.
    dim
        Dimension of probes; None: the largest that the contract takes.

    Raises
    ------
    LiftUnavailable
        The packages are not installed.
    """

    def __init__(self, pack: str | os.PathLike[str], *, dim: int | None) -> None:
        if importlib.util.find_spec("veilface") is None:
            raise LiftUnavailable(f"lifting needs veilface on this machine: {_REMEDY}")
        self._folder = Path(pack)
        self._dim = dim
        self._lock = threading.Lock()
        self._inputs: LiftInputs | None = None

    @property
    def inputs(self) -> LiftInputs | None:
        """What :meth:`keep` kept last."""
        return self._inputs

    def keep(self, contract: Contract, generator: Generator) -> LiftInputs:
        """Check contract, decoys and pack, and keep them in place of earlier ones."""
        with self._lock:
            known = self._inputs
            if known is None or known.contract_id != contract.contract_id:
                known = self._inputs = self._checked(contract, generator)
            return known

    def _checked(self, contract: Contract, generator: Generator) -> LiftInputs:
        try:
            import veilface  # noqa: F401 - it tells Python where its packages are
            from enroll.public_contract import PublicContract
            from models.errors import ModelError
            from templates.contract.canonical import parse_object
            from templates.decoys import DecoyGenerator
            from templates.errors import VeilfaceError
        except ImportError as error:
            raise LiftUnavailable(
                f"veilface cannot be imported here ({error}): {_REMEDY}, and call no package of "
                "yours enroll, models or templates"
            ) from None
        try:
            public = PublicContract(parse_object(contract.raw, what="the contract"))
            decoys = public.require_decoys(DecoyGenerator.from_bytes(generator.data))
            return LiftInputs(public, decoys, public.load_pack(self._folder))
        except (ModelError, VeilfaceError) as error:
            raise LiftFailed(str(error)) from None

    def enrollment(
        self, inputs: LiftInputs, photos: Sequence[bytes], *, face: Face | None
    ) -> Enrollable:
        """Return a template of these photos."""
        return Enrollable.of(_lifted(inputs, photos, face, probe=False), inputs.contract_id)

    def probe(self, inputs: LiftInputs, photos: Sequence[bytes], *, face: Face | None) -> Probe:
        """Return a probe of these photos."""
        template = _lifted(inputs, photos, face, probe=True, dim=self._dim)
        return Probe.of(template, inputs.contract_id)


def _lifted(
    inputs: LiftInputs,
    photos: Sequence[bytes],
    face: Face | None,
    *,
    probe: bool,
    dim: int | None = None,
) -> bytes:
    import numpy as np

    from enroll.enroller import MAX_PHOTOS
    from models.errors import ModelError
    from models.photos import embed_photos
    from models.selection import FacePolicy
    from templates.errors import VeilfaceError

    contract = inputs.contract
    if len(photos) > MAX_PHOTOS:
        raise LiftFailed(f"a template is made of 1 to {MAX_PHOTOS} photos, not {len(photos)}")
    try:
        m = contract.probe_dimension(dim) if probe else contract.binding.m
        samples = embed_photos(inputs.pack, photos, policy=FacePolicy(face or "single"))
        rows = np.stack([sample.embedding for sample in samples])
        return contract.lift(rows, inputs.decoys, m=m, probe=probe)
    except (ModelError, VeilfaceError) as error:
        raise LiftFailed(str(error)) from None
