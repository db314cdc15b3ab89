"""What an audit shows first, in the terminal and in the files."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from api.cli.audit_report import conclude
from attacks.outcomes import AttackOutcome, Knowledge, Leaked, Property, Scheme
from attacks.report import document
from models.pack import ModelPack
from verify.metrics import rate


def test_what_is_not_judged_stands_before_all_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def row(**more: Any) -> AttackOutcome:
        return AttackOutcome(
            breaks=Property.IRREVERSIBILITY,
            leaked=Leaked.HOLDER_KEYS,
            knowledge=Knowledge.ALGORITHM,
            assumption="Has what it has.",
            scheme=Scheme("adversarial", "generator", 16),
            chance=0.001,
            **more,
        )

    report = document(
        "templates",
        outcomes=[
            row(attack="guess", measured=rate(0, 1000)),
            row(attack="drawing", measured=rate(60, 100), unjudged="people are drawn"),
        ],
        limits={},
        model={},
        settings={},
    )
    pack = SimpleNamespace(info=SimpleNamespace(embedder_sha256="ab" * 32, n=64))
    conclude(report, tmp_path, cast(ModelPack, pack), as_json=False)
    named = "not judged (people are drawn): drawing: 0.6 "
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.startswith("PASSED adversarial, m = 16, generated decoys: " + named)
    assert shown.index(named) < shown.index("Verdict on")
    assert named in json.loads((tmp_path / "report.json").read_text())["headlines"][0]
    page = (tmp_path / "report.html").read_text()
    assert page.index(named) < page.index("<h2>")
