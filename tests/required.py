"""What a test needs of the machine it runs on."""

import os
from typing import NoReturn

import pytest


def absent(reason: str, variable: str) -> NoReturn:
    """Skip the test, or fail it where the environment variable asks for what is absent by ``1``."""
    if os.environ.get(variable) == "1":
        pytest.fail(f"{reason}, and {variable}=1 asks for it")
    pytest.skip(reason)
