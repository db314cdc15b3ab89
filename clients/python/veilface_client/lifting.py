"""Embedding and lifting in this process, by the packages of the service's own program."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

from veilface_client.errors import LiftFailed
from veilface_client.results import Contract, Generator, Lift, Probe

if TYPE_CHECKING:
    from enroll.public_contract import PublicContract
    from models.pack import ModelPack
    from templates.decoys import DecoyGenerator

L = TypeVar("L", bound=Lift)


@dataclass(frozen=True, repr=False)
class Lifter:
    """Embeds and lifts under one contract."""

    contract: "PublicContract"
    decoys: "DecoyGenerator"
    pack: "ModelPack"

    @classmethod
    def load(cls, pack: Path, contract: Contract, generator: Generator) -> Self:
        """Check contract, decoys and the user's pack against each other.

        Raises
        ------
        LiftFailed
            One does not serve, or the packages are not installed.
        """
        with _failing_as_lift():
            from enroll.public_contract import PublicContract
            from templates.contract.canonical import parse_object
            from templates.decoys import DecoyGenerator

            public = PublicContract.read(parse_object(contract.raw, what="the contract"))
            decoys = public.require_decoys(DecoyGenerator.from_bytes(generator.data))
            return cls(public, decoys, public.load_pack(pack))

    def lift(self, kind: type[L], photos: Sequence[bytes], dim: int | None, face: str | None) -> L:
        """Return a probe, or a template that enrolls, of 1 to 10 photos of one person.

        `dim` is the dimension of a probe; None: the largest that the contract takes.
        """
        with _failing_as_lift():
            import numpy as np

            from enroll.enroller import MAX_PHOTOS
            from models.selection import FacePolicy

            if len(photos) > MAX_PHOTOS:
                raise LiftFailed(
                    f"a template is made of 1 to {MAX_PHOTOS} photos, not {len(photos)}"
                )
            probe = issubclass(kind, Probe)
            m = self.contract.probe_dimension(dim) if probe else self.contract.binding.m
            samples = self.pack.embed_photos(photos, policy=FacePolicy(face or "dominant"))
            rows = np.stack([sample.embedding for sample in samples])
            template = self.contract.lift(rows, self.decoys, m=m, probe=probe)
            return kind(template=template, contract_id=self.contract.contract_id)


@contextmanager
def _failing_as_lift() -> Iterator[None]:
    try:
        import veilface  # noqa: F401 - it tells Python where its packages are
        from models.errors import ModelError
        from templates.errors import VeilfaceError

        try:
            yield
        except (ModelError, VeilfaceError) as error:
            raise LiftFailed(str(error)) from None
    except ImportError as error:
        raise LiftFailed(
            f"veilface cannot be imported here ({error}): pip install "
            '"veilface-client[private]", and call no package of yours enroll, models or templates'
        ) from None
