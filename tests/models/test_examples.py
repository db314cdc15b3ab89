"""The examples in docstrings of models run; those that write get a folder as ``tmp_path``."""

import doctest
import importlib
from pathlib import Path

import pytest

MODELS = Path(__file__).resolve().parents[2] / "models"
SHOWING = sorted(path.stem for path in MODELS.glob("*.py") if ">>> " in path.read_text())


@pytest.mark.parametrize("name", SHOWING)
def test_examples_run(name: str, tmp_path: Path) -> None:
    module = importlib.import_module(f"models.{name}")
    outcome = doctest.testmod(module, extraglobs={"tmp_path": tmp_path})
    assert outcome.attempted
    assert not outcome.failed
