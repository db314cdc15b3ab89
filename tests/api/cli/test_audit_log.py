import base64
import json
import sqlite3

import pytest

from api.service.opening import open_keyring, open_store
from api.settings import Settings
from tests.api.cli.conftest import copied, run


@pytest.fixture(scope="module")
def logged(world, tmp_path_factory):
    """A data folder with a few lines in its log: keys, an enrollment, two verifications."""
    data = copied(world.data, tmp_path_factory.mktemp("logged"))
    options = ("--pack", world.pack, "--data-dir", data)
    assert run("keys", "create", "--right", "verify", "--data-dir", data).status == 0
    assert run("enroll", "ann", *world.photos(1, range(3)), *options).status == 0
    assert run("verify", "ann", *world.photos(1, range(3, 4)), *options).status == 0
    assert run("verify", "ann", *world.photos(2, range(1)), *options).status == 1
    return data


@pytest.fixture
def data(logged, tmp_path):
    return copied(logged, tmp_path)


@pytest.fixture
def log(veilface):
    """Commands on a log of this test alone."""
    return veilface


def tamper(data, statement):
    """Change the table as somebody may who owns the database."""
    with sqlite3.connect(data / "veilface.db") as connection:
        assert connection.execute(statement).rowcount > 0
    connection.close()


def lines(ran):
    return [json.loads(line) for line in ran.stdout.splitlines()]


def test_a_whole_log_is_verified_and_shown(log):
    ran = log("audit-log", "verify", "--json")
    assert ran.status == 0, ran.stderr
    assert ran.json["intact"] is True
    shown = lines(log("audit-log", "show"))
    assert ran.json["lines"] == len(shown)
    assert ran.json["head"] == log("audit-log", "head").stdout.strip()
    assert [line["sequence"] for line in shown] == list(range(1, len(shown) + 1))
    done = [(line["action"], line["outcome"]) for line in shown]
    assert ("key-create", "created") in done
    assert done[-3:] == [
        ("enroll", "created"),
        ("verify-locally", "accept"),
        ("verify-locally", "reject"),
    ]
    assert all(line["actor"].startswith("operator:") for line in shown[-3:])
    assert "ann" not in json.dumps(shown)
    assert log("audit-log", "verify").stdout.startswith("intact: yes\n")


def test_lines_are_found_by_subject_and_number(log):
    everything = lines(log("audit-log", "show"))
    of_ann = lines(log("audit-log", "show", "--subject", "ann"))
    assert [line["action"] for line in of_ann] == ["enroll", "verify-locally", "verify-locally"]
    assert len({line["subject"] for line in of_ann}) == 1
    assert lines(log("audit-log", "show", "--subject", "bob")) == []
    assert lines(log("audit-log", "show", "--after", "1", "--limit", "1")) == everything[1:2]


def test_an_unknown_tenant_has_no_empty_log(log):
    ran = log("audit-log", "show", "--tenant", "elsewhere")
    assert (ran.status, ran.stdout) == (1, "")
    assert "no tenant" in ran.stderr


@pytest.mark.parametrize(
    ("statement", "problem", "record"),
    [
        ("DELETE FROM audit_log WHERE sequence = 2", "missing", None),
        ("UPDATE api_keys SET rights = 'admin'", None, "made up or altered"),
    ],
)
def test_what_was_tampered_with_is_told(log, data, statement, problem, record):
    tamper(data, statement)
    ran = log("audit-log", "verify")
    assert ran.status == 1
    assert (problem or record) in ran.stdout
    ran = log("audit-log", "verify", "--json")
    assert (ran.status, ran.json["intact"]) == (1, False)
    assert ran.json["problem"] == (problem and {"sequence": 2, "problem": problem})
    assert bool(ran.json["records"]) is (record is not None)
    assert all(record in told["problem"] for told in ran.json["records"])


def test_lines_move_into_an_archive(log, data, tmp_path):
    file, moved = tmp_path / "old.jsonl", log("audit-log", "head", "--json").json["sequence"]
    with sqlite3.connect(data / "veilface.db") as connection:
        (mac,) = connection.execute("SELECT mac FROM audit_log WHERE sequence = 2").fetchone()
    ran = log("audit-log", "archive", file, "--through", "2", "--json")
    assert ran.json == {"lines": 2, "base": f"0:{'0' * 64}", "last": f"2:{mac.hex()}"}
    assert [line["sequence"] for line in lines(log("audit-log", "show"))] == [*range(3, moved + 2)]
    assert log("audit-log", "verify").status == 0
    refused = log("audit-log", "archive", file)
    assert refused.status == 1
    assert "cannot be written" in refused.stderr
    key = public_key(data)
    checked = ("audit-log", "verify-archive", file, "--public-key")
    assert run(*checked, key, "--json").json == ran.json
    file.write_text(file.read_text().replace("created", "deleted"))
    assert run(*checked, key).status == 1
    assert run(*checked, "%%").status == 2


def public_key(data):
    settings = Settings(data_dir=data)
    store = open_store(settings, open_keyring(settings))
    try:
        return base64.b64encode(store.signer.public_key()).decode()
    finally:
        store.close()


def test_an_anchor_finds_a_log_that_was_put_back(log, data, tmp_path, world):
    old = (data / "veilface.db").read_bytes()
    kept = tmp_path / "head.txt"
    assert log("keys", "create", "--right", "verify").status == 0
    kept.write_text(log("audit-log", "head").stdout)
    assert log("audit-log", "verify", "--anchor", kept).status == 0
    for extra in data.glob("veilface.db-*"):
        extra.unlink()
    (data / "veilface.db").write_bytes(old)
    assert log("audit-log", "verify").status == 0  # the old state is whole in itself
    ran = log("audit-log", "verify", "--anchor", kept)
    assert ran.status == 1
    assert "anchor" in ran.stdout


def test_what_is_no_anchor_is_refused(log):
    ran = log("audit-log", "verify", "--anchor", "yesterday")
    assert ran.status == 2
    assert "audit-log head" in ran.stderr
