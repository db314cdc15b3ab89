"""What the scenarios would find: each fault is made by hand, and must be found."""

import copy
import dataclasses
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from api.http.app import create_app
from api.service.opening import open_keyring, open_store
from templates.store import TemplateStore
from tests.api.client import Client
from tests.api.deployment import Deployment, deploy
from tests.api.server_process import Server
from tests.databases import execute
from tests.reliability.evidence import examine, unexpected
from tests.reliability.kill import QUIET
from tests.reliability.load import look_at_all, make_subjects, people_of
from tests.reliability.operations import LOST, NOT_SENT, Clients, Operation, People

SUBJECTS = make_subjects(2)


class InProcess(Clients):
    """Clients of an application in this process."""

    def __init__(self, client: Client, deployment: Deployment, people: People) -> None:
        super().__init__(cast(Server, SimpleNamespace(deployment=deployment)), people)
        self._application = client

    def _client(self) -> Any:
        return self._application


@dataclass
class StoppedDeployment:
    """A deployment that does not run, and what was asked of it."""

    service: Any
    history: list[Operation]
    replays: list[tuple[Operation, Operation]]

    @contextmanager
    def store(self) -> Iterator[TemplateStore]:
        """The database, behind the application's back."""
        settings = self.service.deployment.settings
        store = open_store(settings, open_keyring(settings))
        try:
            yield store
        finally:
            store.close()

    def execute(self, *statements: str) -> None:
        """Change the database."""
        with self.store() as store:
            execute(store.database, *statements)

    def the(self, kind: str, *, last: bool = False) -> Operation:
        operations = [each for each in self.history if each.kind == kind]
        return operations[-1 if last else 0]

    def violations(self) -> list[str]:
        return examine(self, list(SUBJECTS)).violations


@pytest.fixture(scope="module")
def exercised(tmp_path_factory: pytest.TempPathFactory) -> InProcess:
    """Two subjects: one erased and enrolled as somebody else in the end, one erased."""
    deployment = deploy(tmp_path_factory.mktemp("exercised"), **QUIET)
    people = People(deployment, people_of(SUBJECTS))
    with Client(create_app(deployment.settings)) as client:
        made = InProcess(client, deployment, people)
        made.enroll("subject-0", 1)
        made.verify("subject-0", 1)
        made.erase("subject-0")
        made.erase("subject-0")
        made.enroll("subject-0", 2)
        made.erase("subject-1")
        made.enroll("subject-1", 4)
        made.enroll("subject-1", 5)
        made.erase("subject-1")
        look_at_all(made, SUBJECTS)
        made.verify("subject-0", 2)
        made.replay(made.history[1])
    return made


@pytest.fixture
def stopped(exercised: InProcess, tmp_path: Path) -> StoppedDeployment:
    """A copy of it, to be spoilt."""
    deployment = exercised.service.deployment
    shutil.copytree(deployment.settings.data_dir, tmp_path / "data")
    keys = deployment.settings.resolved_master_key_file
    settings = deployment.settings.model_copy(
        update={"data_dir": tmp_path / "data", "master_key_file": keys}
    )
    copied = dataclasses.replace(deployment, settings=settings)
    history, replays = copy.deepcopy((exercised.history, exercised.replays))
    return StoppedDeployment(SimpleNamespace(deployment=copied), history, replays)


def test_nothing_is_found_where_nothing_is_wrong(stopped: StoppedDeployment) -> None:
    examined = examine(stopped, list(SUBJECTS))
    assert examined.violations == []
    assert examined.effective == 0
    assert len(examined.lines) >= len(stopped.history)
    assert list(unexpected(stopped.history, lambda _: False)) == []


def test_a_write_that_nobody_was_told_of_may_have_happened_or_not(
    stopped: StoppedDeployment,
) -> None:
    happened = stopped.the("enroll")
    happened.outcome, happened.answer = LOST, {}
    happened.over += 1
    never = Operation("enroll", "subject-1", 6, "000099-never", happened.started)
    stopped.history.append(never)
    examined = examine(stopped, list(SUBJECTS))
    assert examined.violations == []
    assert examined.effective == 1


