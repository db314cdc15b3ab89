"""Calibration on real descriptors: a small share of LFW, with the real embedder."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from models.pack import ModelPack
from templates.contract.document import Binding
from templates.decoys import DecoyGenerator
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from verify import CalibrationOptions, calibrate, labelled_folder
from verify.consistency import match_cosine

pytestmark = pytest.mark.long

PEOPLE = 60
DECOY_FACES = 200


def embed(pack: ModelPack, paths: list[Path]) -> NDArray[np.float32]:
    crops = np.stack([cv2.imread(str(path), cv2.IMREAD_COLOR)[:, :, ::-1] for path in paths])
    return pack.embed(np.ascontiguousarray(crops))


@pytest.mark.parametrize("m", [16])
def test_real_people_are_told_apart(mbf_pack_dir: Path, lfw_aligned: Path, m: int) -> None:
    pack = ModelPack.load(mbf_pack_dir)
    folder = labelled_folder(lfw_aligned)
    photos: dict[str, list[Path]] = {}
    for path, name in zip(folder.paths, folder.identities, strict=True):
        photos.setdefault(name, []).append(path)
    single = [found[0] for found in photos.values() if len(found) == 1][:DECOY_FACES]
    several = [(name, found[:3]) for name, found in photos.items() if len(found) >= 2][:PEOPLE]
    source = DecoyGenerator.fit(embed(pack, single))
    paths = [path for _, found in several for path in found]
    names = [name for name, found in several for _ in found]
    descriptors = embed(pack, paths)
    result = calibrate(
        descriptors,
        names,
        binding=Binding(
            embedder_sha256=pack.info.embedder_sha256,
            preprocessing=pack.info.preprocessing,
            n=pack.info.n,
            axes=source.k,
            strategy=Strategy.ADVERSARIAL,
            m=m,
            decoy_source_id=source.source_id,
            rotation_version=ROTATION_VERSION,
        ),
        source=source,
        options=CalibrationOptions(targets=(1e-2,)),
    )
    level = result.contract.calibration("p2s").level("fmr-1e-2")
    # One in a hundred of a standard normal variable is above 2.33.
    assert 1.9 < level.threshold < 2.8
    assert level.fnmr.trials >= PEOPLE
    assert level.fnmr.value <= 0.05
    # Raw cosines on all of LFW: 0.247 at FMR 1e-3, 0.369 at 1e-5.
    assert 0.15 < match_cosine(descriptors, names) < 0.35
    assert 0.25 < result.contract.photo_consistency < 0.45
