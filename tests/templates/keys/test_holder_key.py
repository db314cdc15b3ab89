import base64
import os

import pytest

from templates.errors import SealError
from templates.keys.holder_key import decode_holder_key, wipe


def test_a_key_has_one_text_and_is_read_with_padding_or_without() -> None:
    for _ in range(50):
        key = os.urandom(32)
        text = base64.urlsafe_b64encode(key).decode()
        assert decode_holder_key(text) == decode_holder_key(text.rstrip("=")) == key
    with pytest.raises(SealError):
        decode_holder_key(text[:-2] + "B")  # other bits where a key has none


def test_a_wiped_key_is_overwritten() -> None:
    key = bytearray(os.urandom(32))
    wipe(key)
    assert (len(key), any(key)) == (32, False)
