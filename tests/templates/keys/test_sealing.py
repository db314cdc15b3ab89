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


@pytest.mark.parametrize(
    ("purpose", "bound"), [("q", ["a"]), ("p", ["b"]), ("p", []), ("p", ["a", ""])]
)
def test_a_blob_opens_only_where_it_belongs(purpose: str, bound: Parts) -> None:
    keyring = MasterKeyring([KEY])
    sealed = keyring.seal(b"text", purpose="p", bound_to=["a"])
    with pytest.raises(SealError, match="altered, or belongs elsewhere"):
        keyring.open(sealed, purpose=purpose, bound_to=bound)


@pytest.mark.parametrize("length", [0, 1, OVERHEAD_BYTES - 1])
def test_a_truncated_blob_is_refused(length: int) -> None:
    keyring = MasterKeyring([KEY])
    sealed = keyring.seal(b"", purpose="p", bound_to=[])[:length]
    with pytest.raises(SealError, match="at least"):
        keyring.open(sealed, purpose="p", bound_to=[])


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


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    path = write(tmp_path / "key", b"precious")
    with pytest.raises(SealError, match="exists already"):
        MasterKeyring.create(path)
    assert path.read_bytes() == b"precious\n"


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o610, 0o777])
def test_a_file_that_others_may_use_is_refused(tmp_path: Path, mode: int) -> None:
    path = write(tmp_path / "key", base64.b64encode(KEY), mode=mode)
    with pytest.raises(SealError, match="chmod 600"):
        MasterKeyring.load(path)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "holds no key"),
        ([b"not base64!"], "not base64"),
        ([b"\xff\xfe"], "not text"),
        ([base64.b64encode(KEY) + b" " + base64.b64encode(OTHER)], "not base64"),
        ([base64.b64encode(KEY[:31])], "31 bytes"),
        ([base64.b64encode(KEY + b"x")], "33 bytes"),
        ([base64.b64encode(KEY), base64.b64encode(KEY)], "same key twice"),
        ([base64.b64encode(KEY), base64.b64encode(b"short")], "key 2"),
        ([b"A" * 100_000], "more than"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, lines: list[bytes], message: str) -> None:
    with pytest.raises(SealError, match=message):
        MasterKeyring.load(write(tmp_path / "key", *lines))


def test_things_that_are_no_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SealError, match="does not exist"):
        MasterKeyring.load(tmp_path / "absent")
    with pytest.raises(SealError, match="not a regular file"):
        MasterKeyring.load(tmp_path)
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(SealError, match="not a regular file"):
        MasterKeyring.load(tmp_path / "pipe")


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


def test_a_bad_key_is_not_quoted_in_the_error(tmp_path: Path) -> None:
    text = b"correct horse battery staple"
    with pytest.raises(SealError) as caught:
        MasterKeyring.load(write(tmp_path / "key", base64.b64encode(text)))
    assert "correct" not in str(caught.value)
    assert base64.b64encode(text).decode() not in str(caught.value)


def test_the_sealer_binds_its_context() -> None:
    sealer = Sealer(MasterKeyring([KEY]))
    sealed = sealer.seal(b"rows", context="pool 1")
    assert sealer.open(sealed, context="pool 1") == b"rows"
    for other, context in (
        (sealer, "pool 2"),
        (Sealer(MasterKeyring([OTHER])), "pool 1"),
    ):
        with pytest.raises(SealError):
            other.open(sealed, context=context)


def lines_of(*keys: bytes) -> str:
    return "".join(base64.b64encode(key).decode() + "\n" for key in keys)


@pytest.mark.parametrize("separator", ["\n", " ", ",", ", "])
def test_keys_come_from_the_environment(monkeypatch: pytest.MonkeyPatch, separator: str) -> None:
    encoded = lines_of(KEY, OTHER).split()
    monkeypatch.setenv("VEILFACE_TEST_KEYS", separator.join(encoded))
    keyring = MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    assert keyring.key_ids == MasterKeyring([KEY, OTHER]).key_ids
    sealed = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    assert keyring.open(sealed, purpose="p", bound_to=[]) == b"text"


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "holds no key"), (lines_of(KEY, OTHER[:31]), "key 2 .* 31 bytes")],
)
def test_bad_keys_in_the_environment_are_refused(
    monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    monkeypatch.setenv("VEILFACE_TEST_KEYS", text)
    with pytest.raises(SealError, match=message) as caught:
        MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    assert "VEILFACE_TEST_KEYS" in str(caught.value)
    assert not any(line in str(caught.value) for line in text.split())


def test_an_unset_variable_is_named() -> None:
    with pytest.raises(SealError, match="VEILFACE_TEST_KEYS is not set"):
        MasterKeyring.from_environment("VEILFACE_TEST_KEYS")


# --- credentials of systemd ----------------------------------------------------------------


@pytest.fixture
def credential(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A key file as systemd hands one over: root's, with the group's bit as a list makes it."""
    if os.geteuid() != 0:
        pytest.skip("a credential is root's file")
    folder = tmp_path / "credentials"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(folder))
    file = folder / "master.key"
    MasterKeyring.create(file)
    file.chmod(0o440)
    return file


def test_a_credential_of_systemd_is_taken(credential: Path) -> None:
    assert MasterKeyring.load(credential).key_ids


@pytest.mark.parametrize("wrong", ["others may read", "others may write there", "elsewhere"])
def test_what_only_looks_like_a_credential_is_refused(
    credential: Path, monkeypatch: pytest.MonkeyPatch, wrong: str
) -> None:
    match wrong:
        case "others may read":
            credential.chmod(0o444)
        case "others may write there":
            credential.parent.chmod(0o770)
        case _:
            monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(credential.parent.parent))
    with pytest.raises(SealError, match="may be read by others"):
        MasterKeyring.load(credential)
