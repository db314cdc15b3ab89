"""The demo, at a small scale, through its real process and HTTP."""

import contextlib
import json
import sqlite3
import stat

import pytest

from api.demo.people import Scale
from api.demo.run import Counts, faults_of, run_demo
from api.http.errors import StartError
from models.demo import DEMO_NOTICE
from models.pack_graphs import Role, read_graphs
from tests.api.cli.conftest import run

SMALL = Scale(
    enrolled=3, strangers=4, decoy_people=150, calibration_people=50, calibration_photos=4
)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "data"
    said = []
    return run_demo(folder, scale=SMALL, say=said.append), folder, said


@pytest.mark.long
def test_it_accepts_the_enrolled_and_rejects_the_others(played):
    outcome, _, said = played
    assert outcome.faults == ()
    assert outcome.demo_model
    assert [person.name for person in outcome.people] == ["person-1", "person-2", "person-3"]
    assert all(person.genuine_trials == 2 for person in outcome.people)
    assert all(person.impostor_trials == 2 * 2 + 4 for person in outcome.people)
    assert sum(person.genuine_accepted for person in outcome.people) >= 5
    assert "starting the service" in said
    assert outcome.refused_photos == ()


@pytest.mark.long
def test_what_it_shows_of_the_database_is_ciphertext(played):
    outcome, folder, _ = played
    database = (folder / "veilface.db").read_bytes()
    assert len(outcome.stored) == 3
    for entry in outcome.stored:
        assert entry.ciphertext_bytes == entry.template_bytes + 29
        assert 0 < entry.foot_norm < 0.8
        if entry.name == outcome.erased:
            assert bytes.fromhex(entry.ciphertext_excerpt) not in database


@pytest.mark.long
def test_the_erased_person_is_gone_and_the_receipt_says_so(played):
    outcome, _, _ = played
    assert outcome.rows_after_erasure == 0
    assert outcome.receipt["held"] is True


@pytest.mark.long
def test_the_folder_is_ready_for_serve(played):
    _, folder, _ = played
    checked = run("serve", "--check", "--config", folder / "veilface.toml")
    assert checked.status == 0, checked.stderr
    assert DEMO_NOTICE in checked.stderr
    assert "demo = true" in (folder / "veilface.toml").read_text()
    for name in ("api-key", "master.key"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600
    token = (folder / "api-key").read_text().strip()
    assert token.startswith("vf_")
    assert token not in (folder / "serve.log").read_text()
    assert sorted(path.name for path in (folder / "people").iterdir())[0] == "person-1"
    # What the demo tried locks nobody whom the service finds there.
    options = ("--data-dir", folder, "--master-key-file", folder / "master.key")
    assert "no failed attempts" in run("db", "unlock", "person-2", *options).stderr


@pytest.mark.long
def test_it_replaces_its_own_folder_and_no_other(played, tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(StartError, match="not empty and not a demo"):
        run_demo(tmp_path, scale=SMALL)
    assert (tmp_path / "thesis.txt").exists()
    ran = run("demo", "--folder", tmp_path)
    assert ran.status == 1
    assert ran.stdout == ""


def test_a_folder_that_is_being_served_is_not_replaced(tmp_path, monkeypatch):
    folder = tmp_path / "demo"
    monkeypatch.setattr("api.demo.run.build_demo_pack", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_demo(folder, scale=SMALL)
    with contextlib.closing(sqlite3.connect(folder / "veilface.db")) as served:
        served.execute("PRAGMA journal_mode = WAL")
        served.execute("CREATE TABLE subjects (id)")
        with pytest.raises(StartError, match="is being served"):
            run_demo(folder, scale=SMALL)
    with pytest.raises(ZeroDivisionError):
        run_demo(folder, scale=SMALL)
    assert not (folder / "veilface.db").exists()


def test_a_pack_without_faces_is_refused(tmp_path):
    ran = run("demo", "--folder", tmp_path / "new", "--pack", tmp_path)
    assert ran.status == 1
    assert "both --pack and --faces" in ran.stderr


@pytest.mark.long
def test_the_command_prints_tables_and_the_notice(played, monkeypatch):
    outcome, folder, _ = played
    monkeypatch.setattr("api.cli.demo.run_demo", lambda *_, **__: outcome)
    shown = run("demo")
    assert shown.status == 0
    assert shown.stdout.count(DEMO_NOTICE) >= 3
    assert "person-1" in shown.stdout
    assert f"veilface serve --config {folder}/veilface.toml" in shown.stdout
    told = json.loads(run("demo", "--json").stdout)
    assert told["notice"] == DEMO_NOTICE
    assert told["people"][0]["genuine_trials"] == 2


def test_it_fails_when_it_should():
    good, lax = Counts("a", 1, 2, 0, 50), Counts("c", 2, 2, 26, 50)
    rejected = Counts("b", 0, 2, 0, 50)
    assert faults_of([good]) == []
    assert faults_of([good, rejected, lax]) == [
        "b was rejected in most genuine attempts",
        "most impostors were accepted as c",
    ]


@pytest.mark.long
def test_real_faces_and_weights(mbf_pack_dir, lfw_aligned, tmp_path):
    """The embedder alone, on aligned crops: detection is tested elsewhere, and takes long."""
    embedder = next(
        graph.file for graph in read_graphs(mbf_pack_dir) if graph.role is Role.EMBEDDER
    )
    people = [path for path in sorted(lfw_aligned.iterdir()) if path.is_dir()]
    able = [path for path in people if 5 <= len(list(path.iterdir())) <= 7][:60]
    faces = tmp_path / "faces"
    faces.mkdir()
    for person in able:
        (faces / person.name).symlink_to(person)
    folder = tmp_path / "data"
    outcome = run_demo(
        folder,
        pack=mbf_pack_dir / embedder,
        faces=faces,
        scale=Scale(enrolled=3, strangers=2),
    )
    assert outcome.faults == ()
    assert not outcome.demo_model
    assert "m = 16, n = 512" in outcome.strategy
    assert "demo = true" not in (folder / "veilface.toml").read_text()
    assert sum(person.genuine_accepted for person in outcome.people) >= 5
