"""What a scenario leaves behind, held against what the clients were answered.

Three records are compared with each other: the answers, the audit log and the tables. No
acknowledged write may be missing in the other two, and nothing may be there that nobody asked for.
The order of the audit log must be a serial order: one that explains every answer, as if all calls
had come one after the other.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import sqlalchemy as sa

from api.service.opening import open_keyring, open_store
from api.settings import DEFAULT_TENANT
from templates.contract import wire
from templates.errors import VeilfaceError
from templates.store import TemplateStore, verify_audit_log
from templates.store.audit_log import Line
from templates.store.receipts import Receipt, verify_receipt
from templates.store.schema import ReceiptRow
from tests.databases import execute
from tests.reliability.operations import Operation

DECIDED = ("accept", "reject")
ENROLLED = {True: "replaced", False: "created"}


@dataclass
class Report:
    """Figures of a run by name; ``violations`` is empty where all holds."""

    figures: dict[str, Any] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)

    def add(self, name: str, number: int = 1) -> None:
        """Count something."""
        self.figures[name] = self.figures.get(name, 0) + number

    def examine(
        self, asked: "Asked", subjects: Sequence[str], allowed: Callable[[Operation], bool]
    ) -> None:
        """Compare what is there with what clients were answered; the service must have ended.

        Parameters
        ----------
        allowed
            Which operations may have ended without success.
        """
        examined = examine(asked, subjects)
        self.violations += [*unexpected(asked.history, allowed), *examined.violations]
        self.figures |= {
            "of_these_effective": examined.effective,
            "audit_lines": len(examined.lines),
        }
        counted = {"enroll": "enrollments", "erase": "erasures", "verify": "decisions"}
        for each in asked.history:
            self.add("answers_503", each.outcome == 503)
            if each.kind in counted:
                self.add(f"acknowledged_{counted[each.kind]}", each.answered_well)
                unsure = "writes" if each.writes else "decisions"
                self.add(f"unacknowledged_{unsure}", each.may_have_happened)
        slowest = max(each.seconds for each in asked.history if each.answered < math.inf)
        self.figures["slowest_s"] = round(slowest, 2)


class Asked(Protocol):
    """What clients asked of one deployment."""

    @property
    def service(self) -> Any:
        """Has a ``deployment``."""

    @property
    def history(self) -> list[Operation]: ...

    @property
    def replays(self) -> list[tuple[Operation, Operation]]: ...


def examine(asked: Asked, subjects: Sequence[str]) -> "Examination":
    """Compare history, audit log and tables; the service must not run any more."""
    settings = asked.service.deployment.settings
    store = open_store(settings, open_keyring(settings))
    try:
        examination = Examination(store, asked)
        examination.run(subjects)
        return examination
    finally:
        store.close()


class Examination:
    """What was found: `violations`, one sentence each, and the `lines` of the audit log.

    `effective` counts the writes without a good answer that took effect nevertheless, by the log.
    """

    def __init__(self, store: TemplateStore, asked: Asked) -> None:
        self.tenant = DEFAULT_TENANT
        self.store = store
        self.history = [each for each in asked.history if each.kind != "contract"]
        self.replays = asked.replays
        self.violations: list[str] = []
        self.lines = list(store.audit_log.lines())
        self.sent = {each.request_id: each for each in self.history}
        self.by_request: dict[str, list[Line]] = defaultdict(list)
        for line in self.lines:
            if line.request_id is not None:
                self.by_request[line.request_id].append(line)
        unsure = [each for each in self.history if each.writes and each.may_have_happened]
        self.effective = sum(1 for each in unsure if each.request_id in self.by_request)

    def run(self, subjects: Sequence[str]) -> None:
        """Look for violations."""
        self._chain()
        self._answers_have_their_lines()
        self._lines_have_their_requests()
        self._lines_follow_the_clock()
        self._tables_are_whole()
        self._receipts()
        self._tokens()
        self._repeated_probes()
        for subject in subjects:
            self._subject(subject)
            self._serial(subject)

    def _wrong(self, what: str) -> None:
        self.violations.append(what)

    def _chain(self) -> None:
        verification = verify_audit_log(self.store)
        if (problem := verification.problem) is not None:
            self._wrong(f"audit log: line {problem.sequence}: {problem.what}")
        for record in verification.records:
            self._wrong(f"audit log: {record.about}: {record.what}")

    def _answers_have_their_lines(self) -> None:
        for each in self.history:
            lines = self.by_request.get(each.request_id, [])
            if each.kind == "describe":
                continue
            if each.answered_well:
                if [(line.action, line.outcome) for line in lines] != [_line_of(each, lines)]:
                    self._wrong(f"audit log: {len(lines)} lines, or another one, for {each}")
            elif len(lines) > each.may_have_happened:
                self._wrong(f"audit log: a line for {each}")
            for line in lines:
                if line.pseudonym != self.store.signer.pseudonym(self.tenant, each.subject):
                    self._wrong(f"audit log: another subject's line for {each}")

    def _lines_have_their_requests(self) -> None:
        known = {each.request_id for each in self.history}
        known |= {again.request_id for _, again in self.replays}
        for request_id in self.by_request.keys() - known:
            self._wrong(f"audit log: a line of request {request_id}, which nobody sent")

    def _lines_follow_the_clock(self) -> None:
        """A line is written between request and answer: the log's order is a serial order."""
        latest = -1.0
        for each in self._operations(self.lines):
            if each.over < latest:
                self._wrong(f"audit log: the line of {each} stands too late")
            latest = max(latest, each.started)

    def _tables_are_whole(self) -> None:
        if self.store.database.is_sqlite:
            ((integrity,),) = execute(self.store.database, "PRAGMA integrity_check")
            if integrity != "ok":
                self._wrong(f"SQLite: integrity_check says {integrity}")

    def _receipts(self) -> None:
        """Every acknowledged receipt is there, and each erasure of the audit log left one."""
        key = self.store.signer.public_key()
        query = sa.select(ReceiptRow.pseudonym, ReceiptRow.body, ReceiptRow.signature)
        rows = execute(self.store.database, query)
        kept = {(body, bytes(signature)) for _, body, signature in rows}
        for body, signature in kept:
            with self._noting("a receipt cannot be verified"):
                verify_receipt(Receipt(body, signature), key)
        for each in self.history:
            if each.kind == "erase" and each.answered_well:
                receipt = Receipt.from_json(each.receipt)
                if (receipt.body, receipt.signature) not in kept:
                    self._wrong(f"receipts: none for {each}")
        written = Counter(
            line.pseudonym
            for line in self.lines
            if line.action == "erase" and line.outcome in ("erased", "nothing_held")
        )
        if written != Counter(row.pseudonym for row in rows):
            self._wrong("receipts: not one for each erasure of the audit log")

    def _tokens(self) -> None:
        """Every decision has used up a token of its own, and nothing else has."""
        decided = [
            line for line in self.lines if line.action == "verify" and line.outcome in DECIDED
        ]
        tokens = [line.token for line in self.lines if line.token is not None]
        if tokens != [line.token for line in decided] or len(set(tokens)) != len(tokens):
            self._wrong(f"tokens: {len(decided)} decisions used up {len(set(tokens))}")

    def _repeated_probes(self) -> None:
        """A token that was decided on is refused when it is sent again, and only such a one."""
        for earlier, again in self.replays:
            decided = bool(self.by_request.get(earlier.request_id))
            if earlier.answered_well and not decided:
                continue  # found already: an answer without its line
            expected = (401, "replayed") if decided else (200, None)
            if (again.outcome, again.code) != expected:
                self._wrong(f"replay: {again.outcome} {again.code} for {earlier}")

    def _subject(self, subject: str) -> None:
        """What is stored is what the last write of the audit log left, and it can be opened."""
        writes = self._writes_of(subject)
        last = writes[-1] if writes else None
        expected = last is not None and last.kind == "enroll"
        with self._noting(f"{subject}: its template cannot be opened"):
            stored = self.store.subjects.get(self.tenant, subject)
            if (stored is not None) != expected:
                state = "enrolled" if stored else "not enrolled"
                self._wrong(f"{subject}: {state} after {last}")
            elif stored is not None and last is not None:
                if last.answered_well and stored.record.template_id != last.template_id:
                    self._wrong(f"{subject}: another template than that of {last}")
                wire.decode(stored.wire)
        enrolled, erased = False, False
        for line in self._lines_of(subject):
            if line.action == "enroll":
                if line.outcome != ENROLLED[enrolled]:
                    self._wrong(f"audit log: line {line.sequence} says {line.outcome}")
                enrolled = True
            elif line.action == "erase":
                repeated = "receipt_repeated" if erased else "nothing_held"
                if line.outcome != ("erased" if enrolled else repeated):
                    self._wrong(f"audit log: line {line.sequence} says {line.outcome}")
                enrolled, erased = False, True

    def _serial(self, subject: str) -> None:
        """In the log's order, each answer on a subject is what the calls before it had left.

        A verification of person Y is accepted if and only if Y is enrolled (the lockout is off). A
        repeated erasure gives the receipt of the last one.
        """
        enrolled: Operation | None = None
        receipt: str | None = None
        known = True  # the receipt: not where its erasure had no answer
        for each in self._operations(self._lines_of(subject)):
            well = each.answered_well
            if each.kind == "describe":
                continue  # a line says that nobody is enrolled
            if each.kind == "verify":
                person = None if enrolled is None else enrolled.person
                if well and each.accepted != (person == each.person):
                    self._wrong(f"{subject}: no serial order: {each}")
                continue
            before = receipt
            if each.kind == "erase" and enrolled is None and (before is not None or not known):
                if well and known and each.receipt_id != before:
                    self._wrong(f"{subject}: no serial order: {each}")
                continue
            if each.kind == "erase":
                if well and (each.receipt_id == before or each.held != (enrolled is not None)):
                    self._wrong(f"{subject}: no serial order: {each}")
                enrolled, receipt, known = None, each.receipt_id if well else None, well
            else:
                enrolled = each

    def _operations(self, lines: Sequence[Line]) -> list[Operation]:
        """The clients' operations of some lines, in the order of these."""
        return [self.sent[line.request_id or ""] for line in lines if line.request_id in self.sent]

    def _lines_of(self, subject: str) -> list[Line]:
        pseudonym = self.store.signer.pseudonym(self.tenant, subject)
        return [line for line in self.lines if line.pseudonym == pseudonym]

    def _writes_of(self, subject: str) -> list[Operation]:
        return [each for each in self._operations(self._lines_of(subject)) if each.writes]

    @contextmanager
    def _noting(self, what: str) -> Iterator[None]:
        """Turn an error of ours into a violation."""
        try:
            yield
        except VeilfaceError as error:
            self._wrong(f"{what}: {error}")


def _line_of(each: Operation, lines: Sequence[Line]) -> tuple[str, str]:
    """Action and outcome that the line of an acknowledged operation must have."""
    match each.kind:
        case "enroll":
            return "enroll", ENROLLED[bool(each.replaced)]
        case "verify":
            return "verify", "accept" if each.accepted else "reject"
        case "erase":
            # Which erasure a receipt is of shows in the order of the lines; see _subject.
            allowed = ("erased" if each.held else "nothing_held", "receipt_repeated")
            said = lines[0].outcome if lines else ""
            return "erase", said if said in allowed else allowed[0]
    raise AssertionError(each.kind)


def unexpected(history: Sequence[Operation], allowed: Callable[[Operation], bool]) -> Iterator[str]:
    """One sentence for every operation that ended as none should."""
    for each in history:
        if not each.answered_well and not allowed(each):
            yield f"unexpected: {each}"
