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
    documented,
    draw_fairface,
    named_in,
)
from tests.api.cli.conftest import DIM, Ran, World, run
from tests.leaks import LeakSearch

pytestmark = pytest.mark.long

BOTH = {
    *("format", "version", "kind", "passed", "headlines", "comparison_headlines", "limits"),
    *("verdicts", "model", "settings", "rows", "outcomes", "failure_to_acquire"),
}


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


FEW = ("--attack", "100", "--attacked", "50")


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


def test_the_report_of_faces_is_the_one_that_is_documented(face_report: Any) -> None:
    members = documented()
    assert members.keys() >= BOTH
    missing = members.keys() - face_report.keys()
    assert missing <= {name for name in members if "`templates`" in members[name]}
    assert face_report.keys() <= members.keys()
    assert (face_report["format"], face_report["version"]) == ("veilface audit", 1)
    assert face_report["kind"] == "fairface"
    scheme = {"strategy", "decoys", "dim", "axes"}
    row_names = named_in("A row of attribute inference has")
    for row in face_report["rows"]:
        assert row.keys() >= row_names | scheme
        assert row.keys() <= row_names | scheme
    outcome_names = named_in("An outcome has")
    for outcome in face_report["outcomes"]:
        assert outcome_names <= outcome.keys() | outcome["measured"].keys()
        assert outcome.keys() <= outcome_names | scheme


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


def test_the_seed_gives_the_rows_and_a_kept_limit_is_status_0(
    faces: FaceAudit, face_report: Any
) -> None:
    more = ("--limit", "attribute-leakage=1", "--out", faces.root / "again")
    again = run(*faces.asked, *more)
    assert (again.status, again.stderr.count("error")) == (0, 0)
    assert again.stdout.splitlines()[0] == "PASSED"
    assert "no attack that was made exceeds its limit" in again.stdout
    report = json.loads((faces.root / "again" / "report.json").read_text())
    assert report["rows"] == face_report["rows"]
    assert report["outcomes"] == face_report["outcomes"]
    written = {file.name for file in (faces.root / "again").iterdir()}
    assert written == {"report.json", "report.md", *both(["figure"])}


def test_only_the_photos_that_the_limits_ask_for_are_embedded(faces: FaceAudit) -> None:
    ran = run(*faces.asked, *FEW, "--out", faces.root / "few", "--json")
    assert ran.status in (0, 1, 3), ran.stderr
    acquired, settings = ran.json["failure_to_acquire"], ran.json["settings"]
    assert (acquired["train"]["photos"], acquired["val"]["photos"]) == (200, 50)
    assert (settings["lifting"], settings["attacked"]) == (100, 50)
    assert settings["attack"] == 100 - acquired["train"]["failed"]


def test_no_descriptor_stands_in_the_report_of_faces(faces: FaceAudit) -> None:
    rows = np.concatenate(faces.descriptors)
    assert len(rows) == TRAIN - 1 + VALIDATION
    search = LeakSearch(vectors={f"face {i}": row for i, row in enumerate(rows)})
    written = b"\n".join(file.read_bytes() for file in sorted(faces.out.iterdir()))
    said = (faces.first.stdout + faces.first.stderr).encode()
    assert search.find(written + said) == []
    assert search.find(said + json.dumps(rows[5].tolist()).encode()) != []
    assert str(faces.root).encode() not in written
