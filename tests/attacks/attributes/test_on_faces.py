"""Claims of docs/privacy.md "Gender, race and age" and docs/method.md on real faces, in small."""

from pathlib import Path

import pytest

from attacks.attributes.experiment import run_scheme
from attacks.attributes.faces import LabelledFaces, split
from attacks.attributes.plan import AttributePlan, Setup, prepare
from attacks.attributes.rows import AttributeRow, Leakage
from attacks.outcomes import POOLED, RAW_SCHEME, Scheme
from models.extraction import Extractor
from models.pack import ModelPack
from verify.evaluation.labels_file import read_labels
from verify.fairface_labels import GENDERS, RACES

pytestmark = pytest.mark.long

TRAIN, VALIDATION = 400, 200
CLASSES = {"gender": GENDERS, "race": RACES}
PLAN = AttributePlan(schemes=(), attributes=("gender", "race"), lifting=130)


def labelled(root: Path, part: str, count: int, extractor: Extractor) -> LabelledFaces:
    labels = read_labels(root / f"fairface_label_{part}.csv")
    photos = sorted((root / part).glob("*.jpg"))[:count]
    faces = extractor.extract(photos)
    names = [f"{part}/{Path(str(path)).name}" for path in faces.paths]
    columns = {name: [str(each) for each in labels.column(name, names)] for name in CLASSES}
    return LabelledFaces.of_names(faces.embeddings, columns, CLASSES)


@pytest.fixture(scope="module")
def setup(fairface: Path, mbf_pack_dir: Path) -> Setup:
    # FairFace's photos are small: on this canvas all but a few are found, in a quarter of the time.
    extractor = Extractor(ModelPack.load(mbf_pack_dir, detector_size=320))
    train = labelled(fairface, "train", TRAIN, extractor)
    attacked = labelled(fairface, "val", VALIDATION, extractor)
    parts = split(train, attacked, lifting=130, attack=len(train) - 130, attacked_most=None, seed=0)
    return prepare(parts, plan=PLAN)


def by_attacker(setup: Setup, scheme: Scheme) -> dict[tuple[str, str], AttributeRow]:
    # The paper's metric comes first, and dictionaries keep the last.
    return {(row.attacker, row.attribute): row for row in reversed(run_scheme(setup, scheme))}


def test_random_lifting_conceals_nothing(setup: Setup) -> None:
    raw, lifted = (by_attacker(setup, s) for s in (RAW_SCHEME, Scheme("random", None, 4)))
    for attacker in ("knn", "logistic"):
        before, after = raw[attacker, "gender"], lifted[attacker, "gender"]
        assert before.leakage is after.leakage is Leakage.ABOVE
        assert abs(before.accuracy.value - after.accuracy.value) < 0.08


def test_adversarial_lifting_conceals_from_all_but_who_holds_the_pool(setup: Setup) -> None:
    raw = by_attacker(setup, RAW_SCHEME)
    rows = by_attacker(setup, Scheme("adversarial", POOLED, 16))
    for attacker in ("knn", "logistic"):
        assert (
            rows[attacker, "gender"].accuracy.value < raw[attacker, "gender"].accuracy.value - 0.15
        )
    low = raw["logistic", "gender"].accuracy.ci_low
    assert rows["strip", "gender"].accuracy.value > low
    assert rows["strip", "gender"].leakage is Leakage.ABOVE


def test_training_turns_round_what_neighbours_show_below_chance(setup: Setup) -> None:
    rows = by_attacker(setup, Scheme("hybrid+", POOLED, 8))
    assert rows["knn", "gender"].leakage is Leakage.BELOW
    assert (
        rows["logistic", "gender"].accuracy.value > 1 - rows["knn", "gender"].accuracy.value - 0.05
    )
