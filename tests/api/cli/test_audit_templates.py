"""`veilface audit templates` end to end on drawn people and the demo model."""

import json
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import attacks.audit
from api.cli import audit_templates
from api.cli.bulk import Bulk
from api.settings import Settings
from attacks.audit import AuditPlan, AuditResult
from attacks.bed import Testbed
from attacks.outcomes import KnowledgeLevel, Property
from attacks.population import Population
from attacks.runner import run_attack
from attacks.stored.foot_point import foot_point
from attacks.stored.known_pool import known_pool
from attacks.verdict import LIMITS, Status
from models.demo import DEMO_NOTICE
from models.extraction import Extraction
from templates.decoys import DecoyGenerator
from tests.api.cli.audit_bench import are_pictures, both, documented, draw_people, named_in
from tests.api.cli.conftest import DIM, Ran, World, run
from tests.attacks.beds import bed_of
from tests.leaks import LeakSearch
from verify import calibrate

WITHOUT_LIMITS = [f"--limit={limit.name}=1" for limit in LIMITS]


@dataclass(frozen=True)
class TemplateAudit:
    """A folder of people, what audits of it were asked, and what they held in memory."""

    root: Path
    asked: tuple[str | Path, ...]
    first: Ran
    populations: list[Population]
    beds: list[Testbed]
    left: list[Path]

    @property
    def out(self) -> Path:
        return self.root / "out"


def on_small_material(patch: pytest.MonkeyPatch) -> None:
    """Fewer comparisons of each kind, for the tests' time; the attacks are the audit's own."""

    def fewer(*given: Any, **named: Any) -> Any:
        few = replace(named["options"], lifted_probes=100, lifted_impostor_pairs=6_000, steps=10)
        return calibrate(*given, **{**named, "options": few})

    patch.setattr(attacks.audit, "calibrate", fewer)


@pytest.fixture(scope="module")
def people(world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TemplateAudit]:
    root = tmp_path_factory.mktemp("audited-people")
    # 20 victims, 100 owners of decoys, 200 faces of the attacker and 400 people to calibrate on.
    draw_people(root / "people", world.labelled, several=75, single=600)
    (root / "temporary").mkdir()
    asked: tuple[str | Path, ...] = (
        *("audit", "templates", root / "people", "--pack", world.pack, "--data-dir", world.data),
        *("--aligned", "--cache", root / "people.cache", "--victims", "20", "--owners", "100"),
    )
    populations: list[Population] = []
    beds: list[Testbed] = []
    with pytest.MonkeyPatch.context() as patch:
        on_small_material(patch)
        patch.setattr(tempfile, "tempdir", str(root / "temporary"))
        draw_population, audit_bed = attacks.audit.draw_population, attacks.audit.audit_bed

        def recorded_population(*given: Any, **named: Any) -> Population:
            populations.append(draw_population(*given, **named))
            return populations[-1]

        def recorded_bed(*given: Any, **named: Any) -> Testbed:
            beds.append(audit_bed(*given, **named))
            return beds[-1]

        patch.setattr(attacks.audit, "draw_population", recorded_population)
        patch.setattr(attacks.audit, "audit_bed", recorded_bed)
        first = run(
            *asked, "--no-comparison", "--limit", "success-with-key=0",
            "--out", root / "out", "--json",
        )  # fmt: skip
        assert "error: " not in first.stderr, first.stderr
        left = list((root / "temporary").iterdir())
        yield TemplateAudit(root, asked, first, populations[:], beds[:], left)


@pytest.fixture(scope="module")
def people_report(people: TemplateAudit) -> Any:
    return json.loads((people.out / "report.json").read_text(encoding="utf-8"))


@pytest.mark.long
def test_an_audit_of_templates_writes_report_and_figures(
    people: TemplateAudit, people_report: Any
) -> None:
    files = ["report.json", "report.md", *both(["oracle"])]
    assert sorted(file.name for file in people.out.iterdir()) == sorted(files)
    are_pictures(people.out, ["oracle"])
    said = people.first.json
    assert said.pop("notice") == DEMO_NOTICE
    assert said.pop("out") == str(people.out)
    assert said.pop("files") == files
    assert said == people_report
    assert people.left == []


def is_as_documented(report: Any) -> None:
    members = documented()
    missing = members.keys() - report.keys()
    assert missing <= {name for name in members if re.match("`fairface`", members[name])}
    assert report.keys() <= members.keys()
    assert (report["kind"], report["rows"]) == ("templates", [])
    assert report["limits"].keys() == {limit.name for limit in LIMITS}
    scheme = {"strategy", "decoys", "dim", "axes"}
    outcome_names = named_in("An outcome has") - {"errors"}
    for outcome in report["outcomes"]:
        assert outcome_names <= outcome.keys() | outcome["measured"].keys()
        assert outcome.keys() <= outcome_names | scheme
        assert outcome["measured"]["ci_low"] <= outcome["measured"]["value"]
        assert outcome["measured"]["value"] <= outcome["measured"]["ci_high"]
    values = {*map(str, Property), *map(str, KnowledgeLevel), *map(str, Status)}
    cell_names = named_in("A cell of a verdict is") - values
    for verdict in report["verdicts"]:
        assert verdict.keys() == scheme | {"passed", "comparison", "cells", "not_judged"}
        for cell in verdict["cells"]:
            assert cell.keys() >= cell_names
            assert cell["status"] in set(map(str, Status))


