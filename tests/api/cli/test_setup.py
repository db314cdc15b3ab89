"""`veilface setup`: one command from photos to a service, which goes on where it was stopped."""

import shutil
import stat
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from api.cli import setup as command
from api.cli.errors import CommandError
from api.cli.roles import assign_roles
from api.settings import load_settings
from models.demo import build_demo_pack
from tests.api.cli.conftest import Ran, World, draw, key_file, run
from tests.once import made_once
from verify import labelled_folder

FACES = range(5000, 5100)
PEOPLE = range(6000, 6030)


def make_folders(root: Path) -> None:
    build_demo_pack(root / "pack")
    draw(root / "faces", FACES, range(1))
    draw(root / "people", PEOPLE, range(2))


@pytest.fixture
def folders(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A newcomer's folder: a pack, faces and people, and nothing else."""
    made = made_once(tmp_path_factory, "setup", make_folders)
    folder = Path(shutil.copytree(made, tmp_path / "newcomer"))
    monkeypatch.chdir(folder)
    return folder


def setup(*more: str | Path) -> Ran:
    return run("setup", "people", "--faces", "faces", "--pack", "pack", *more)


@pytest.fixture
def stops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every run end before its calibration."""

    def stop(*_: Any, **__: Any) -> None:
        raise CommandError("stopped")

    monkeypatch.setattr(command, "calibrate_folder", stop)


def test_what_cannot_be_prepared_is_refused_before_anything_is_made(folders: Path) -> None:
    for people, said in (
        (["faces/person-5000"], "1 photos and no folder for a person: nobody is labelled"),
        ([], "--faces has 100 photos: half of them set the thresholds"),
    ):
        refused = run("setup", *people, "--faces", "faces", "--pack", "pack")
        assert (refused.status, said in refused.stderr) == (1, True), refused.stderr
    assert not (folders / "veilface-data").exists()


def test_five_colleagues_are_left_aside_and_thresholds_set_on_the_faces(
    folders: Path, stops: None
) -> None:
    colleagues = draw(folders / "colleagues", range(7000, 7005), range(3))
    draw(folders / "faces", range(5100, 5200), range(1))
    shutil.copy(colleagues / "person-7000" / "0.png", folders / "faces" / "person-7000.png")
    (folders / "faces" / "person-7001").symlink_to(colleagues / "person-7001")
    arguments = ("setup", colleagues, "--faces", "faces", "--pack", "pack")
    ran = run(*arguments)
    assert (
        "note: 5 people with 15 photos are too few to set a threshold by: 25 resolve that 1 "
        "stranger in 100 is accepted, and 80 that 1 in 1,000 is: thresholds are set on --faces "
        "instead" in ran.stderr
    )
    assert "people 100, photos 100, faces 101, sample 0" in ran.stderr
    refused = run(*arguments, "--like", "people")
    assert refused.status == 2
    assert "PEOPLE are too few" in refused.stderr


def test_nobody_is_in_two_roles(tmp_path: Path) -> None:
    people = draw(tmp_path / "people", range(3), range(2))
    like = draw(tmp_path / "like", range(2, 5), range(1))
    faces = draw(tmp_path / "faces", range(4, 8), range(1))
    (faces / "alone.png").write_bytes(b"")
    roles = assign_roles(labelled_folder(people), [faces], [like])
    assert {path.parent.name for path in roles.sample} == {"person-3", "person-4"}
    assert {path.parent.name for path in roles.faces} == {
        "faces",
        *(f"person-{i}" for i in (5, 6, 7)),
    }
    assert set(roles.calibration.identities) == {"person-0", "person-1", "person-2"}
    assert roles.left_out == 2
    with pytest.raises(CommandError, match="everybody in --faces"):
        assign_roles(labelled_folder(people), [people])
    with pytest.raises(CommandError, match="everybody in --like"):
        assign_roles(labelled_folder(people), [faces], [people])


@pytest.fixture
def prepared(
    world: World, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Ran]:
    """Set up where decoys and contract are there, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*more: str | Path) -> Ran:
        ran = run("setup", world.labelled, "--faces", world.decoy_faces, *more)
        assert "a defect of veilface" not in ran.stderr
        return ran

    return partial(call, "--data-dir", data)


