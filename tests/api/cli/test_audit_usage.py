"""What `veilface audit` refuses: one sentence that names the cause and the remedy."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from models.pack import ModelPack
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from tests.api.cli.audit_bench import draw_fairface
from tests.api.cli.conftest import Ran, World, run

SMALL = ("--lifting", "100", "--strategy", "raw", "--generated-dim", "4", "--service-dim", "4")
AXES = ("--axes", "50")
FAIRFACE_USAGE: list[tuple[list[str], str]] = [
    (["--device", "nowhere"], "; leave out --device to use the processor"),
    (["--limit", "attribute-leakage=1.5"], "not 'attribute-leakage=1.5'"),
    (["--limit", "attribute-leakage"], "--limit takes NAME=SHARE, a share from 0 to 1 and a name"),
    (["--limit", "leakage=0.1"], "not 'leakage=0.1'"),
    (["--limit", "linkability=0"], "a name of attribute-leakage, not 'linkability=0'"),
    (
        ["--strategy", "raw,homomorphic"],
        "--strategy takes a list of raw, random, adversarial, hybrid",
    ),
    (["--dim", "two"], "--dim takes whole numbers such as 2,4, not 'two'"),
    (["--dim", "2,256"], "--dim takes dimensions from 1 to 255, not 256"),
    (["--dim", "0"], "--dim takes dimensions from 1 to 255, not 0"),
    (["--generated-dim", "300"], "--generated-dim takes dimensions from 1 to 49, not 300"),
    (["--generated-dim", "x"], "--generated-dim takes whole numbers such as 16,32, not 'x'"),
    (["--service-dim", "50"], "--service-dim must be below the 50 numbers of what is lifted"),
]
TEMPLATES_USAGE: list[tuple[list[str], str]] = [
    (["--limit", "attribute-leakage=0"], "not 'attribute-leakage=0'"),
    (["--device", "nowhere"], "; leave out --device to use the processor"),
    (["--dim", "many"], "--dim takes whole numbers such as 16,32, not 'many'"),
    (["--dim", "16,256", *AXES], "--dim takes dimensions from 1 to 49, not 256"),
    (["--dim", "0", *AXES], "--dim takes dimensions from 1 to 49, not 0"),
    (["--contract", "CONTRACT", "--dim", "16"], "leave out --strategy, --dim, --axes"),
]
TEMPLATES_FAILED: list[tuple[list[str], str]] = [
    (["--decoys", "ABSENT"], "absent"),
    (["--decoys", "OTHER"], "build the decoys with this pack and the same --flip"),
    (["--decoys", "NARROW"], "the decoys have 32 numbers each, the pack gives 256"),
    (["--decoys", "UNSAID"], "build the decoys with this pack and the same --flip"),
    (["--contract", "ABSENT"], "cannot be read (No such file or directory)"),
    (["--flip"], "build the decoys with this pack and the same --flip"),
]


def refused(ran: Ran, reason: str, status: int) -> None:
    """One sentence on stderr says why, and nothing else is said."""
    assert (ran.status, ran.stdout) == (status, "")
    # A bar that was shown, where embedding takes long, leaves an empty line.
    lines = [line for line in ran.stderr.splitlines() if line]
    (sentence,) = [line for line in lines if not line.startswith("note: ")]
    assert sentence.startswith("error: ")
    assert reason in sentence
    assert "defect" not in sentence


@pytest.fixture(scope="module")
def fairface_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_fairface(tmp_path_factory.mktemp("few-faces"), train=150, validation=12)


@pytest.fixture
def before_any_face(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where a face is embedded."""
    monkeypatch.setattr(ModelPack, "embed", None)


def fairface(world: World, root: Path, *more: str | Path) -> Ran:
    """Run on aligned faces; the report would be written beside the data folder."""
    given = ("--pack", world.pack, "--data-dir", world.data, "--aligned")
    return run("audit", "fairface", root, *given, *more)


def templates(world: World, root: Path, *more: str | Path) -> Ran:
    given = ("--pack", world.pack, "--data-dir", world.data, "--aligned")
    return run("audit", "templates", root, *given, *more)


@pytest.mark.parametrize(("arguments", "reason"), FAIRFACE_USAGE)
@pytest.mark.usefixtures("before_any_face")
def test_a_wrong_audit_of_faces_is_refused_before_any_face_is_embedded(
    world: World, fairface_root: Path, tmp_path: Path, arguments: list[str], reason: str
) -> None:
    ran = fairface(world, fairface_root, *SMALL, *AXES, *arguments, "--out", tmp_path / "out")
    refused(ran, reason, 2)
    assert not (tmp_path / "out").exists()


def paths(world: World, folder: Path, arguments: Sequence[str]) -> list[str | Path]:
    files = {
        "DECOYS": world.data / "decoys.veil",
        "CONTRACT": world.data / "contract.json",
        **{name: folder / name.lower() for name in ("ABSENT", "OTHER", "NARROW", "UNSAID")},
    }
    return [files.get(argument, argument) for argument in arguments]


def write_decoys(world: World, folder: Path) -> None:
    """Decoys of another model, of another dimension, and of no model that they name."""
    known = DecoyGenerator.load(world.data / "decoys.veil")
    stream = Keystream.seeded("decoys of a test")
    drawn = known.draw(150, 1, stream=stream)[:, 0]
    DecoyGenerator.fit(drawn, made_with="ab" * 32).save(folder / "other")
    DecoyGenerator.fit(drawn).save(folder / "unsaid")
    narrow = drawn[:, :32] / (drawn[:, :32] ** 2).sum(axis=1, keepdims=True) ** 0.5
    DecoyGenerator.fit(narrow, made_with=known.made_with).save(folder / "narrow")


