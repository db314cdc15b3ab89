import shutil
import stat

import pytest

from api.service.opening import file_sealer
from models.demo import DEMO_NOTICE
from templates.contract.document import Binding
from templates.decoys import DecoyGenerator, DecoyPool, load_source
from templates.keys.sealing import MasterKeyring
from tests.api.cli.conftest import draw, key_file, run

RACES = ("White", "Black", "Indian")


def test_a_generator_is_made(world):
    assert world.built["kind"] == "generator"
    assert world.built["descriptors"] == 150
    assert world.built["failure_to_acquire"] == {"photos": 150, "failed": 0, "reasons": {}}
    source = DecoyGenerator.load(world.data / "decoys.veil")
    assert source.source_id == world.built["source_id"]
    binding = Binding.from_json(world.calibrated["contract"]["binding"])
    assert source.made_with == binding.embedding_id


@pytest.mark.parametrize(("kind", "noted"), [("generator", True), ("pool", False)])
def test_too_few_faces_for_a_generator_are_noted(world, veilface, tmp_path, kind, noted):
    ran = veilface(
        *("decoys", "build", world.decoy_faces, "--pack", world.pack, "--kind", kind),
        *("--out", tmp_path / "decoys.veil"),
    )
    assert ran.status == 0, ran.stderr
    assert ("150 faces are few for 256 numbers each" in ran.stderr) is noted


@pytest.fixture
def labelled_source(world, tmp_path):
    """Twelve photos laid out as FairFace is, one of them broken."""
    train = tmp_path / "train"
    train.mkdir()
    lines = ["file,age,gender,race,service_test"]
    for number, photo in enumerate(sorted(world.decoy_faces.rglob("*.png"))[:12]):
        shutil.copy(photo, train / f"{number}.png")
        gender = "Female" if number % 2 else "Male"
        lines.append(f"train/{number}.png,03-Sep,{gender},{RACES[number % 3]},FALSE")
    (train / "5.png").write_bytes(b"not a picture")
    (tmp_path / "fairface_label_train.csv").write_text("\n".join(lines) + "\n")
    return train


def test_a_pool_is_sealed_and_keeps_the_labels(world, veilface, data, labelled_source, tmp_path):
    out = tmp_path / "pool.veil"
    ran = veilface(
        *("decoys", "build", labelled_source, "--pack", world.pack, "--kind", "pool"),
        *("--out", out, "--json"),
    )
    assert ran.status == 0, ran.stderr
    assert ran.json["labelled"]
    assert ran.json["descriptors"] == 11
    assert ran.json["failure_to_acquire"]["reasons"] == {"unsupported_image": 1}
    assert "1 of 12 photos skipped: unsupported image" in ran.stderr
    assert DEMO_NOTICE in ran.stderr
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    sealer = file_sealer(MasterKeyring.load(key_file(data)))
    pool = load_source(out, sealer)
    assert isinstance(pool, DecoyPool)
    assert pool.labelled
    assert pool.source_id == ran.json["source_id"]


def test_people_and_photos_are_left_out(world, veilface, labelled_source, tmp_path):
    listing = tmp_path / "leave-out.txt"
    listing.write_text("0.png\n5.png\n")
    ran = veilface(
        *("decoys", "build", labelled_source, "--pack", world.pack, "--kind", "pool"),
        *("--out", tmp_path / "pool.veil", "--exclude", listing, "--limit", "8", "--json"),
    )
    assert ran.status == 0, ran.stderr
    assert ran.json["left_out"] == 2
    assert ran.json["descriptors"] == 8
    assert ran.json["failure_to_acquire"]["failed"] == 0


@pytest.fixture(scope="module")
def volunteers(tmp_path_factory):
    """Fifty people with two photos, in folders of their own."""
    return draw(tmp_path_factory.mktemp("volunteers"), range(9000, 9050), range(2))


def test_a_generator_is_adapted_to_a_sample(world, veilface, volunteers, tmp_path):
    """Of two folders; the file is an ordinary one."""
    out = tmp_path / "decoys.veil"
    ran = veilface(
        *("decoys", "build", world.decoy_faces, world.labelled, "--like", volunteers),
        *("--pack", world.pack, "--out", out, "--json"),
    )
    assert ran.status == 0, ran.stderr
    assert (ran.json["descriptors"], ran.json["like"]) == (350, 100)
    adapted = DecoyGenerator.load(out)
    assert adapted.source_id == ran.json["source_id"]


def test_what_cannot_be_made_is_refused(world, data, labelled_source, volunteers, tmp_path):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "1.jpg").write_bytes(b"\xff\xd8\xff")
    stranger = sorted(world.decoy_faces.rglob("*.png"))[12]
    shutil.copy(stranger, labelled_source / "stranger.png")
    faces, pack = world.decoy_faces, ("--pack", world.pack)
    out = tmp_path / "decoys.veil"
    for arguments, status, said in (
        ((labelled_source, *pack, "--kind", "pool"), 1, "the first is stranger.png"),
        ((labelled_source, *pack), 1, "100 or more embeddings"),
        ((tmp_path / "broken", *pack), 1, "no photo gave an embedding (1 of 1 photos"),
        ((faces,), 2, "--pack"),
        ((faces, volunteers, "--like", volunteers, *pack), 1, "100 of the 100 photos to adapt to"),
        ((faces, "--like", world.people, *pack), 1, "will be enrolled, and 20 are"),
        ((faces, "--like", volunteers, "--kind", "pool", *pack), 2, "--like adapts a generator"),
    ):
        ran = run("decoys", "build", *arguments, "--data-dir", data, "--out", out)
        assert (ran.status, said in ran.stderr) == (status, True), ran.stderr
        assert not out.exists()
