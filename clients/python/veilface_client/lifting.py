"""Embedding and lifting in this process, by the packages of the service's own program."""

import importlib.util
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from veilface_client.errors import LiftFailed
from veilface_client.results import Contract, Generator, Lift, Probe

if TYPE_CHECKING:
    from enroll.public_contract import PublicContract
    from models.pack import ModelPack
    from templates.decoys import DecoyGenerator

L = TypeVar("L", bound=Lift)
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

    Attributes
    ----------
    inputs
        What :meth:`keep` kept last.

    Raises
    ------
    LiftFailed
        The packages are not installed.
    """

    def __init__(self, pack: str | os.PathLike[str], *, dim: int | None) -> None:
        if importlib.util.find_spec("veilface") is None:
            raise LiftFailed(f"lifting needs veilface on this machine: {_REMEDY}")
        self.inputs: LiftInputs | None = None
        self._folder = Path(pack)
        self._dim = dim
        self._lock = threading.Lock()

    def keep(self, contract: Contract, generator: Generator) -> LiftInputs:
        """Check contract, decoys and pack, and keep them in place of earlier ones."""
        try:
            import veilface  # noqa: F401 - it tells Python where its packages are
            from enroll.public_contract import PublicContract
            from models.errors import ModelError
            from templates.contract.canonical import parse_object
            from templates.decoys import DecoyGenerator
            from templates.errors import VeilfaceError
        except ImportError as error:
            raise LiftFailed(
                f"veilface cannot be imported here ({error}): {_REMEDY}, and call no package of "
                "yours enroll, models or templates"
            ) from None
        with self._lock:
            if self.inputs is not None and self.inputs.contract_id == contract.contract_id:
                return self.inputs
            try:
                public = PublicContract(parse_object(contract.raw, what="the contract"))
                decoys = public.require_decoys(DecoyGenerator.from_bytes(generator.data))
                self.inputs = LiftInputs(public, decoys, public.load_pack(self._folder))
            except (ModelError, VeilfaceError) as error:
                raise LiftFailed(str(error)) from None
            return self.inputs

    def lift(
        self, kind: type[L], inputs: LiftInputs, photos: Sequence[bytes], face: str | None
    ) -> L:
        """Return a probe, or a template that enrolls, of 1 to 10 photos of one person."""
        import numpy as np

        from enroll.enroller import MAX_PHOTOS
        from models.errors import ModelError
        from models.selection import FacePolicy
        from templates.errors import VeilfaceError

        contract = inputs.contract
        probe = issubclass(kind, Probe)
        if len(photos) > MAX_PHOTOS:
            raise LiftFailed(f"a template is made of 1 to {MAX_PHOTOS} photos, not {len(photos)}")
        try:
            m = contract.probe_dimension(self._dim) if probe else contract.binding.m
            samples = inputs.pack.embed_photos(photos, policy=FacePolicy(face or "dominant"))
            rows = np.stack([sample.embedding for sample in samples])
            template = contract.lift(rows, inputs.decoys, m=m, probe=probe)
        except (ModelError, VeilfaceError) as error:
            raise LiftFailed(str(error)) from None
        return kind(template=template, contract_id=inputs.contract_id)
