"""The benchmark of rotations runs against the verifier as it is."""

import json

import pytest

from benchmarks import rotation_cost


@pytest.mark.long
def test_it_decides_with_both_rotations_with_one_and_with_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("sys.argv", ["rotation_cost", "--n", "64", "--dim", "8", "--rounds", "2"])
    rotation_cost.main()
    printed = json.loads(capsys.readouterr().out)
    assert printed["rounds"] == 2
    for label in ("median", "quickest tenth"):
        assert set(printed[label]["ms"]) == {"both rotations", "the tenant's", "no rotation"}
        assert min(printed[label]["ms"].values()) > 0
        assert set(printed[label]["reading_ms"]) == {"by the rules", "as sealed"}
