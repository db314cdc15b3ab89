"""What `veilface audit` refuses: one sentence that names the cause and the remedy."""

from pathlib import Path

import pytest

from models.pack import ModelPack
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from tests.api.cli.audit_bench import draw_fairface
from tests.api.cli.conftest import Ran, World, run

SMALL = ("--lifting", "100", "--strategy", "random", "--dim", "2", "--generated-dim", "4")
FAIRFACE: list[tuple[list[str], str, int]] = [
    (["--device", "nowhere"], "torch", 1),
    (["--limit", "attribute-leakage=1.5"], "not 'attribute-leakage=1.5'", 2),
    (["--limit", "leakage=0.1"], "--limit takes NAME=SHARE, a share from 0 to 1 and a name", 2),
    (["--strategy", "random,homomorphic"], "--strategy takes a list of random, adversarial", 2),
    (["--dim", "two"], "--dim takes whole numbers from 1 to 255, with commas, not 'two'", 2),
    (["--dim", "2,256"], "--dim takes whole numbers from 1 to 255", 2),
    (["--generated-dim", "300"], "--generated-dim takes whole numbers from 1 to 191", 2),
    (["--lifting", "150"], "cannot be taken from 150 training faces", 1),
    (["--lifting", "140"], "give the attacker more faces", 1),
]
TEMPLATES: list[tuple[list[str], str, int]] = [
    (["--limit", "linkability"], "not 'linkability'", 2),
    (["--dim", "16,256", "--axes", "50"], "--dim takes whole numbers from 1 to 49", 2),
    (["--decoys", "ABSENT"], "absent", 1),
    (["--decoys", "OTHER"], "build the decoys with this pack and the same --flip", 1),
    (["--decoys", "UNSAID"], "build the decoys with this pack and the same --flip", 1),
    (["--flip"], "build the decoys with this pack and the same --flip", 1),
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


@pytest.mark.parametrize(("arguments", "reason", "status"), FAIRFACE)
@pytest.mark.usefixtures("before_any_face")
def test_a_wrong_audit_of_faces_is_refused_before_any_face_is_embedded(
    world: World,
    fairface_root: Path,
    tmp_path: Path,
    arguments: list[str],
    reason: str,
    status: int,
) -> None:
    ran = fairface(world, fairface_root, *SMALL, *arguments, "--out", tmp_path / "out")
    refused(ran, reason, status)
    assert not (tmp_path / "out").exists()


def write_decoys(world: World, folder: Path) -> dict[str, Path]:
    """Decoys of another model, and of none that they name."""
    known = DecoyGenerator.load(world.data / "decoys.veil")
    stream = Keystream.seeded("decoys of a test")
    drawn = known.draw(150, 1, stream=stream)[:, 0]
    files = {name: folder / name.lower() for name in ("ABSENT", "OTHER", "UNSAID")}
    DecoyGenerator.fit(drawn, made_with="ab" * 32).save(files["OTHER"])
    DecoyGenerator.fit(drawn).save(files["UNSAID"])
    return files


@pytest.mark.parametrize(("arguments", "reason", "status"), TEMPLATES)
@pytest.mark.usefixtures("before_any_face")
def test_a_wrong_audit_of_templates_is_refused_before_any_face_is_embedded(
    world: World, tmp_path: Path, arguments: list[str], reason: str, status: int
) -> None:
    files = write_decoys(world, tmp_path)
    given = [files.get(argument, argument) for argument in arguments]
    sizes = ("--victims", "20", "--owners", "100")
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


def test_a_folder_without_label_files_is_refused(world: World, tmp_path: Path) -> None:
    refused(fairface(world, tmp_path, *SMALL), "fairface_label_train.csv is not there", 1)


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
