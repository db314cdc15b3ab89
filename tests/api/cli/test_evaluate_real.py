"""`veilface evaluate` on a part of LFW with real weights, where they are present."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.api.cli.conftest import Ran, run

pytestmark = pytest.mark.long

FOLDS, PER_CLASS, PUBLISHED = 10, 4, 300
DIMS = (2, 8)
PLAN = (
    *("--strategy", "raw,random,adversarial", "--dim", ",".join(map(str, DIMS))),
    *("--repeats", "2", "--fmr", "0.1,0.001", "--jobs", "1", "--json"),
)


@dataclass(frozen=True)
class Part:
    """The first pairs of each fold of LFW, as a folder of links."""

    folder: Path
    pack: Path
    decoys: Path
    data: Path
    pairs: list[tuple[Path, Path, bool]]
    ran: Ran
    out: Path


@pytest.fixture(scope="module")
def part(
    lfw_aligned: Path, mbf_pack_dir: Path, fairface: Path, tmp_path_factory: pytest.TempPathFactory
) -> Part:
    root = tmp_path_factory.mktemp("part")
    lines = (lfw_aligned / "pairs.txt").read_text(encoding="utf-8").splitlines()[1:]
    chosen = [
        line
        for fold in range(FOLDS)
        for kind in range(2)
        for line in lines[(2 * fold + kind) * PUBLISHED :][:PER_CLASS]
    ]
    pairs = []
    for line in chosen:
        cells = line.split("\t")
        a, i, b, j = cells if len(cells) == 4 else (cells[0], cells[1], cells[0], cells[2])
        names = [f"{who}/{who}_{int(number):04d}.jpg" for who, number in ((a, i), (b, j))]
        for name in names:
            link = root / "lfw" / name
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.symlink_to(lfw_aligned / name)
        pairs.append((lfw_aligned / names[0], lfw_aligned / names[1], a == b))
    text = "\n".join([f"{FOLDS}\t{PER_CLASS}", *chosen])
    (root / "lfw" / "pairs.txt").write_text(text, encoding="utf-8")
    decoys, data = root / "decoys.veil", root / "data"
    (root / "faces").mkdir()
    for photo in sorted((fairface / "train").glob("*.jpg"))[::100]:
        (root / "faces" / photo.name).symlink_to(photo)
    built = run(
        *("decoys", "build", root / "faces", "--pack", mbf_pack_dir, "--kind", "pool"),
        *("--aligned", "--data-dir", data, "--out", decoys),
    )
    assert built.status == 0, built.stderr
    # The cache goes by content: what another run reads differently is not found in it.
    given = (
        *("--pack", mbf_pack_dir, "--decoys", decoys),
        *("--data-dir", data, "--cache", data / "cache.veil"),
    )
    ran = run("evaluate", root / "lfw", *given, *PLAN, "--out", root / "out")
    assert ran.status == 0, ran.stderr
    return Part(root / "lfw", mbf_pack_dir, decoys, data, pairs, ran, root / "out")


def test_lifted_rows_have_the_order_of_the_paper(part: Part) -> None:
    """More decoys cost accuracy, most where both are; raw, nearly all pairs are told apart."""
    raw = [row for row in part.ran.json["rows"] if row["strategy"].startswith("raw")]
    assert min(row["accuracy_mean"] for row in raw) > 0.98
    auc = {
        (row["strategy"], row["dim"], row["mode"], row["metric"]): row["auc"]
        for row in part.ran.json["rows"]
    }
    for metric in ("euclidean", "spherical"):
        for mode in ("p2s", "s2s"):
            assert auc["random", 8, mode, metric] > 0.98
        assert auc["adversarial", 8, "p2s", metric] > 0.95
        assert auc["adversarial", 8, "s2s", metric] < auc["adversarial", 2, "s2s", metric]
        assert auc["adversarial", 8, "s2s", metric] < auc["adversarial", 8, "p2s", metric]
    assert auc["adversarial", 8, "s2s", "euclidean"] < auc["adversarial", 8, "s2s", "spherical"]
