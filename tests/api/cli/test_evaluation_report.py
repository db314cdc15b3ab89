"""The report of an audit, read before anything is evaluated."""

import json

import pytest

from api.cli.errors import CommandError
from api.cli.evaluation_report import read_audit
from tests.verify.evaluation.sample_results import sample_audit, sample_results
from verify.datasets import DatasetError


@pytest.mark.parametrize(
    "text",
    ["{", "", "[" * 100_000, '{"a":' * 100_000, '{"format": %s}' % ("9" * 5000)],
    ids=["open", "empty", "deep lists", "deep objects", "long number"],
)
def test_what_json_cannot_hold_is_refused(tmp_path, text):
    file = tmp_path / "report.json"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(CommandError, match=r"report\.json is not a JSON file"):
        read_audit(file)


def test_a_report_is_read_and_checked(tmp_path):
    audit = sample_audit(sample_results(dims=(2,)))
    file = tmp_path / "report.json"
    file.write_text(json.dumps(audit), encoding="utf-8")
    assert read_audit(file) == audit
    audit["rows"][0]["accuracy"] = float("nan")
    file.write_text(json.dumps(audit), encoding="utf-8")
    with pytest.raises(DatasetError, match="row 0: accuracy is nan"):
        read_audit(file)