def test_what_is_there_is_kept_and_the_rest_is_made(
    world: World, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ("setup", world.labelled, "--faces", world.decoy_faces, "--pack", world.pack)
    kept = [data / "decoys.veil", data / "contract.json", key_file(data)]
    before = [file.read_bytes() for file in kept]
    first = run(*arguments, "--data-dir", data, "--json")
    assert first.status == 0, first.stderr
    assert first.json["verdict"]["privacy"]["status"] == "NOT SHOWN"
    assert first.stderr.count("is there and kept") == 3
    assert [file.read_bytes() for file in kept] == before
    token = key_file(data).with_name("api-key")
    assert token.read_text().startswith("vf_")
    assert stat.S_IMODE(token.stat().st_mode) == 0o600
    assert tomllib.loads(Path("veilface.toml").read_text()) == {
        "data_dir": str(data),
        "pack": str(world.pack),
    }

    again = run(*arguments, "--data-dir", data)
    assert again.status == 0, again.stderr
    assert again.stderr.count("is there and kept") == 5
    assert token.read_text() not in again.stdout + again.stderr
    start, page, enroll, verify, privacy, accuracy = again.stdout.splitlines()[-6:]
    assert privacy.startswith("Privacy: not proven. ")
    assert accuracy.startswith("Accuracy: ")
    assert start == "Start it: veilface serve"
    assert page.endswith(f"open http://127.0.0.1:8421/ and sign in with the key in {token}")
    for call, rest in (
        (enroll, "PUT http://127.0.0.1:8421/v1/subjects/anna/enrollment"),
        (verify, "POST http://127.0.0.1:8421/v1/subjects/anna/verify"),
    ):
        assert f"curl -X {rest} -H " in call
        assert f"$(cat {token})" in call
    faces = ("--faces", world.decoy_faces, "--faces", world.labelled)
    unlabelled = run("setup", *faces, "--pack", world.pack, "--data-dir", data)
    # The contract was made on labelled people, whatever this call has.
    assert unlabelled.stdout.splitlines()[-2:] == [privacy, accuracy]
    checked = run("serve", "--check")
    assert checked.status == 0, checked.stderr
    keys = run("keys", "list", "--json").json
    assert [(key["label"], key["rights"]) for key in keys] == [
        ("setup", ["admin", "enroll", "erase", "scores", "verify"])
    ]


def test_an_api_key_that_the_store_does_not_take_is_replaced(
    world: World, data: Path, prepared: Callable[..., Ran]
) -> None:
    prepared("--pack", world.pack)
    file = key_file(data).with_name("api-key")
    tokens = [file.read_text()]
    prefix = tokens[0].split("_")[1]
    assert run("keys", "revoke", prefix).status == 0
    for text in (tokens[0], "hello\n", ""):
        file.write_text(text)
        ran = prepared()
        assert ran.status == 0, ran.stderr
        assert f"the store does not take the one of {file}" in ran.stderr
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        tokens.append(file.read_text())
        assert f"API key: {file} is there and kept" in prepared().stderr
        assert file.read_text() == tokens[-1]
    assert len(set(tokens)) == 4


def test_a_master_key_that_is_given_is_not_made(
    world: World, data: Path, prepared: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = key_file(data)
    monkeypatch.setenv("MASTER_KEYS", file.read_text().strip())
    monkeypatch.setenv("VEILFACE_MASTER_KEY_VARIABLE", "MASTER_KEYS")
    file.unlink()
    ran = prepared("--pack", world.pack, "--json")
    assert ran.status == 0, ran.stderr
    assert not file.exists()


@pytest.mark.parametrize("secret", [False, True])
def test_serve_finds_the_database_that_was_set_up_unless_its_url_is_secret(
    world: World,
    tmp_path: Path,
    prepared: Callable[..., Ran],
    monkeypatch: pytest.MonkeyPatch,
    secret: bool,
) -> None:
    url = f"sqlite:///{tmp_path}/other.db"
    if secret:
        monkeypatch.setattr(command, "kept_api_key", lambda *_: Path("api-key"))
        url = "postgresql+psycopg://me:word@127.0.0.1:1/veilface"
    monkeypatch.setenv("VEILFACE_DATABASE_URL", url)
    ran = prepared("--pack", world.pack)
    assert ran.status == 0, ran.stderr
    assert "word" not in Path("veilface.toml").read_text()
    monkeypatch.delenv("VEILFACE_DATABASE_URL")
    assert (load_settings().database_url == url) != secret
    assert ("in no file" in ran.stderr) == secret


def test_settings_of_somebody_else_are_kept(
    world: World, data: Path, prepared: Callable[..., Ran]
) -> None:
    file = Path("veilface.toml")
    file.write_text("port = 9000\n")
    ran = prepared("--pack", world.pack)
    assert ran.status == 1
    assert file.read_text() == "port = 9000\n"
    assert "`veilface serve` would start another service" in ran.stderr
    assert f'data_dir = "{data}"' in ran.stderr
    assert "Start it" not in ran.stdout
    agreeing = f'port = 9000\npack = "{world.pack}"\ndata_dir = "data"\n'
    file.write_text(agreeing)
    ran = prepared()
    assert ran.status == 0, ran.stderr
    assert file.read_text() == agreeing


def test_a_stopped_run_goes_on_without_embedding_again(folders: Path, stops: None) -> None:
    stopped = setup()
    assert (stopped.status, "error: stopped" in stopped.stderr) == (1, True)
    assert [file.name for file in Path("veilface-data").iterdir()] == ["setup.cache"]
    again = setup()
    assert "160 embedded before" in again.stderr


def test_faces_that_are_photos_of_the_people_are_not_fitted(folders: Path, stops: None) -> None:
    (folders / "faces" / "x.png").write_bytes((folders / "people/person-6000/0.png").read_bytes())
    ran = setup()
    assert "1 of --faces are photos of people in another role: left out" in ran.stderr


@pytest.mark.long
def test_from_nothing_to_a_contract(folders: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []

    @contextmanager
    def recorded(_description: str) -> Iterator[Callable[[float], None]]:
        yield shares.append

    # So many that a threshold set on them holds for others.
    draw(folders / "people", range(6030, 6050), range(2))
    shutil.copytree("people/person-6000", "people/Six Thousand")
    with monkeypatch.context() as patch:
        patch.setattr(command, "share_done", recorded)
        ran = setup()
    assert ran.status == 0, ran.stderr
    assert "Six Thousand and person-6000 look alike" in ran.stderr
    # The search for axes and dimension counts too: it takes the first 60 %.
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len([share for share in shares if 0 < share < 0.6]) >= 3
    assert "Start it: veilface serve" in ran.stdout
    assert not list(Path("veilface-data").glob("*.cache"))
    assert not list(Path("veilface-data").glob("*.key"))
    assert run("serve", "--check").status == 0
