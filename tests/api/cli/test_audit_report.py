"""What an audit shows first, in the terminal and in the files."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import typer

from api.cli.audit_report import reported
from api.cli.results import present
from attacks.outcomes import AttackOutcome, KnowledgeLevel, Leaked, Property, Scheme
from attacks.report import document
from models.pack import ModelPack
from verify.metrics import rate


def row(**more: Any) -> AttackOutcome:
    return AttackOutcome(
        breaks=Property.IRREVERSIBILITY,
        leaked=Leaked.HOLDER_KEYS,
        knowledge=KnowledgeLevel.ALGORITHM,
        assumption="Has what it has.",
        scheme=Scheme("adversarial", "generator", 16),
        chance=0.001,
        **more,
    )


def concluded(*rows: AttackOutcome, out: Path) -> None:
    report = document("templates", outcomes=rows, limits={}, model={}, settings={})
    pack = SimpleNamespace(info=SimpleNamespace(embedder_sha256="ab" * 32, n=64))
    present(reported(report, out, cast(ModelPack, pack)), json=False)


DRAWING = row(attack="drawing", measured=rate(60, 100), unjudged="people are drawn")


def test_what_is_not_judged_stands_before_all_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    concluded(row(attack="guess", measured=rate(0, 1000)), DRAWING, out=tmp_path)
    named = "not judged (people are drawn): drawing: 0.6 "
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.startswith("PASSED adversarial, m = 16, generated decoys: " + named)
    assert shown.index(named) < shown.index("Verdict on")
    assert named in json.loads((tmp_path / "report.json").read_text())["headlines"][0]
    page = (tmp_path / "report.md").read_text()
    assert page.index(named) < page.index("\n## ")


def test_an_audit_that_judged_nothing_says_so_and_does_not_end_with_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended:
        concluded(DRAWING, out=tmp_path)
    assert ended.value.exit_code == 3
    said = "NOT SHOWN: no limit is exceeded, and not every one is shown to hold."
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.startswith(said + " adversarial, m = 16, generated decoys: no attack was judged")
    assert "FAILED" not in shown
    assert "Verdict on" not in shown
    assert json.loads((tmp_path / "report.json").read_text())["passed"] is None
    page = (tmp_path / "report.md").read_text()
    assert page.index(said) < page.index("\n## ")
    assert "FAILED" not in page
