"""Real photos, decoys and a contract for a deployment whose leaks are looked for."""

import io
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from models.cache import EmbeddingCache
from models.decoding import decode_image
from models.errors import FaceError
from models.extraction import Extractor
from models.pack import ModelPack
from templates.decoys import DecoyPool
from templates.keys.sealing import MasterKeyring, Sealer
from templates.space.lifting import Strategy
from verify import CalibrationOptions, calibrate
from verify.preparation import binding_for

PEOPLE = 4
PHOTOS = 3
M = 8
PROBE_M = 4


@dataclass(frozen=True, repr=False)
class Photo:
    """A photo that is sent, and what could leak of it."""

    data: bytes
    pixels: NDArray[np.uint8]
    crop: NDArray[np.uint8]
    embedding: NDArray[np.float32]


@dataclass(frozen=True, repr=False)
class Material:
    """What both databases' runs share; ``folder`` has keys, contract, decoys and a cache."""

    folder: Path
    pack_dir: Path
    pool: NDArray[np.float32]
    source: DecoyPool
    contract_id: str
    enrolled: list[list[Photo]]
    probes: list[Photo]
    large: Photo
    mean: NDArray[np.float32]
    scale: NDArray[np.float32]


def make_material(
    folder: Path, *, pack_dir: Path, people: Path, crops: Path, decoys: Path
) -> Material:
    """Photos with their embeddings, a pool of real decoys and a contract of it."""
    pack = ModelPack.load(pack_dir, threads=2)
    keyring = MasterKeyring.create(folder / "master.key")
    sealer = Sealer(keyring)
    cache = EmbeddingCache(folder / "cache.veil", sealer)
    names = sorted(path.name for path in people.iterdir())
    sitters = list(islice((name for name in names if _usable(pack, people / name)), PEOPLE))
    others = [name for name in names if name not in sitters]

    faces = sorted((decoys / "train").glob("*.jpg"))[::40][:110]
    pool = Extractor(pack, cache=cache).extract(faces).embeddings
    source = DecoyPool(pool)
    source.save(folder / "decoys.veil", sealer)
    strangers = [name for name in others if len(list((crops / name).glob("*.jpg"))) >= 4][:30]
    paths = [path for name in strangers for path in sorted((crops / name).glob("*.jpg"))[:4]]
    labelled = Extractor(pack, cache=cache, aligned=True).extract(paths)
    binding = binding_for(pack, source, strategy=Strategy.HYBRID, m=M)
    contract = calibrate(
        labelled.embeddings,
        [path.parent.name for path in labelled.paths],
        binding=binding,
        source=source,
        options=CalibrationOptions(probe_dims=(0, PROBE_M), targets=(1e-2,)),
    ).contract
    contract.save(folder / "contract.json", sealer)

    photos = [[_photo(pack, p.read_bytes()) for p in _files(people / n)] for n in sitters]
    preprocessing = pack.info.preprocessing
    return Material(
        folder=folder,
        pack_dir=pack_dir,
        pool=pool,
        source=source,
        contract_id=contract.contract_id,
        enrolled=[each[:PHOTOS] for each in photos],
        probes=[each[PHOTOS] for each in photos],
        large=_photo(pack, _enlarged(photos[1][PHOTOS].pixels)),
        mean=np.asarray(preprocessing["mean"], dtype=np.float32),
        scale=np.asarray(preprocessing["scale"], dtype=np.float32),
    )


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.jpg"))[: PHOTOS + 1]


def _usable(pack: ModelPack, folder: Path) -> bool:
    """Whether the service takes every photo: each shows one face that is clearly meant."""
    try:
        for path in _files(folder):
            pack.crop_photo(path.read_bytes())
    except FaceError:
        return False
    return True


def _photo(pack: ModelPack, data: bytes) -> Photo:
    crop = pack.crop_photo(data, policy=None, quality=None).crop
    return Photo(data, decode_image(data), crop, pack.embed(crop[None])[0])


def _enlarged(pixels: NDArray[np.uint8]) -> bytes:
    """More than the megabyte at which form parsers like to turn to the disk."""
    out = io.BytesIO()
    grain = np.random.default_rng(0).integers(-6, 7, (750, 750, 3))
    image = np.asarray(Image.fromarray(pixels).resize((750, 750)), dtype=np.int16)
    Image.fromarray(np.clip(image + grain, 0, 255).astype(np.uint8)).save(
        out, "PNG", compress_level=0
    )
    return out.getvalue()
