"""A start that cannot work ends in one sentence; one that works needs little."""

import stat
from collections.abc import Callable, MutableMapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import onnx
import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.http.schemas import VerifyAnswer
from api.service.opening import (
    database_in_use,
    file_sealer,
    open_keyring,
    open_store,
    prepare_database,
    try_inference,
)
from api.service.runtime import Runtime
from api.settings import Settings
from models.pack import ModelPack
from templates.contract.document import Rate
from templates.contract.verdict import Verdict
from templates.decoys import DecoyGenerator
from templates.keys.sealing import MasterKeyring
from templates.store.database import Database
from tests.api.calls import b64, lifted
from tests.api.cli.conftest import run
from tests.api.client import Client
from tests.api.deployment import (
    Deployment,
    M,
    N,
    bearer,
    deploy,
    images,
    make_contract,
    photo,
    unit,
    write_pack,
)
from tests.api.shapes import assert_answer, assert_error
from tests.databases import execute


@pytest.fixture
def fresh(tmp_path: Path) -> Deployment:
    return deploy(tmp_path)


def changed(deployment: Deployment, **changes: Any) -> Settings:
    return deployment.settings.model_copy(update=changes)


def refused(settings: Settings) -> str:
    with pytest.raises(StartError) as caught:
        prepare_database(Runtime.open(settings).store)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert "Traceback" not in sentence
    return sentence


def test_the_master_key_is_made_once_and_private(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    first = open_keyring(settings)
    mode = stat.S_IMODE(settings.resolved_master_key_file.stat().st_mode)
    assert mode == 0o600
    assert open_keyring(settings).current == first.current
    assert not settings.data_dir.exists()


def edited(contract: Path) -> None:
    text = contract.read_text()
    assert '"score_threshold": 2.5' in text
    contract.write_text(text.replace('"score_threshold": 2.5', '"score_threshold": 0.5'))


def of_another_contract(decoys: Path) -> None:
    rng = np.random.default_rng(99)
    DecoyGenerator.fit(unit(rng.normal(size=(300, N)))).save(decoys)


def of_another_deployment(master_key: Path) -> None:
    master_key.unlink()
    MasterKeyring.create(master_key)


@pytest.mark.parametrize(
    ("file", "spoil", "said"),
    [
        ("master_key", Path.unlink, "missing, but the database holds data"),
        ("master_key", of_another_deployment, "contract file"),
        ("master_key", lambda file: file.chmod(0o644), "chmod 600"),
        ("contract", Path.unlink, "veilface calibrate"),
        ("contract", lambda file: file.write_text("{}"), "contract.json cannot be used"),
        ("contract", edited, "contract.json cannot be used"),
        ("decoys", Path.unlink, "there is no decoys file"),
        ("decoys", of_another_contract, "is not the contract's"),
    ],
)
def test_a_file_that_does_not_fit_is_named(
    fresh: Deployment, file: str, spoil: Callable[[Path], object], said: str
) -> None:
    spoil(getattr(fresh.settings, f"resolved_{file}_file"))
    assert said in refused(fresh.settings)
    if spoil == Path.unlink:
        assert not getattr(fresh.settings, f"resolved_{file}_file").exists()


def test_settings_that_do_not_fit_are_named(fresh: Deployment, tmp_path: Path) -> None:
    (tmp_path / "not-a-database").write_bytes(b"hello" * 1000)
    for changes, said in (
        ({"pack": tmp_path / "absent"}, "absent"),
        ({"providers": ("cuda",)}, "cuda"),
        ({"database_url": f"sqlite:///{tmp_path / 'not-a-database'}"}, "database"),
    ):
        assert said in refused(changed(fresh, **changes)).lower()


def test_another_pack_is_named_beside_the_contract(fresh: Deployment, tmp_path: Path) -> None:
    other = write_pack(tmp_path / "other")
    model = onnx.load(other / "tiny.onnx")
    model.producer_name = "somebody else"
    onnx.save(model, other / "tiny.onnx")
    sentence = refused(changed(fresh, pack=other))
    assert ModelPack.load(other).info.embedder_sha256[:16] in sentence
    assert fresh.contract.binding.embedder_sha256[:16] in sentence


def test_a_pack_that_fails_on_its_first_picture(
    fresh: Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fresh.settings.pack is not None
    pack = ModelPack.load(fresh.settings.pack, threads=1)
    try_inference(pack)
    monkeypatch.setattr(pack, "embed", lambda crops: np.zeros((1, N), np.float32))
    with pytest.raises(StartError, match="unit vector"):
        try_inference(pack)


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://user:hunter2@127.0.0.1:1/x",
        "mysql://user:hunter2@host/x",
        "not a url hunter2",
        "sqlite:////proc/no/such/place.db",
        "sqlite://",
    ],
)
def test_a_wrong_database_is_one_sentence_without_the_password(
    fresh: Deployment, tmp_path: Path, url: str
) -> None:
    assert "hunter2" not in refused(changed(fresh, database_url=url))
    if "hunter2" in url:  # asked before a first master key is made; an absent file is empty
        with pytest.raises(StartError) as caught:
            open_keyring(changed(fresh, database_url=url, master_key_file=tmp_path / "absent"))
        assert "hunter2" not in str(caught.value)
        assert not (tmp_path / "absent").exists()


def test_another_applications_rows_do_not_count(tmp_path: Path, database_url: str) -> None:
    database = Database(database_url)

    execute(database, "CREATE TABLE orders (id integer)", "INSERT INTO orders VALUES (1)")
    settings = Settings(data_dir=tmp_path / "data", database_url=database_url)
    assert not database_in_use(database_url)
    store = open_store(settings, open_keyring(settings))
    store.upgrade()
    assert database_in_use(database_url)
    store.close()
    database.close()


