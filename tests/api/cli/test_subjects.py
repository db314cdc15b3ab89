import os
import shutil
import subprocess
import sys

import pytest

from api.service.runtime import Runtime
from models.demo import DEMO_NOTICE
from models.errors import ProviderUnavailable
from templates.errors import DecoyError, StoreBusy, StoreUnavailable
from tests.api.cli.conftest import run
from tests.patience import PATIENCE_S

STORED = ("--tenant", "default")


def test_enroll_then_accept_and_reject(world, veilface):
    enrolled = veilface("enroll", "ann", *world.photos(1, range(3)), "--pack", world.pack, "--json")
    assert enrolled.status == 0, enrolled.stderr
    assert "note: privacy is not proven: a thief of a template" in enrolled.stderr
    assert enrolled.json["replaced"] is False
    assert enrolled.json["photos"] == 3
    assert DEMO_NOTICE in enrolled.stderr

    own = veilface("verify", "ann", *world.photos(1, range(3, 4)), "--pack", world.pack, "--json")
    assert own.status == 0, own.stderr
    assert own.json["decision"] == "accept"
    assert own.json["fmr"] == 0.01
    assert own.json["contract_id"] == world.calibrated["contract"]["contract_id"]
    assert "distance" not in own.json
    assert own.json["notice"] == enrolled.json["notice"] == DEMO_NOTICE
    assert DEMO_NOTICE in own.stderr

    burst = veilface("verify", "ann", *world.photos(1, range(5)), "--pack", world.pack)
    assert burst.status == 0, burst.stderr

    other = veilface("verify", "ann", *world.photos(2, range(1)), "--pack", world.pack)
    assert other.status == 1
    assert other.stdout.startswith("decision: reject\n")

    again = veilface("enroll", "ann", *world.photos(1, range(1)), "--pack", world.pack, "--json")
    assert again.json["replaced"] is True


@pytest.mark.parametrize("listed", [False, True])
def test_many_are_enrolled_and_who_is_not_is_named(world, veilface, tmp_path, listed):
    people = tmp_path / "people"
    shutil.copytree(world.people, people)
    (people / "person-2" / "0.png").write_bytes(b"no picture")
    shutil.copy(people / "person-1" / "0.png", people / "person-3" / "other.png")
    (people / "a b").mkdir()
    shutil.copy(people / "person-1" / "1.png", people / "a b")
    (people / "person-1").rename(people / "Zo\N{LATIN SMALL LETTER E WITH DIAERESIS}")
    (people / "Zoe\N{COMBINING DIAERESIS}").mkdir()
    shutil.copy(people / "Zo\xeb" / "2.png", people / "Zoe\N{COMBINING DIAERESIS}" / "9.png")
    source = people
    if listed:
        source = tmp_path / "people.csv"
        photos = (photo.relative_to(tmp_path) for photo in sorted(people.glob("*/*.png")))
        lines = (f"{photo.parent.name},{photo}" for photo in photos)
        source.write_text("\n".join(["subject,photo", *lines, ""]), encoding="utf-8")
    ran = veilface("enroll", "--from", source, "--pack", world.pack, "--json")
    assert ran.status == 1, ran.stderr
    assert ran.json["tenant"] == "default"
    enrolled = {one["subject_id"]: one["photos"] for one in ran.json["enrolled"]}
    # Two spellings of one id are one person.
    assert enrolled == {"Zo\xeb": 6, "person-4": 5}
    failed = {one["subject_id"]: one["message"] for one in ran.json["failed"]}
    assert set(failed) == {"a b", "person-2", "person-3"}
    assert failed["person-2"].startswith("0.png: ")
    assert failed["person-3"].startswith("other.png does not look like the person on 0.png")
    assert "a subject id has 1 to 128 characters" in failed["a b"]
    accepted = veilface("verify", "person-4", *world.photos(4, range(3)), "--pack", world.pack)
    assert accepted.status == 0, accepted.stderr


def test_a_person_without_a_photo_that_is_read_is_named(world, veilface, tmp_path):
    people = tmp_path / "people"
    shutil.copytree(world.people / "person-1", people / "person-1")
    for name in ("empty", "gif", ".hidden"):
        (people / name).mkdir()
    (people / "gif" / "1.gif").write_bytes(b"GIF89a")
    ran = veilface("enroll", "--from", people, "--pack", world.pack)
    assert ran.status == 1
    assert "Enrolled 1 of 3 people, from 5 photos." in ran.stdout
    named = veilface("enroll", "--from", people, "--pack", world.pack, "--json").json["failed"]
    assert [one["subject_id"] for one in named] == ["empty", "gif"]
    assert all(one["message"].startswith("no photo that is read") for one in named)