def keeps_what_was_erased(stopped: StoppedDeployment) -> None:
    with stopped.store() as store:
        other = store.subjects.get("default", "subject-0")
        assert other is not None
        columns = ("contract_id", "source", "photos", "template_id")
        known = {name: getattr(other.record, name) for name in columns}
        store.subjects.put("default", "subject-1", other.wire, **known)


def has_another_template(stopped: StoppedDeployment) -> None:
    enrolled = [each for each in stopped.history if each.kind == "enroll"][1]
    enrolled.answer = {**enrolled.answer, "template_id": "other"}
    described = stopped.the("describe")
    described.answer = {**described.answer, "template_id": "other"}


def answered_without_a_line(stopped: StoppedDeployment) -> None:
    said = stopped.the("enroll", last=True)
    stopped.history.append(dataclasses.replace(said, request_id="000099-unheard"))


def wrote_what_was_refused(stopped: StoppedDeployment) -> None:
    said = stopped.the("enroll")
    said.outcome, said.code, said.answer = 429, "rate_limited", {}


def wrote_what_was_not_sent(stopped: StoppedDeployment) -> None:
    stopped.the("erase").outcome = NOT_SENT


def wrote_what_nobody_sent(stopped: StoppedDeployment) -> None:
    stopped.history.remove(stopped.the("erase"))


def decided_otherwise(stopped: StoppedDeployment) -> None:
    said = stopped.the("verify")
    said.answer = {**said.answer, "decision": "reject"}


def accepted_who_was_replaced(stopped: StoppedDeployment) -> None:
    """Answer, line and counts agree that person 1 is accepted again at the end."""
    late = stopped.the("verify", last=True)
    assert late.accepted
    late.person = 1


def repeated_another_receipt(stopped: StoppedDeployment) -> None:
    first, second, *_, other = [each for each in stopped.history if each.kind == "erase"]
    assert first.receipt_id == second.receipt_id
    second.answer = other.answer


def wrote_before_it_was_asked(stopped: StoppedDeployment) -> None:
    said = stopped.the("enroll")
    later = max(each.answered for each in stopped.history)
    said.started, said.answered, said.over = later + 1, later + 2, later + 2


def decided_twice(stopped: StoppedDeployment) -> None:
    (_, again), *_ = stopped.replays
    again.outcome, again.code = 200, None


@pytest.mark.parametrize(
    ("statement", "sentence"),
    [
        ("DELETE FROM subjects", "not enrolled after"),
        (
            "UPDATE subjects SET subject_id = 'subject-1'",
            "subject-1: its template cannot be opened",
        ),
        ("UPDATE subjects SET ciphertext = zeroblob(50)", "its template cannot be opened"),
        ("DELETE FROM receipts", "receipts: none for erase"),
        ("UPDATE audit_log SET token = NULL WHERE outcome = 'reject'", "tokens: "),
        ("UPDATE failed_attempts SET consecutive = 0", "was lowered"),
        ("UPDATE audit_log SET outcome = 'accept' WHERE outcome = 'reject'", ": altered"),
    ],
)
def test_a_change_of_the_database_is_found(
    stopped: StoppedDeployment, statement: str, sentence: str
) -> None:
    stopped.execute(statement)
    violations = stopped.violations()
    assert any(sentence in each for each in violations), violations


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (keeps_what_was_erased, "subject-1: enrolled after erase"),
        (has_another_template, "another template than"),
        (answered_without_a_line, "audit log: 0 lines"),
        (wrote_what_was_refused, "a line for enroll"),
        (wrote_what_was_not_sent, "a line for erase"),
        (wrote_what_nobody_sent, "which nobody sent"),
        (decided_otherwise, "another one, for verify"),
        (accepted_who_was_replaced, "no serial order"),
        (repeated_another_receipt, "no serial order"),
        (wrote_before_it_was_asked, "stands too late"),
        (decided_twice, "replay: 200"),
    ],
)
def test_a_fault_is_found(
    stopped: StoppedDeployment, fault: Callable[[StoppedDeployment], object], sentence: str
) -> None:
    fault(stopped)
    violations = stopped.violations()
    assert any(sentence in each for each in violations), violations


def test_an_answer_that_should_not_be_is_found(stopped: StoppedDeployment) -> None:
    stopped.the("verify").outcome = 500
    (violations,) = unexpected(stopped.history, lambda each: each.outcome == 503)
    assert "500" in violations
