"""A contract calibrated on a small share of LFW, with a real pack."""

from collections.abc import Collection
from pathlib import Path

from api.cli.calibration import calibrate_folder
from api.settings import Settings
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.distances.blas import single_threaded
from templates.space.lifting import Strategy
from verify import CalibrationOptions, LabelledFolder, labelled_folder
from verify.preparation import make_generator


def calibrated_on_lfw(
    settings: Settings,
    pack_dir: Path,
    aligned: Path,
    *,
    without: Collection[str],
    decoy_faces: int,
    people: int,
    m: int,
    targets: tuple[float, ...],
) -> Contract:
    """Save the decoys of a deployment, and return its contract, without some people of LFW.

    The decoys are of people with one photo, and the calibration is of others, on three of each.
    """
    everybody = labelled_folder(aligned)
    photos: dict[str, list[Path]] = {}
    for path, name in zip(everybody.paths, everybody.identities, strict=True):
        if name not in without:
            photos.setdefault(name, []).append(path)
    single = [album[0] for album in photos.values() if len(album) == 1][:decoy_faces]
    several = [name for name, album in photos.items() if len(album) >= 3][:people]
    chosen = [(path, name) for name in several for path in photos[name][:3]]
    folder = LabelledFolder(
        aligned, tuple(path for path, _ in chosen), tuple(name for _, name in chosen), 0
    )
    pack = ModelPack.load(pack_dir, threads=1)
    extractor = Extractor(pack, aligned=True)
    with single_threaded():
        source = make_generator(extractor.extract(single), pack)
        done = calibrate_folder(
            folder,
            extractor.extract(folder.paths),
            pack=pack,
            source=source,
            strategy=Strategy.ADVERSARIAL,
            m=m,
            options=CalibrationOptions(targets=targets, photos_per_enrollment=2),
        )
    source.save(settings.resolved_decoys_file)
    return done.contract
