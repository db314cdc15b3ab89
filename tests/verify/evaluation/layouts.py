"""Small benchmark files and folders, laid out exactly as the published ones."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.io
from PIL import Image

from verify.tenfold import FOLDS

PEOPLE = ("Ann", "Bob")


def drawn(number: int, *, kind: str = "PNG") -> bytes:
    """An encoded picture that differs from every other number's."""
    pixels = np.random.default_rng(number).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind)
    return stream.getvalue()


def write(file: Path, data: bytes | str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data if isinstance(data, bytes) else data.encode())
    return file


def bin_content(pairs: int = 2 * FOLDS) -> tuple[list[bytes], list[bool]]:
    """``(bins, issame_list)`` of drawn pictures; genuine and impostor pairs alternate."""
    bins = [drawn(number) for number in range(2 * pairs)]
    return bins, [pair % 2 == 0 for pair in range(pairs)]


def lfw_folder(root: Path, *, inside: str = "", suffix: str = ".jpg", photos: bool = True) -> Path:
    """Two people with two photos each, and one pair of each kind in every fold."""
    fold = "Ann\t1\t2\nAnn\t2\tBob\t1\n"
    write(root / "pairs.txt", f"{FOLDS}\t1\n" + fold * FOLDS)
    for number, person in enumerate(PEOPLE if photos else ()):
        for photo in (1, 2):
            name = f"{person}/{person}_{photo:04d}{suffix}"
            write(root / inside / name, drawn(10 * number + photo))
    return root


CFP_IDENTITIES = ("001", "002", "003")


def cfp_folder(root: Path, *, photos: bool = True) -> Path:
    """Three identities with 2 frontal and 2 profile photos, two pairs of each kind in a fold."""
    for letter, pose in (("F", "frontal"), ("P", "profile")):
        paths = [f"{who}/{pose}/{n:02d}.jpg" for who in CFP_IDENTITIES for n in (1, 2)]
        lines = [f"{i} ../Data/Images/{path}" for i, path in enumerate(paths, start=1)]
        write(root / f"Protocol/Pair_list_{letter}.txt", "\n".join(lines) + "\n")
        for number, path in enumerate(paths if photos else ()):
            write(root / "Data/Images" / path, drawn(ord(letter) + number))
    for split in ("FF", "FP"):
        for fold in range(1, FOLDS + 1):
            folder = root / "Protocol" / "Split" / split / f"{fold:02d}"
            write(folder / "same.txt", "1,2\r\n3,4\r\n")
            write(folder / "diff.txt", "1, 3\n\n2,6\n")
    return root


AGEDB_NAMES = ("7_AnnBell_3_21_f", "7_AnnBell_9_52_f", "8_BobHay_1_20_m")


def agedb_folds() -> list[list[tuple[str, str, int]]]:
    ann, older, bob = AGEDB_NAMES
    return [[(ann, older, 1), (ann, bob, -1), (older, ann, 1)] for _ in range(FOLDS)]


def cell(rows: Sequence[Sequence[object]]) -> np.ndarray:
    made = np.empty((len(rows), len(rows[0])), dtype=object)
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            made[i, j] = value
    return made


def agedb_splits(layout: str, folds: Sequence[Sequence[tuple[str, str, int]]]) -> np.ndarray:
    """``splits`` as the published file has it, or with a cell in place of each struct."""
    made = []
    for pairs in folds:
        labels = np.array([[label for *_, label in pairs]])
        if layout == "structs":
            photos = [[{"name": pair[side], "age": 30} for pair in pairs] for side in (0, 1)]
            made.append({"pairs": cell(photos), "labels": labels})
        else:
            photos = [[pair[side] for pair in pairs] for side in (0, 1)]
            made.append(cell([[cell(photos), labels]]))
    return cell([[one] for one in made])


def agedb_folder(
    root: Path,
    *,
    layout: str = "structs",
    folds: Sequence[Sequence[tuple[str, str, int]]] | None = None,
    compressed: bool = True,
    photos: bool = True,
) -> Path:
    """Three photos of two people, and three pairs a fold."""
    folds = agedb_folds() if folds is None else folds
    root.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(
        root / "04_FINAL_protocol_30_years.mat",
        {"splits": agedb_splits(layout, folds)},
        do_compression=compressed,
    )
    for number, name in enumerate(AGEDB_NAMES if photos else ()):
        write(root / "03_Protocol_Images" / f"{name}.jpg", drawn(number))
    return root