@pytest.mark.long
def test_the_report_of_templates_is_the_one_that_is_documented(people_report: Any) -> None:
    is_as_documented(people_report)


def test_what_two_attacks_found_becomes_report_verdict_and_status(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command around a small system with decoys of real people, which one attack opens."""
    bed = bed_of("pool")

    def two_attacks(plan: AuditPlan, faces: Extraction, *_: Any, **__: Any) -> AuditResult:
        assert (plan.victims, len(faces.embeddings)) == (20, 20)
        outcomes = [*run_attack(foot_point, bed), *run_attack(known_pool, bed)]
        return AuditResult(outcomes, [], [], {"victims": plan.victims})

    monkeypatch.setattr(audit_templates, "run_audit", two_attacks)
    asked = (
        *("audit", "templates", world.people, "--pack", world.pack, "--data-dir", world.data),
        *("--aligned", "--victims", "20"),
    )
    failed = run(*asked, "--out", tmp_path / "failed", "--json")
    assert failed.status == 1, failed.stderr
    report = json.loads((tmp_path / "failed" / "report.json").read_text(encoding="utf-8"))
    is_as_documented(report)
    assert [row["attack"] for row in report["outcomes"]].count("foot-point") > 0
    (verdict,) = report["verdicts"]
    cells = {cell["limit"]: cell["status"] for cell in verdict["cells"]}
    assert cells["recovery-success"] == "fail"
    kept = run(*asked, *WITHOUT_LIMITS, "--out", tmp_path / "kept")
    assert kept.status == 0, kept.stderr
    assert kept.stdout.startswith("PASSED\n")


@pytest.mark.parametrize(
    ("given", "dims", "strategy", "of_contract"),
    [
        ([], (64,), "adversarial", True),
        (["--dim", "3,5", "--axes", "50"], (3, 5), "adversarial", False),
        (["--strategy", "random"], (64,), "random", False),
    ],
)
def test_the_contract_is_audited_unless_a_scheme_is_described(
    world: World,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    given: list[str],
    dims: tuple[int, ...],
    strategy: str,
    of_contract: bool,
) -> None:
    plans: list[AuditPlan] = []

    def recorded(plan: AuditPlan, *_: Any, **__: Any) -> AuditResult:
        plans.append(plan)
        return AuditResult([], [], [], {})

    monkeypatch.setattr(audit_templates, "run_audit", recorded)
    ran = run(
        *("audit", "templates", world.people, "--pack", world.pack, "--data-dir", world.data),
        *("--aligned", "--out", tmp_path / "out", *given),
    )
    (plan,) = plans
    assert (plan.dims, str(plan.strategy)) == (dims, strategy)
    # Nothing was judged, so nothing fails, and nothing is shown.
    assert (ran.status, ran.stdout.partition(":")[0]) == (3, "NOT SHOWN")
    assert (plan.contract is not None) == of_contract == ("auditing the contract" in ran.stderr)


def test_a_contract_of_other_decoys_is_not_served(world: World) -> None:
    bulk = Bulk(Settings(data_dir=world.data, pack=world.pack))
    own = bulk.decoys(None)
    served = bulk.served_contract(own)
    assert served is not None
    assert served.binding.m == DIM
    rows = np.random.default_rng(0).normal(size=(150, own.n))
    other = DecoyGenerator.fit(rows / np.linalg.norm(rows, axis=1, keepdims=True))
    assert bulk.served_contract(other) is None


@pytest.mark.long
def test_nothing_of_people_and_templates_stands_in_the_report(people: TemplateAudit) -> None:
    (population,) = people.populations
    rows = np.concatenate(
        [
            *(
                population.victims.enrolled,
                population.victims.fresh,
                population.owners.enrolled,
                population.owners.fresh,
            ),
            population.others,
        ]
    )
    vectors = {f"face {i}": row for i, row in enumerate(rows)}
    for bed in people.beds:
        for number, template in enumerate(bed.templates.bases):
            vectors[f"{bed.scheme}, basis {number}"] = template
            vectors[f"{bed.scheme}, foot {number}"] = bed.templates.feet[number]
    search = LeakSearch(vectors=vectors)
    written = b"\n".join(file.read_bytes() for file in sorted(people.out.iterdir()))
    said = (people.first.stdout + people.first.stderr).encode()
    assert search.find(written + said) == []
    assert search.find(said + people.beds[0].templates.feet[3].tobytes()) != []
    assert b"drawn-0" not in written + said
    assert b"person-6" not in written + said