@pytest.mark.parametrize(
    ("arguments", "reason", "status"),
    [(*one, 2) for one in TEMPLATES_USAGE] + [(*one, 1) for one in TEMPLATES_FAILED],
)
@pytest.mark.usefixtures("before_any_face")
def test_a_wrong_audit_of_templates_is_refused_before_any_face_is_embedded(
    world: World, tmp_path: Path, arguments: list[str], reason: str, status: int
) -> None:
    write_decoys(world, tmp_path)
    given = paths(world, tmp_path, arguments)
    sizes = ("--victims", "20", "--owners", "100", "--dim", "4")
    ran = templates(world, world.labelled, *sizes, *given, "--out", tmp_path / "out")
    refused(ran, reason, status)
    assert not (tmp_path / "out").exists()


def test_a_pack_must_be_named(fairface_root: Path, world: World, tmp_path: Path) -> None:
    for command, root in (("fairface", fairface_root), ("templates", world.labelled)):
        ran = run("audit", command, root, "--data-dir", tmp_path, "--out", tmp_path / "out")
        refused(ran, "name the pack with --pack", 2)


@pytest.mark.parametrize(
    "wrong",
    [
        *(["fairface", *each] for each in (["--lifting", "99"], ["--attack", "1"])),
        *(["fairface", *each] for each in (["--attacked", "1"], ["--seed", "-1"])),
        *(["templates", *each] for each in (["--victims", "19"], ["--owners", "99"])),
        *(["templates", *each] for each in (["--seed", "-1"], ["--strategy", "magic"])),
    ],
    ids=" ".join,
)
def test_options_of_a_wrong_kind_are_refused(
    world: World, fairface_root: Path, tmp_path: Path, wrong: list[str]
) -> None:
    command, option, value = wrong
    root = fairface_root if command == "fairface" else world.labelled
    ran = run("audit", command, root, "--pack", world.pack, option, value, "--out", tmp_path / "o")
    assert (ran.status, ran.stdout) == (2, "")
    assert option in ran.stderr
    assert "Traceback" not in ran.stderr


def test_a_folder_without_label_files_is_refused(
    world: World, fairface_root: Path, tmp_path: Path
) -> None:
    refused(fairface(world, tmp_path, *SMALL), "has no fairface_label_train.csv; give the", 1)
    half = tmp_path / "half"
    half.mkdir()
    (half / "train").symlink_to(fairface_root / "train")
    shutil.copy(fairface_root / "fairface_label_train.csv", half)
    refused(fairface(world, half, *SMALL), "has no fairface_label_val.csv; give the", 1)


@pytest.mark.parametrize(
    ("sizes", "reason"),
    [
        (["--lifting", "150"], "cannot be taken from 150 training faces"),
        ([], "give the attacker more faces"),
    ],
)
@pytest.mark.usefixtures("before_any_face")
def test_sizes_that_do_not_fit_are_refused(
    world: World, fairface_root: Path, tmp_path: Path, sizes: list[str], reason: str
) -> None:
    asked = ("--strategy", "raw", "--generated-dim", "4", "--service-dim", "4", *sizes)
    ran = fairface(world, fairface_root, *asked, "--out", tmp_path / "out")
    refused(ran, reason, 1)
    assert not (tmp_path / "out").exists()


def test_too_few_people_are_refused(world: World, tmp_path: Path) -> None:
    cache = tmp_path / "faces.cache"
    for sizes, reason in (
        (("--victims", "20", "--owners", "100"), "ask for fewer people (victims, owners)"),
        (("--victims", "51", "--owners", "100"), "need 151 people with two photos or more, and 50"),
    ):
        ran = templates(world, world.labelled, *sizes, "--dim", "4", "--cache", cache)
        refused(ran, reason, 1)


def test_a_folder_that_is_too_small_is_refused(world: World, tmp_path: Path) -> None:
    """Parts are dealt out before anybody is compared: one photo may stand for many people."""
    (photo, other, *_) = sorted(world.decoy_faces.rglob("*.png"))
    for number in range(300):
        person = tmp_path / "people" / f"person-{number}"
        person.mkdir(parents=True)
        (person / "0.png").symlink_to(photo)
        if number < 120:
            (person / "1.png").symlink_to(other)
    asked = ("--victims", "20", "--owners", "100", "--dim", "4", "--cache", tmp_path / "cache")
    refused(
        templates(world, tmp_path / "people", *asked),
        "180 people are left to calibrate on, and 200 are the least",
        1,
    )


@pytest.mark.usefixtures("before_any_face")
def test_a_contract_of_other_decoys_is_refused(world: World, tmp_path: Path) -> None:
    known = DecoyGenerator.load(world.data / "decoys.veil")
    stream = Keystream.seeded("other decoys of a test")
    drawn = known.draw(150, 1, stream=stream)[:, 0]
    DecoyGenerator.fit(drawn, made_with=known.made_with).save(tmp_path / "other")
    contract = ("--contract", world.data / "contract.json")
    ran = templates(world, world.labelled, *contract, "--decoys", tmp_path / "other")
    refused(ran, "use the file that the contract was calibrated with", 1)
