"""A set of drawn people, a pack and decoys, and one full evaluation of them."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.decoding import decode_image
from models.demo import build_demo_pack
from models.pack import ModelPack
from models.synthetic import draw_face, encode_photo
from tests.api.cli.conftest import Ran, run
from tests.once import made_once

PEOPLE, PHOTOS, FOLDS, PER_CLASS = 12, 4, 10, 3
PAIRS = 2 * FOLDS * PER_CLASS
STRATEGIES = ("raw", "random", "adversarial", "hybrid+")
CONTRACT = {
    *("dataset", "strategy", "dim", "mode", "metric", "accuracy_mean", "accuracy_std", "eer"),
    *("fnmr_at_fmr", "threshold_mean", "n_genuine", "n_impostor", "seed"),
}
FILES = [
    *("results.json", "results.csv", "results.md"),
    *("figure.png", "figure.svg", "det.png", "det.svg"),
]


@dataclass(frozen=True)
class Bench:
    """A set of drawn people, a pack, decoys, and what a full run on them said."""

    root: Path
    first: Ran

    lfw = property(lambda self: self.root / "lfw")
    pack = property(lambda self: self.root / "pack")
    labels = property(lambda self: self.root / "labels.csv")
    base = property(
        lambda self: ("--pack", self.pack, "--data-dir", self.root / "data", "--jobs", "1")
    )
    decoys = property(
        lambda self: (
            *("--decoys", self.root / "pool.veil"),
            *("--decoys", self.root / "generator.veil"),
        )
    )
    plan = property(
        lambda self: ("--dim", "2", "--repeats", "2", "--seed", "7", "--fmr", "0.2,0.001")
    )

    @property
    def full(self) -> tuple[str | Path, ...]:
        return (
            *("evaluate", self.lfw, *self.base, *self.decoys, *self.plan),
            *("--strategy", ",".join(STRATEGIES), "--labels", self.labels),
        )


def pair_lines() -> list[str]:
    """The lines of ``pairs.txt`` after its header."""
    rng = np.random.default_rng(0)
    lines = []
    for fold in range(FOLDS):
        for number in range(PER_CLASS):
            one, two = rng.choice(PHOTOS, 2, replace=False) + 1
            lines.append(f"Person_{(PER_CLASS * fold + number) % PEOPLE}\t{one}\t{two}")
        for _ in range(PER_CLASS):
            (p, q), (i, j) = rng.choice(PEOPLE, 2, replace=False), rng.integers(PHOTOS, size=2) + 1
            lines.append(f"Person_{p}\t{i}\tPerson_{q}\t{j}")
    return lines


def pairs_of(folder: Path) -> list[tuple[Path, Path, bool]]:
    found = []
    for line in (folder / "pairs.txt").read_text().splitlines()[1:]:
        cells = line.split("\t")
        a, i, b, j = cells if len(cells) == 4 else (cells[0], cells[1], cells[0], cells[2])
        photos = (folder / who / f"{who}_{int(n):04d}.png" for who, n in ((a, i), (b, j)))
        found.append((*photos, a == b))
    return found


def make_bench(root: Path) -> None:
    build_demo_pack(root / "pack")
    labels = ["path,gender,race"]
    for person in range(PEOPLE):
        folder = root / "lfw" / f"Person_{person}"
        folder.mkdir(parents=True)
        for photo in range(PHOTOS):
            data = encode_photo(draw_face(100 + person, photo))
            (folder / f"Person_{person}_{photo + 1:04d}.png").write_bytes(data)
        labels.append(f"Person_{person},{'Female' if person % 2 else 'Male'},White")
    (root / "lfw" / "pairs.txt").write_text("\n".join([f"{FOLDS}\t{PER_CLASS}", *pair_lines()]))
    (root / "labels.csv").write_text("\n".join(labels))
    lines = ["file,age,gender,race,service_test"]
    (root / "decoys" / "train").mkdir(parents=True)
    for number in range(110):
        (root / f"decoys/train/{number}.png").write_bytes(encode_photo(draw_face(5000 + number)))
        gender, race = ("Male", "Female")[number % 2], ("White", "Black", "Indian")[number % 3]
        lines.append(f"train/{number}.png,20-29,{gender},{race},FALSE")
    (root / "decoys" / "fairface_label_train.csv").write_text("\n".join(lines))
    for kind in ("pool", "generator"):
        ran = run(
            *("decoys", "build", root / "decoys" / "train", "--pack", root / "pack"),
            *("--kind", kind, "--data-dir", root / "data", "--out", root / f"{kind}.veil"),
        )
        assert ran.status == 0, ran.stderr
    unfinished = Bench(root, Ran(0, "", ""))
    first = run(*unfinished.full, "--out", root / "out", "--json")
    assert first.status == 0, first.stderr
    (root / "first.json").write_text(json.dumps(asdict(first)))


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Tests read it, in several processes."""
    root = made_once(tmp_path_factory, "bench", make_bench)
    return Bench(root, Ran(**json.loads((root / "first.json").read_text())))


@pytest.fixture(scope="session")
def results(bench: Bench) -> Any:
    return json.loads((bench.root / "out" / "results.json").read_text())


def embedded(bench: Bench, *, flip: bool = False) -> dict[Path, np.ndarray]:
    pack = ModelPack.load(bench.pack, threads=1, flip=flip)
    photos = sorted(bench.lfw.rglob("*.png"))
    return dict(
        zip(photos, pack.embed(np.stack([decode_image(p.read_bytes()) for p in photos])))  # noqa: B905
    )


def secret_bytes(rows: Any) -> list[bytes]:
    """How a row may stand in a file: three widths of floats, or as text."""
    found = []
    for row in rows:
        piece = row[100:108]
        found += [piece.astype(kind).tobytes() for kind in ("<f2", "<f4", "<f8")]
        found.append(repr(float(piece[0])).encode())
    return found


def secrets(bench: Bench) -> list[bytes]:
    """Descriptors and photos, as files could have them."""
    known = [row for flip in (False, True) for row in embedded(bench, flip=flip).values()]
    photos = [file.read_bytes() for file in bench.lfw.rglob("*.png")]
    pixels = [decode_image(data)[56, 40:60].tobytes() for data in photos]
    return secret_bytes(known) + [data[200:232] for data in photos] + pixels