@pytest.mark.parametrize(
    ("error", "failed"),
    [
        (StoreBusy("another write takes too long"), 1),
        (DecoyError("there is no decoy of this class"), 1),
        (ProviderUnavailable("cuda is not there"), 1),
        (StoreUnavailable("the database cannot be reached"), 3),
    ],
)
def test_what_happens_to_one_person_leaves_the_report(world, veilface, monkeypatch, error, failed):
    """An outage of the database ends the run: the rest is named with its reason."""
    put = Runtime.put

    def fails_once(runtime, tenant, subject, *args, **kwargs):
        if subject == "person-2":
            raise error
        return put(runtime, tenant, subject, *args, **kwargs)

    monkeypatch.setattr(Runtime, "put", fails_once)
    ran = veilface("enroll", "--from", world.people, "--pack", world.pack, "--json")
    assert ran.status == 1, ran.stderr
    assert [one["subject_id"] for one in ran.json["failed"]] == [
        f"person-{number}" for number in range(2, 2 + failed)
    ]
    assert {one["message"] for one in ran.json["failed"]} == {str(error)}
    assert len(ran.json["enrolled"]) == 4 - failed


def test_many_are_enrolled_and_all_is_well(world, veilface):
    ran = veilface("enroll", "--from", world.people, "--pack", world.pack)
    assert (ran.status, ran.stdout) == (0, "Enrolled 4 of 4 people, from 20 photos.\n"), ran.stderr


def test_what_stands_in_the_way_is_named(world, veilface, tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    no_value = tmp_path / "value.csv"
    no_value.write_text("subject,photo\nann,\n")
    photo = world.photos(1, range(1))
    pack = ("--pack", world.pack)
    cases = [
        (("enroll", "ann", *photo, broken, *pack), 1, "broken.png"),
        (("enroll", "ann", *photo, tmp_path / "absent.png", *pack), 2, "no such photo"),
        (("enroll", "ann", *photo, *world.photos(2, range(1)), *pack), 1, "same person"),
        (("enroll", "ann", *photo, *pack, "--tenant", "elsewhere"), 1, "no tenant"),
        (("enroll", "ann", *(photo * 11), *pack), 2, "1 to 10 photos"),
        (("enroll", "ann", *photo), 2, "--pack"),
        (("enroll",), 2, "many people with --from"),
        (("enroll", "ann", *photo, "--from", tmp_path, *pack), 2, "many people with --from"),
        (("enroll", "--from", tmp_path / "absent", *pack), 2, "neither a folder nor"),
        (("enroll", "--from", no_value, *pack), 2, "both on every line"),
        (("enroll", "--from", tmp_path, *pack), 1, "no photo in a person's folder"),
    ]
    for arguments, status, said in cases:
        ran = veilface(*arguments)
        assert (ran.status, ran.stdout) == (status, ""), (arguments, ran)
        assert said in ran.stderr
        assert ran.stderr.startswith(("error: ", "note: "))


def test_a_verification_without_a_decision_is_no_rejection(world, veilface, tmp_path):
    veilface("enroll", "ann", *world.photos(1, range(3)), "--pack", world.pack)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    ann = ("verify", "ann", *world.photos(1, range(3, 4)))
    pack = ("--pack", world.pack)
    absent = tmp_path / "absent"
    cases = [
        (("verify", "ann", absent, *pack), 2, "no such photo"),
        (ann, 2, "--pack"),
        ((*ann, *pack, "--unknown-option"), 2, "No such option"),
        (("verify", "nobody", *world.photos(1, range(1)), *pack), 3, "nobody is enrolled as"),
        (("verify", "ann", broken, *pack), 3, "broken.png"),
        ((*ann, broken, *pack), 3, "broken.png"),
        ((*ann, *world.photos(2, range(1)), *pack), 3, "3.png and 0.png do not look like the same"),
        ((*ann, *world.photos(1, range(5)), *pack), 2, "1 to 5 photos"),
        (("verify", "ann", tmp_path, *pack), 3, "Is a directory"),
        ((*ann, "--pack", absent), 3, "does not exist"),
        ((*ann, *pack, "--tenant", "elsewhere"), 3, "no tenant"),
        ((*ann, *pack, "--database-url", f"sqlite:///{absent}/no.db"), 3, "database"),
        ((*ann, *pack, "--database-url", "postgresql://127.0.0.1:1/no"), 3, "database"),
        ((*ann, *pack, "--onnx-threads", "-1"), 3, "onnx_threads"),
        ((*ann, *pack, "--level", "fmr-1e-9"), 3, "fmr-1e-2"),
    ]
    for arguments, status, said in cases:
        ran = veilface(*arguments)
        assert (ran.status, ran.stdout) == (status, ""), (arguments, ran)
        assert said in ran.stderr


@pytest.mark.parametrize("as_json", [(), ("--json",)])
@pytest.mark.parametrize(("person", "status"), [(1, 0), (2, 1)])
def test_the_status_is_the_decision_where_nobody_reads_it(world, data, person, status, as_json):
    settings = ("--pack", str(world.pack), "--data-dir", str(data))
    assert run("enroll", "ann", *world.photos(1, range(3)), *settings).status == 0
    read, write = os.pipe()
    os.close(read)
    photo = str(*world.photos(person, range(3, 4)))
    done = subprocess.run(
        [sys.executable, "-P", "-m", "veilface", "verify", "ann", photo, *settings, *as_json],
        stdout=write, stderr=write, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    os.close(write)
    assert done.returncode == status
