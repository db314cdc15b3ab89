"""The service that climbers attack: the real one, and nothing of it stays."""

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest

from api.cli.attacked_service import Ask, attacked_service, leaves_on_sigterm
from api.http.errors import StartError
from attacks.outcomes import GENERATED, Scheme
from attacks.population import draw_population
from attacks.system import System
from templates.contract import wire
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from tests.attacks.conftest import small_system
from tests.attacks.own_decisions import in_process
from tests.leaks import LeakSearch
from tests.verify.synthetic import draw_people, make_generator, unit

VICTIMS = 3


@dataclass(frozen=True)
class Attacked:
    """What two climbers were given, and the folder of the service while it ran."""

    scored: list[Ask]
    deciding: list[Ask]
    folder: Path
    outside: Path


@pytest.fixture(scope="module")
def system() -> System:
    people = draw_people(340, photos=(3, 2, 2), noise=0.5, seed=12)
    population = draw_population(people.descriptors, people.names, victims=20, owners=2, seed=5)
    return small_system(population, Scheme("adversarial", GENERATED, 6), make_generator())


def wires(system: System) -> list[bytes]:
    contract_id = system.contract.contract_id
    return [wire.encode(system.templates[i], contract_id=contract_id) for i in range(VICTIMS)]


@pytest.fixture(scope="module")
def attacked(system: System, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Attacked]:
    outside = tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(outside))
        with attacked_service(system.contract, system.source, wires(system)) as (scored, deciding):
            (folder,) = outside.iterdir()
            yield Attacked(scored, deciding, folder, outside)
        assert list(outside.iterdir()) == []


def test_scores_are_those_of_the_system_s_own_decisions(system: System, attacked: Attacked) -> None:
    mine = in_process(system, range(VICTIMS), scores=True)
    probes = [*system.victims.fresh[:VICTIMS], *system.attacker[:8], system.templates.feet[0]]
    for number, ask in enumerate(attacked.scored):
        for probe in probes:
            probe = unit(probe)
            theirs, expected = ask(probe), mine[number](probe)
            assert expected.score is not None
            assert theirs.score == pytest.approx(expected.score, abs=1e-3)
            assert theirs.accepted == expected.accepted


def test_the_key_without_the_right_gets_no_score(system: System, attacked: Attacked) -> None:
    for probe in (system.victims.fresh[0], system.attacker[0]):
        answer = attacked.deciding[0](probe)
        assert answer.score is None
        assert answer.accepted == attacked.scored[0](probe).accepted


def test_the_victim_is_accepted_and_strangers_are_not(system: System, attacked: Attacked) -> None:
    for number, ask in enumerate(attacked.deciding):
        assert ask(system.victims.enrolled[number]).accepted
        assert ask(system.victims.fresh[number]).accepted
    others = system.victims.fresh[VICTIMS : VICTIMS + 10]
    assert sum(attacked.deciding[0](probe).accepted for probe in others) == 0


def test_the_folder_is_the_owner_s_alone(attacked: Attacked) -> None:
    assert attacked.folder.stat().st_mode & 0o077 == 0
    assert attacked.folder.name.startswith("veilface-audit-")
    assert not (attacked.folder / "serve.out").exists()


def test_nothing_of_probes_and_templates_stands_in_the_log(
    system: System, attacked: Attacked
) -> None:
    probe = unit(np.random.default_rng(3).normal(size=system.templates.n))
    attacked.scored[0](probe)
    attacked.deciding[1](probe)
    log = (attacked.folder / "serve.log").read_bytes()
    assert b"/verify" in log
    search = LeakSearch(
        vectors={
            "probe": probe,
            "foot point": system.templates.feet[0],
            "basis": system.templates.bases[0],
            "victim": system.victims.enrolled[0],
        }
    )
    assert search.find(log) == []
    assert search.find(log + probe.tobytes()) != []


def test_a_probe_that_is_refused_is_said_without_its_numbers(attacked: Attacked) -> None:
    probe = np.full(64, 0.77123, dtype=np.float32)
    with pytest.raises(StartError, match=r"refused a climber's probe: [a-z_]+$") as caught:
        attacked.scored[0](probe)
    assert "0.77" not in str(caught.value)


def test_a_template_that_is_refused_is_said_and_nothing_stays(
    system: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    answers = {"error": {"code": "contract_mismatch", "message": "Another contract."}}

    @contextmanager
    def refusing(folder: Path) -> Iterator[httpx.Client]:
        present = {file.name for file in folder.iterdir()}
        assert present == {"master.key", "contract.json", "decoys.veil", "veilface.toml"}
        store = TemplateStore(
            f"sqlite:///{folder / 'veilface.db'}", MasterKeyring.load(folder / "master.key")
        )
        store.upgrade()
        store.tenants.create("default")
        store.close()
        transport = httpx.MockTransport(lambda _: httpx.Response(409, json=answers))
        yield httpx.Client(transport=transport, base_url="http://service")

    monkeypatch.setattr("api.cli.attacked_service.running_service", refusing)
    with (
        pytest.raises(StartError, match=r"refused a victim's template: contract_mismatch$"),
        attacked_service(system.contract, system.source, wires(system)),
    ):
        pytest.fail("a template was enrolled that was refused")
    assert list(tmp_path.iterdir()) == []


def be_terminated(folder: Path) -> None:
    """Make a temporary folder, and receive SIGTERM while it is there."""
    with leaves_on_sigterm(), tempfile.TemporaryDirectory(dir=folder):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)


def test_sigterm_leaves_nothing_behind(tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as left:
        be_terminated(tmp_path)
    assert left.value.code == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is handler