def test_a_database_that_is_down_is_not_blamed_on_the_key_file(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data", database_url="postgresql://u@127.0.0.1:1/x")
    with pytest.raises(StartError, match="database cannot be asked") as caught:
        open_keyring(settings)
    assert "cannot be used" not in str(caught.value)
    settings.resolved_master_key_file.parent.mkdir(parents=True)
    settings.resolved_master_key_file.write_text("nonsense")
    with pytest.raises(StartError, match=r"master key file .* cannot be used"):
        open_keyring(settings)


def test_of_two_first_starts_at_once_the_second_takes_the_firsts_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    made: list[str] = []

    def meanwhile(_: str) -> bool:
        path = settings.resolved_master_key_file
        path.parent.mkdir(parents=True)
        made.append(MasterKeyring.create(path).current)
        return False

    monkeypatch.setattr("api.service.opening.database_in_use", meanwhile)
    assert [open_keyring(settings).current] == made


def test_without_a_pack_templates_and_embeddings_work(fresh: Deployment) -> None:
    app = create_app(changed(fresh, pack=None))
    with Client(app, headers=bearer(fresh.token)) as client:
        base = "/v1/subjects/a"
        assert_error(
            client.put(f"{base}/enrollment", files=images(photo(1))), 503, "model_unavailable"
        )
        probe = client.post(f"{base}/verify", files=images(photo(1), name="image"))
        assert_error(probe, 503, "model_unavailable")
        assert client.get("/v1/contract").json()["photos"] is False
        fresh.allow_templates()
        put = client.put(f"{base}/enrollment", json={"template": b64(lifted(fresh))})
        assert put.status_code == 201
        descriptor = unit(np.random.default_rng([5, 0]).normal(size=(1, N)))[0]
        answer = client.post(f"{base}/verify", json={"embedding": descriptor.tolist()})
        assert answer.json()["decision"] == "accept"


@pytest.mark.parametrize("error", [RuntimeError("hunter2"), StartError("no contract")])
def test_the_server_is_not_handed_the_text_of_a_failed_start(
    fresh: Deployment, capfd: pytest.CaptureFixture[str], error: Exception
) -> None:
    """As uvicorn starts an application: what is sent to it ends in the log."""
    sent: list[MutableMapping[str, Any]] = []

    def fail(_: Settings) -> Runtime:
        raise error

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "lifespan.startup"}

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    async def start() -> None:
        await create_app(fresh.settings, open_runtime=fail)({"type": "lifespan"}, receive, send)

    with pytest.raises(type(error)):
        anyio.run(start)
    assert sent == [{"type": "lifespan.startup.failed"}]
    logged = capfd.readouterr().err
    assert "hunter2" not in logged
    assert type(error).__name__ in logged


def test_a_template_of_an_older_contract_is_refused(fresh: Deployment) -> None:
    with Client(create_app(fresh.settings), headers=bearer(fresh.token)) as client:
        client.put("/v1/subjects/a/enrollment", files=images(photo(1)))
    assert fresh.settings.pack is not None
    other = make_contract(ModelPack.load(fresh.settings.pack, threads=1), fresh.source, m=M - 1)
    other.save(fresh.settings.resolved_contract_file, file_sealer(open_keyring(fresh.settings)))
    with Client(create_app(fresh.settings), headers=bearer(fresh.token)) as client:
        probe = client.post("/v1/subjects/a/verify", files=images(photo(1), name="image"))
        assert_error(probe, 409, "contract_mismatch")
        # A key that may not know who is enrolled is answered as for a subject that does not exist.
        blind = bearer(fresh.key("verify"))
        answers = []
        for subject in ("a", "nobody"):
            answer = client.post(
                f"/v1/subjects/{subject}/verify",
                files=images(photo(1), name="image"),
                headers=blind,
            )
            body = assert_answer(answer, 200, VerifyAnswer)
            del body["request_id"]
            answers.append(body)
        assert answers[0] == answers[1]
        assert (answers[0]["decision"], answers[0]["reason"]) == ("reject", "no_match")
        assert_error(client.get("/v1/subjects/a/export"), 409, "contract_mismatch")
        assert client.get("/v1/subjects/a").json()["current"] is False
        put = client.put("/v1/subjects/a/enrollment", files=images(photo(1)))
        assert put.status_code == 200


@pytest.mark.parametrize("measured", [True, False])
def test_privacy_that_is_not_proven_is_served_unless_it_is_required(
    fresh: Deployment, measured: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = fresh.settings
    rate = Rate(errors=90, trials=400, ci_low=0.1, ci_high=0.3)
    made = fresh.contract.verdict
    bad = Verdict(replace(made.privacy, rate=rate), replace(made.accuracy, rate=rate))
    weak = replace(fresh.contract, verdict=bad if measured else None)
    weak.save(settings.resolved_contract_file, file_sealer(open_keyring(settings)))
    why = "22.5 % of them (90 of 400), and 5 % is" if measured else "nobody measured"
    with Client(create_app(settings)) as client:
        answer = client.get("/v1/contract", headers=bearer(fresh.token)).json()
        assert client.get("/health/ready").status_code == 200
    assert (answer["verdict"] and answer["verdict"]["privacy"]["status"]) == (
        "FAIL" if measured else None
    )
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "not proven" in line)
    assert why in line
    check = ("serve", "--check", "--data-dir", settings.data_dir, "--pack", settings.pack)
    assert run(*check).status == 0

    refusing = Client(create_app(changed(fresh, require_private=True)))
    with pytest.raises(StartError, match="require_private") as caught, refusing:
        pass
    assert why in str(caught.value)
    refusal = run(*check, "--require-private")
    assert refusal.status == 1
    assert why in refusal.stderr
