"""`veilface audit fairface` end to end on drawn faces and the demo model."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.cli.bulk import Bulk
from models.demo import DEMO_NOTICE
from tests.api.cli.audit_bench import (
    TRAIN,
    VALIDATION,
    are_pictures,
    both,
    draw_fairface,
)
from tests.api.cli.conftest import DIM, Ran, World, run
from tests.leaks import LeakSearch

pytestmark = pytest.mark.long


@dataclass(frozen=True)
class FaceAudit:
    """A folder, its report, and every descriptor that was in memory."""

    root: Path
    asked: tuple[str | Path, ...]
    first: Ran
    descriptors: list[np.ndarray] = field(default_factory=list)

    @property
    def out(self) -> Path:
        return self.root / "out"


@pytest.fixture(scope="module")
def faces(world: World, tmp_path_factory: pytest.TempPathFactory) -> FaceAudit:
    root = tmp_path_factory.mktemp("audited-faces")
    draw_fairface(root / "fairface")
    (root / "fairface" / "train" / "7.png").write_bytes(b"not a picture")
    asked: tuple[str | Path, ...] = (
        *("audit", "fairface", root / "fairface", "--pack", world.pack, "--aligned"),
        *("--data-dir", world.data, "--cache", root / "faces.cache", "--lifting", "100"),
        *("--strategy", "adversarial", "--dim", "2", "--generated-dim", "4"),
    )
    found: list[np.ndarray] = []
    plain = Bulk.extract
    with pytest.MonkeyPatch.context() as patch:

        def recorded(*given: Any, **named: Any) -> Any:
            extraction = plain(*given, **named)
            found.append(extraction.embeddings)
            return extraction

        patch.setattr(Bulk, "extract", recorded)
        first = run(
            *asked, "--limit", "attribute-leakage=0", "--out", root / "out", "--json",
        )  # fmt: skip
    assert first.status in (0, 1), first.stderr
    assert "error: " not in first.stderr, first.stderr
    return FaceAudit(root, asked, first, found)


@pytest.fixture(scope="module")
def face_report(faces: FaceAudit) -> Any:
    return json.loads((faces.out / "report.json").read_text(encoding="utf-8"))


def test_an_audit_of_faces_writes_report_and_figures(faces: FaceAudit, face_report: Any) -> None:
    files = ["report.json", "report.md", *both(["figure"])]
    assert sorted(file.name for file in faces.out.iterdir()) == sorted(files)
    are_pictures(faces.out, ["figure"])
    said = faces.first.json
    assert said.pop("notice") == DEMO_NOTICE
    assert said.pop("out") == str(faces.out)
    assert said.pop("files") == files
    assert said == face_report
    text = (faces.out / "report.md").read_text(encoding="utf-8").replace("&#91;", "[")
    for sentence in face_report["headlines"]:
        assert sentence in text


def test_sizes_and_failures_are_told(faces: FaceAudit, face_report: Any) -> None:
    settings = face_report["settings"]
    assert (settings["lifting"], settings["attack"]) == (100, TRAIN - 1 - 100)
    assert settings["attacked"] == VALIDATION
    assert settings["root"] == "fairface"
    failed = face_report["failure_to_acquire"]
    assert failed["train"] == {"photos": TRAIN, "failed": 1, "reasons": {"unsupported_image": 1}}
    assert failed["val"]["failed"] == 0


def test_a_limit_that_is_exceeded_is_status_1(faces: FaceAudit, face_report: Any) -> None:
    assert faces.first.status == 1
    assert not face_report["passed"]
    assert face_report["limits"]["attribute-leakage"] == 0
    (verdict,) = face_report["verdicts"]
    assert (verdict["strategy"], verdict["decoys"], verdict["dim"]) == (
        *("adversarial", "generator", DIM),
    )
    (cell,) = verdict["cells"]
    assert (cell["status"], cell["limit"], cell["property"]) == (
        *("fail", "attribute-leakage", "confidentiality"),
    )
    judged = [each for each in face_report["outcomes"] if each["judged"]]
    far = max(
        abs(each["measured"]["value"] - each["chance"]) / each["details"]["raw_gain"]
        for each in judged
    )
    assert cell["compared"] == far > 0


def test_no_descriptor_stands_in_the_report_of_faces(faces: FaceAudit) -> None:
    rows = np.concatenate(faces.descriptors)
    assert len(rows) == TRAIN - 1 + VALIDATION
    search = LeakSearch(vectors={f"face {i}": row for i, row in enumerate(rows)})
    written = b"\n".join(file.read_bytes() for file in sorted(faces.out.iterdir()))
    said = (faces.first.stdout + faces.first.stderr).encode()
    assert search.find(written + said) == []
    assert search.find(said + json.dumps(rows[5].tolist()).encode()) != []
    assert str(faces.root).encode() not in written
