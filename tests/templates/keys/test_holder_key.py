import base64
import os
from pathlib import Path

import pytest

from templates.errors import SealError
from templates.keys.holder_key import (
    decode_holder_key,
    encode_holder_key,
    new_holder_key,
    read_holder_key,
    wipe,
    write_holder_key,
)


def test_a_key_has_one_text_and_is_read_with_padding_or_without() -> None:
    for _ in range(50):
        key = os.urandom(32)
        text = base64.urlsafe_b64encode(key).decode()
        assert encode_holder_key(key) == text.rstrip("=")
        assert decode_holder_key(text) == decode_holder_key(text.rstrip("=")) == key
    with pytest.raises(SealError):
        decode_holder_key(text[:-2] + "B")  # other bits where a key has none


def test_a_new_key_goes_into_a_private_file_and_comes_back(tmp_path: Path) -> None:
    path, key = tmp_path / "made" / "anna.key", new_holder_key()
    write_holder_key(path, key)
    assert path.stat().st_mode & 0o777 == 0o600
    assert read_holder_key(path) == key
    assert len(path.read_text()) == 44
    with pytest.raises(SealError, match="exists already"):
        write_holder_key(path, new_holder_key())
    assert read_holder_key(path) == key
    kept = bytes(key)
    wipe(key)
    assert (len(key), any(key)) == (32, False)
    assert read_holder_key(path) == kept


def test_files_that_hold_no_key_are_named_and_not_shown(tmp_path: Path) -> None:
    path, text = tmp_path / "anna.key", encode_holder_key(new_holder_key())
    for content in ("", text[:-1], text + "\n\n", text + "\r\n", f"{text}\n{text}\n", "\udcff"):
        path.write_bytes(content.encode(errors="surrogateescape"))
        path.chmod(0o600)
        with pytest.raises(SealError, match=r"anna\.key (holds no key|has more than)") as caught:
            read_holder_key(path)
        assert text[:8] not in str(caught.value)
    path.write_text(text)
    assert encode_holder_key(read_holder_key(path)) == text
    path.chmod(0o640)
    with pytest.raises(SealError, match="may be read by others"):
        read_holder_key(path)
    with pytest.raises(SealError, match="No such file"):
        read_holder_key(tmp_path / "absent")
