import base64
import hashlib
import hmac
import os
import pickle
from collections.abc import Sequence
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from hypothesis import given
from hypothesis import strategies as st

from templates.errors import SealError
from templates.keys.sealing import (
    OVERHEAD_BYTES,
    MasterKeyring,
    Sealer,
    encode_parts,
    sealed_key_id,
)

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
STRANGER = 61234

KEY = hashlib.sha256(b"a key for tests").digest()
OTHER = hashlib.sha256(b"another key for tests").digest()
TEXT = base64.b64encode(KEY).decode()

Parts = Sequence[str | bytes | int]
parts = st.lists(st.one_of(st.text(max_size=8), st.binary(max_size=8), st.integers()), max_size=4)


def write(path: Path, *lines: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(b"".join(line + b"\n" for line in lines))
    path.chmod(mode)
    return path


def hkdf_by_hand(key: bytes, info: bytes) -> bytes:
    extracted = hmac.digest(bytes(32), key, hashlib.sha256)
    return hmac.digest(extracted, info + b"\x01", hashlib.sha256)


@given(plaintext=st.binary(max_size=200), purpose=st.text(max_size=10), bound=parts)
def test_what_is_sealed_opens_again(plaintext: bytes, purpose: str, bound: Parts) -> None:
    keyring = MasterKeyring([KEY])
    sealed = keyring.seal(plaintext, purpose=purpose, bound_to=bound)
    assert len(sealed) == len(plaintext) + OVERHEAD_BYTES
    assert keyring.open(sealed, purpose=purpose, bound_to=bound) == plaintext


def test_a_blob_is_the_documented_format() -> None:
    """Opened with nothing but the standard library's HMAC and AES-GCM."""
    keyring = MasterKeyring([KEY])
    sealed = keyring.seal(b"text", purpose="p", bound_to=["t", b"b", -7])
    nonces = {sealed[9:21], keyring.seal(b"text", purpose="p", bound_to=["t", b"b", -7])[9:21]}
    assert len(nonces) == 2  # one that comes twice under a key breaks AES-GCM
    key_id = hashlib.sha256(hkdf_by_hand(KEY, b"veilface/1/key-id")).digest()[:8]
    assert sealed[:9] == b"\x01" + key_id
    aad = sealed[:9] + (4).to_bytes(4, "big")
    for kind, body in ((b"t", b"p"), (b"t", b"t"), (b"b", b"b"), (b"i", b"-7")):
        aad += kind + len(body).to_bytes(8, "big") + body
    cipher = AESGCM(hkdf_by_hand(KEY, b"veilface/1/seal/p"))
    assert cipher.decrypt(sealed[9:21], sealed[21:], aad) == b"text"


@given(first=parts, second=parts)
def test_different_parts_have_different_encodings(first: Parts, second: Parts) -> None:
    same = first == second and [type(part) for part in first] == [type(part) for part in second]
    assert (encode_parts(*first) == encode_parts(*second)) == same


def test_any_altered_byte_is_noticed() -> None:
    keyring = MasterKeyring([KEY])
    sealed = keyring.seal(b"text", purpose="p", bound_to=["a"])
    for position in range(len(sealed)):
        altered = bytearray(sealed)
        altered[position] ^= 1
        with pytest.raises(SealError):
            keyring.open(bytes(altered), purpose="p", bound_to=["a"])


def test_a_blob_opens_only_where_it_belongs() -> None:
    keyring = MasterKeyring([KEY])
    sealed = keyring.seal(b"text", purpose="p", bound_to=["a"])
    for purpose, bound in (("q", ["a"]), ("p", ["b"]), ("p", []), ("p", ["a", ""])):
        with pytest.raises(SealError, match="altered, or belongs elsewhere"):
            keyring.open(sealed, purpose=purpose, bound_to=bound)
    for length in (0, 1, OVERHEAD_BYTES - 1):
        with pytest.raises(SealError, match="at least"):
            keyring.open(sealed[:length], purpose="p", bound_to=["a"])
    sealer = Sealer(keyring)
    sealed = sealer.seal(b"rows", context="pool 1")
    assert sealer.open(sealed, context="pool 1") == b"rows"
    with pytest.raises(SealError, match="altered, or belongs elsewhere"):
        sealer.open(sealed, context="pool 2")


def test_an_older_key_still_opens() -> None:
    sealed = MasterKeyring([KEY]).seal(b"text", purpose="p", bound_to=[])
    keyring = MasterKeyring([OTHER, KEY])
    assert keyring.open(sealed, purpose="p", bound_to=[]) == b"text"
    renewed = keyring.rewrap(sealed, purpose="p", bound_to=[])
    assert sealed_key_id(renewed) == keyring.current != sealed_key_id(sealed)
    assert MasterKeyring([OTHER]).open(renewed, purpose="p", bound_to=[]) == b"text"


def test_a_created_file_is_private_and_random(tmp_path: Path) -> None:
    keyring = MasterKeyring.create(tmp_path / "key")
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    assert len(base64.b64decode((tmp_path / "key").read_bytes())) == 32
    assert list(tmp_path.iterdir()) == [tmp_path / "key"]
    assert keyring.current != MasterKeyring.create(tmp_path / "key2").current
    before = (tmp_path / "key").read_bytes()
    with pytest.raises(SealError, match="exists already"):
        MasterKeyring.create(tmp_path / "key")
    assert (tmp_path / "key").read_bytes() == before


BAD_KEYS = [
    ([], "holds no key"),
    (["not-base64!"], "not base64"),
    ([base64.b64encode(KEY[:31]).decode()], "31 bytes"),
    ([base64.b64encode(KEY + b"x").decode()], "33 bytes"),
    ([TEXT, TEXT], "same key twice"),
    ([TEXT, base64.b64encode(b"short").decode()], "key 2"),
]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        *BAD_KEYS,
        (["\u00fc"], "not text"),
        ([TEXT + " " + TEXT], "not base64"),
        (["A" * 10**5], "more than"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(SealError, match=message) as refused:
        MasterKeyring.load(write(tmp_path / "key", *map(str.encode, lines)))
    assert not any(line in str(refused.value) for line in lines)


@pytest.mark.parametrize(("lines", "message"), BAD_KEYS)
def test_bad_keys_in_the_environment_are_refused(
    monkeypatch: pytest.MonkeyPatch, lines: list[str], message: str
) -> None:
    monkeypatch.setenv("VEILFACE_TEST_KEYS", ",".join(lines))
    with pytest.raises(SealError, match=message) as refused:
        MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    assert "VEILFACE_TEST_KEYS" in str(refused.value)
    assert not any(line in str(refused.value) for line in lines)


@pytest.mark.parametrize("separator", ["\n", " ", ",", ", "])
def test_keys_come_from_the_environment(monkeypatch: pytest.MonkeyPatch, separator: str) -> None:
    with pytest.raises(SealError, match="VEILFACE_TEST_KEYS is not set"):
        MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    monkeypatch.setenv("VEILFACE_TEST_KEYS", TEXT + separator + base64.b64encode(OTHER).decode())
    keyring = MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    assert keyring.key_ids == MasterKeyring([KEY, OTHER]).key_ids


def test_things_that_are_no_file_of_ones_own_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    places = [
        (tmp_path / "absent", "does not exist"),
        (tmp_path, "not a regular file"),
        (tmp_path / "pipe", "not a regular file"),
    ]
    for mode in (0o640, 0o604, 0o660, 0o610, 0o777):
        places.append((write(tmp_path / f"{mode}", TEXT.encode(), mode=mode), "chmod 600"))
    for path, message in places:
        with pytest.raises(SealError, match=message):
            MasterKeyring.load(path)


def test_rotating_the_file_is_followed_while_running(tmp_path: Path) -> None:
    running = MasterKeyring.create(tmp_path / "key")
    first = running.current
    sealed = running.seal(b"old", purpose="p", bound_to=[])

    second = MasterKeyring.add_current(tmp_path / "key")
    new = MasterKeyring.load(tmp_path / "key").seal(b"new", purpose="p", bound_to=[])
    assert running.open(new, purpose="p", bound_to=[]) == b"new"
    assert running.key_ids == (second, first)
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    assert sealed_key_id(running.seal(b"new", purpose="p", bound_to=[])) == second
    assert running.open(sealed, purpose="p", bound_to=[]) == b"old"

    assert MasterKeyring.drop_retired(tmp_path / "key", keep=second) == 1
    assert list(running.key_ids) == [second]
    with pytest.raises(SealError, match=first):
        running.open(sealed, purpose="p", bound_to=[])


@pytest.mark.parametrize(
    ("damage", "said"),
    [("removed", "No such file"), ("opened to others", "chmod 600"), ("emptied", "no key")],
)
def test_a_service_keeps_its_keys_while_the_file_is_broken_and_says_so(
    tmp_path: Path, damage: str, said: str
) -> None:
    path = tmp_path / "key"
    running = MasterKeyring.create(path)
    sealed = running.seal(b"text", purpose="p", bound_to=[])
    text = path.read_bytes()
    assert running.stale_reason is None
    match damage:
        case "removed":
            path.unlink()
        case "opened to others":
            MasterKeyring.add_current(path)
            path.chmod(0o644)
        case "emptied":
            path.write_bytes(b"")
    assert running.open(sealed, purpose="p", bound_to=[]) == b"text"
    assert running.current == sealed_key_id(sealed)
    assert said in str(running.stale_reason)
    assert str(path) in str(running.stale_reason)
    path.unlink(missing_ok=True)
    write(path, text.strip())
    assert running.stale_reason is None


def test_no_key_is_dropped_once_another_one_came_first(tmp_path: Path) -> None:
    path = tmp_path / "key"
    first = MasterKeyring.create(path).current
    checked = MasterKeyring.add_current(path)
    later = MasterKeyring.add_current(path)
    for keep in (checked, first, "0" * 16):
        with pytest.raises(SealError, match=rf"{later}, but .* {keep}.*no key was dropped"):
            MasterKeyring.drop_retired(path, keep=keep)
    assert MasterKeyring.load(path).key_ids == (later, checked, first)
    assert MasterKeyring.drop_retired(path, keep=later) == 2
    assert MasterKeyring.load(path).key_ids == (later,)


@as_root
def test_root_does_not_work_on_the_key_file_of_another_user(tmp_path: Path) -> None:
    path = tmp_path / "key"
    MasterKeyring.create(path)
    os.chown(path, STRANGER, STRANGER)
    before = path.read_bytes()
    for use in (MasterKeyring.load, MasterKeyring.add_current):
        with pytest.raises(SealError, match=f"belongs to user {STRANGER}: run this as that user"):
            use(path)
    assert path.read_bytes() == before


def test_keys_do_not_show(tmp_path: Path) -> None:
    keyring = MasterKeyring.create(tmp_path / "key")
    key = base64.b64decode((tmp_path / "key").read_bytes())
    shown = repr(keyring) + repr(Sealer(keyring)) + repr(vars(keyring))
    for form in (key.hex(), repr(key)[2:-1], base64.b64encode(key).decode()):
        assert form not in shown
    assert keyring.current in repr(keyring)
    with pytest.raises(TypeError, match="not serialised"):
        pickle.dumps(keyring)


@as_root
@pytest.mark.parametrize(
    ("mode", "folder_mode", "named", "taken"),
    [
        (0o440, 0o700, "credentials", True),
        (0o444, 0o700, "credentials", False),  # others may read
        (0o440, 0o770, "credentials", False),  # others may write there
        (0o440, 0o700, ".", False),  # elsewhere
    ],
)
def test_a_credential_of_systemd_is_taken_and_nothing_that_only_looks_like_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mode: int,
    folder_mode: int,
    named: str,
    taken: bool,
) -> None:
    """systemd hands over root's file, with the group's bit as an access control list makes it."""
    file = tmp_path / "credentials" / "master.key"
    key_ids = MasterKeyring.create(file).key_ids
    file.chmod(mode)
    file.parent.chmod(folder_mode)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / named))
    if taken:
        assert MasterKeyring.load(file).key_ids == key_ids
    else:
        with pytest.raises(SealError, match="may be read by others"):
            MasterKeyring.load(file)
