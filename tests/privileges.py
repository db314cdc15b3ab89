"""Tests that root alone can run, and not on every machine."""

import os
from typing import NoReturn

import pytest


def not_permitted(reason: str) -> NoReturn:
    """Skip the test, or fail it where ``VEILFACE_REQUIRE_ROOT=1`` says that it can be run."""
    if os.environ.get("VEILFACE_REQUIRE_ROOT") == "1":
        pytest.fail(f"{reason}, and VEILFACE_REQUIRE_ROOT=1 asks for it")
    pytest.skip(reason)
