import base64
import contextlib
import hashlib
import hmac
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from hypothesis import given
from hypothesis import strategies as st

from templates.errors import SealError
from templates.keys.key_file import locked, read_key_file
from templates.keys.private_file import replace_private
from templates.keys.sealing import (
    OVERHEAD_BYTES,
    KeyringSealer,
    MasterKeyring,
    derive_key,
    encode_parts,
    sealed_key_id,
)
from templates.store import InvalidIdentifier, TemplateStore
from tests.patience import PATIENCE_S, wait_until

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
    sealed = MasterKeyring([KEY]).seal(b"text", purpose="p", bound_to=["t", b"b", -7])
    key_id = hashlib.sha256(hkdf_by_hand(KEY, b"veilface/1/key-id")).digest()[:8]
    assert sealed[:9] == b"\x01" + key_id
    aad = sealed[:9] + (4).to_bytes(4, "big")
    for kind, body in ((b"t", b"p"), (b"t", b"t"), (b"b", b"b"), (b"i", b"-7")):
        aad += kind + len(body).to_bytes(8, "big") + body
    cipher = AESGCM(hkdf_by_hand(KEY, b"veilface/1/seal/p"))
    assert cipher.decrypt(sealed[9:21], sealed[21:], aad) == b"text"


def test_derive_key_is_hkdf_sha256() -> None:
    assert derive_key(KEY, "label") == hkdf_by_hand(KEY, b"veilface/1/label")


def test_nonces_differ() -> None:
    keyring = MasterKeyring([KEY])
    sealed = {keyring.seal(b"same", purpose="p", bound_to=[]) for _ in range(100)}
    assert len({blob[9:21] for blob in sealed}) == 100


@given(first=parts, second=parts)
def test_different_parts_have_different_encodings(first: Parts, second: Parts) -> None:
    same = first == second and [type(part) for part in first] == [type(part) for part in second]
    assert (encode_parts(*first) == encode_parts(*second)) == same


def test_shifting_a_boundary_changes_the_encoding() -> None:
    assert encode_parts("ab", "c") != encode_parts("a", "bc")
    assert encode_parts("1") != encode_parts(1)
    assert encode_parts("a", "") != encode_parts("a")


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


def test_another_key_is_named_in_the_error() -> None:
    sealed = MasterKeyring([KEY]).seal(b"text", purpose="p", bound_to=[])
    with pytest.raises(SealError, match=sealed_key_id(sealed)):
        MasterKeyring([OTHER]).open(sealed, purpose="p", bound_to=[])


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


def test_of_many_creators_exactly_one_succeeds(tmp_path: Path) -> None:
    made: list[str] = []
    refused: list[SealError] = []
    start = threading.Barrier(8)

    def create() -> None:
        start.wait()
        try:
            made.append(MasterKeyring.create(tmp_path / "key").current)
        except SealError as error:
            refused.append(error)

    threads = [threading.Thread(target=create) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    assert len(refused) == 7
    assert MasterKeyring.load(tmp_path / "key").current == made[0]


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
        ([base64.b64encode(bytes(32))], "pattern"),
        ([base64.b64encode(b"\xaa" * 32)], "pattern"),
        ([base64.b64encode(bytes(range(32)))], "pattern"),
        ([base64.b64encode(KEY[:16] * 2)], "pattern"),
        ([base64.b64encode(b"correct horse battery staple 32!")], "readable text"),
        ([base64.b64encode(KEY), base64.b64encode(KEY)], "same key twice"),
        ([base64.b64encode(KEY), base64.b64encode(bytes(32))], "key 2"),
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


def test_random_keys_pass_the_weakness_check() -> None:
    for _ in range(2000):
        MasterKeyring([os.urandom(32)])


def test_rotating_the_file_is_followed_while_running(tmp_path: Path) -> None:
    running = MasterKeyring.create(tmp_path / "key")
    first = running.current
    sealed = running.seal(b"old", purpose="p", bound_to=[])

    second = MasterKeyring.add_current(tmp_path / "key")
    assert running.key_ids == (second, first)
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    assert sealed_key_id(running.seal(b"new", purpose="p", bound_to=[])) == second
    assert running.open(sealed, purpose="p", bound_to=[]) == b"old"

    assert MasterKeyring.drop_retired(tmp_path / "key", keep=second) == 1
    assert list(running.key_ids) == [second]
    with pytest.raises(SealError, match=first):
        running.open(sealed, purpose="p", bound_to=[])


def test_a_blob_under_a_key_that_was_just_added_opens(tmp_path: Path) -> None:
    running = MasterKeyring.create(tmp_path / "key")
    MasterKeyring.add_current(tmp_path / "key")
    sealed = MasterKeyring.load(tmp_path / "key").seal(b"new", purpose="p", bound_to=[])
    assert running.open(sealed, purpose="p", bound_to=[]) == b"new"


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


def test_rotations_at_once_lose_no_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "key"
    first = MasterKeyring.create(path).current
    made: list[str] = []
    refused: list[str] = []
    start = threading.Barrier(8)

    def read_slowly(path: Path) -> object:
        found = read_key_file(path)
        time.sleep(0.05)  # all eight read before one of them writes, if nothing stops them
        return found

    def rotate() -> None:
        start.wait()
        try:
            made.append(MasterKeyring.add_current(path))
        except SealError as error:
            refused.append(str(error))

    with monkeypatch.context() as patch:
        patch.setattr("templates.keys.sealing.read_key_file", read_slowly)
        threads = [threading.Thread(target=rotate) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert made
    assert len(made) + len(refused) == 8
    assert all("another rotation" in each for each in refused)
    assert set(MasterKeyring.load(path).key_ids) == {first, *made}


def test_another_process_keeps_a_rotation_out_until_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "key"
    first = MasterKeyring.create(path).current
    script = (
        "import sys; from pathlib import Path; from templates.keys.key_file import locked\n"
        "with locked(Path(sys.argv[1])):\n print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        (tmp_path / "link").symlink_to(path)
        for name in (path, tmp_path / "link"):
            with pytest.raises(SealError, match="another rotation of the key file"):
                MasterKeyring.add_current(name)
            with pytest.raises(SealError, match="another rotation of the key file"):
                MasterKeyring.drop_retired(name, keep=first)
        assert MasterKeyring.load(path).key_ids == (first,)
        other.kill()  # a crash leaves the file of the lock, but no lock
    MasterKeyring.add_current(path)
    assert len(MasterKeyring.load(path).key_ids) == 2


def test_who_has_the_lock_may_rotate_and_the_lock_is_private(tmp_path: Path) -> None:
    path = tmp_path / "key"
    MasterKeyring.create(path)
    with locked(path):
        current = MasterKeyring.add_current(path)
        assert MasterKeyring.drop_retired(path, keep=current) == 1
        with ThreadPoolExecutor(1) as thread, pytest.raises(SealError, match="another rotation"):
            thread.submit(MasterKeyring.add_current, path).result()
    MasterKeyring.add_current(path)
    assert (tmp_path / ".key.lock").stat().st_mode & 0o777 == 0o600
    assert {each.name for each in tmp_path.iterdir()} == {"key", ".key.lock"}


def test_a_link_in_the_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    path = tmp_path / "key"
    MasterKeyring.create(path)
    (tmp_path / ".key.lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SealError, match="cannot be opened"):
        MasterKeyring.add_current(path)
    assert not (tmp_path / "elsewhere").exists()


def test_a_link_to_the_key_file_stays_a_link(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.mkdir()
    first = MasterKeyring.create(real / "key").current
    (tmp_path / "middle").symlink_to("real/key")
    link.symlink_to("middle")
    running = MasterKeyring.load(real / "key")
    second = MasterKeyring.add_current(link)
    assert link.is_symlink()
    assert (tmp_path / "middle").is_symlink()
    assert MasterKeyring.load(link).key_ids == running.key_ids == (second, first)
    assert MasterKeyring.drop_retired(link, keep=second) == 1
    assert list(running.key_ids) == [second]
    assert {each.name for each in real.iterdir()} == {"key", ".key.lock"}


@as_root
def test_a_rotation_by_root_leaves_the_file_to_its_owner(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    folder.mkdir()
    path = folder / "key"
    MasterKeyring.create(path)
    for each in (folder, path):
        os.chown(each, STRANGER, STRANGER)
    current = MasterKeyring.add_current(path)
    MasterKeyring.drop_retired(path, keep=current)
    for each in (path, folder / ".key.lock"):
        status = each.stat()
        assert (status.st_uid, status.st_gid, status.st_mode & 0o777) == (STRANGER, STRANGER, 0o600)


@as_root
def test_a_file_that_could_not_stay_its_owners_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "keys"
    folder.mkdir()
    path = folder / "key"
    MasterKeyring.create(path)
    for each in (folder, path):
        os.chown(each, STRANGER, STRANGER)
    before = path.read_bytes()

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "fchown", refuse)
    with pytest.raises(SealError, match=f"belongs to user {STRANGER} .*run this as that user"):
        MasterKeyring.add_current(path)
    assert path.read_bytes() == before
    assert {each.name for each in folder.iterdir()} == {"key", ".key.lock"}


def test_a_key_file_of_a_stranger_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "key"
    MasterKeyring.create(path)
    if os.geteuid() == 0:
        os.chown(path, STRANGER, -1)
    else:
        monkeypatch.setattr("templates.keys.private_file.is_trusted", lambda *_: False)
        monkeypatch.setattr("templates.keys.key_file.is_trusted", lambda *_: False)
    for use in (MasterKeyring.load, MasterKeyring.add_current):
        with pytest.raises(SealError, match=r"belongs to user .*, who is neither .*`chown` it"):
            use(path)


@as_root
def test_a_link_of_a_stranger_is_not_followed(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    MasterKeyring.create(theirs / "key")
    (theirs / "out").write_bytes(b"before")
    for each in (theirs, *theirs.iterdir()):
        os.chown(each, STRANGER, STRANGER)
    for name in ("key", "out"):
        (tmp_path / name).symlink_to(theirs / name)
        os.lchown(tmp_path / name, STRANGER, STRANGER)
    for use in (MasterKeyring.load, MasterKeyring.add_current):
        with pytest.raises(SealError, match=f"a link on the way .* user {STRANGER}"):
            use(tmp_path / "key")
    with pytest.raises(PermissionError, match=f"a link of user {STRANGER} on the way"):
        replace_private(tmp_path / "out", b"private")
    assert (theirs / "out").read_bytes() == b"before"
    assert (tmp_path / "out").is_symlink()


@as_root
def test_private_data_is_not_handed_to_who_took_its_place_first(tmp_path: Path) -> None:
    planted, owned = tmp_path / "planted", tmp_path / "folder" / "owned"
    owned.parent.mkdir()
    for path in (planted, owned):
        path.write_bytes(b"before")
        os.chown(path, STRANGER, STRANGER)
    os.chown(owned.parent, STRANGER, STRANGER)
    for path, owner in ((planted, 0), (owned, STRANGER)):
        replace_private(path, b"private")
        assert (path.stat().st_uid, path.stat().st_mode & 0o777) == (owner, 0o600)
        assert path.read_bytes() == b"private"


def test_keys_do_not_show(tmp_path: Path) -> None:
    keyring = MasterKeyring.create(tmp_path / "key")
    key = base64.b64decode((tmp_path / "key").read_bytes())
    shown = repr(keyring) + repr(KeyringSealer(keyring)) + repr(vars(keyring))
    for form in (key.hex(), repr(key)[2:-1], base64.b64encode(key).decode()):
        assert form not in shown
    assert keyring.current in repr(keyring)
    with pytest.raises(TypeError, match="not serialised"):
        pickle.dumps(keyring)


def test_a_bad_key_is_not_quoted_in_the_error(tmp_path: Path) -> None:
    text = b"correct horse battery staple 32!"
    with pytest.raises(SealError) as caught:
        MasterKeyring.load(write(tmp_path / "key", base64.b64encode(text)))
    assert "correct" not in str(caught.value)
    assert base64.b64encode(text).decode() not in str(caught.value)


def test_the_sealer_binds_context_and_purpose() -> None:
    keyring = MasterKeyring([KEY])
    pool = KeyringSealer(keyring, purpose="decoys")
    sealed = pool.seal(b"rows", context="pool 1")
    assert pool.open(sealed, context="pool 1") == b"rows"
    assert KeyringSealer(MasterKeyring([OTHER, KEY]), purpose="decoys").open(
        sealed, context="pool 1"
    )
    for sealer, context in (
        (pool, "pool 2"),
        (KeyringSealer(keyring, purpose="cache"), "pool 1"),
        (KeyringSealer(MasterKeyring([OTHER]), purpose="decoys"), "pool 1"),
    ):
        with pytest.raises(SealError):
            sealer.open(sealed, context=context)


def lines_of(*keys: bytes) -> str:
    return "".join(base64.b64encode(key).decode() + "\n" for key in keys)


BAD_TEXTS = [
    ("", "holds no key"),
    ("not-base64!", "not base64"),
    (lines_of(KEY[:31]), "31 bytes"),
    (lines_of(bytes(32)), "pattern"),
    (lines_of(b"correct horse battery staple 32!"), "readable text"),
    (lines_of(KEY, KEY), "same key twice"),
    (lines_of(KEY, bytes(range(32))), "key 2"),
]


@pytest.mark.parametrize("separator", ["\n", " ", ",", ", "])
def test_keys_come_from_the_environment(monkeypatch: pytest.MonkeyPatch, separator: str) -> None:
    encoded = lines_of(KEY, OTHER).split()
    monkeypatch.setenv("VEILFACE_TEST_KEYS", separator.join(encoded))
    keyring = MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    assert keyring.key_ids == MasterKeyring([KEY, OTHER]).key_ids
    sealed = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    assert keyring.open(sealed, purpose="p", bound_to=[]) == b"text"


@pytest.mark.parametrize(("text", "message"), BAD_TEXTS)
def test_bad_keys_in_the_environment_are_refused(
    monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    monkeypatch.setenv("VEILFACE_TEST_KEYS", text)
    with pytest.raises(SealError, match=message) as caught:
        MasterKeyring.from_environment("VEILFACE_TEST_KEYS")
    assert "VEILFACE_TEST_KEYS" in str(caught.value)
    assert not any(line in str(caught.value) for line in text.split())


def test_an_unset_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VEILFACE_TEST_KEYS", raising=False)
    with pytest.raises(SealError, match="VEILFACE_TEST_KEYS is not set"):
        MasterKeyring.from_environment("VEILFACE_TEST_KEYS")


class Kms:
    """A command that writes what the test put in a file, and notes each time that it was run."""

    def __init__(self, folder: Path) -> None:
        self.answer = folder / "answer"
        self.runs = folder / "runs"
        self.runs.touch()
        self.argv = [
            "/bin/sh",
            "-c",
            'echo run >>"$2"; cat "$1" || exit 7',
            "kms",
            str(self.answer),
            str(self.runs),
        ]

    @property
    def count(self) -> int:
        return len(self.runs.read_text().splitlines())


@pytest.fixture
def kms(tmp_path: Path) -> Kms:
    return Kms(tmp_path)


def test_keys_come_from_a_command(kms: Kms) -> None:
    kms.answer.write_text(lines_of(KEY, OTHER))
    keyring = MasterKeyring.from_command(kms.argv)
    assert keyring.key_ids == MasterKeyring([KEY, OTHER]).key_ids
    for _ in range(3):
        sealed = keyring.seal(b"text", purpose="p", bound_to=[])
        assert keyring.open(sealed, purpose="p", bound_to=[]) == b"text"
    assert kms.count == 1  # known keys need no command
    shown = repr(keyring) + repr(vars(keyring)) + repr(vars(keyring._command))
    for form in (KEY.hex(), repr(KEY)[2:-1], base64.b64encode(KEY).decode()):
        assert form not in shown


@pytest.mark.parametrize(("text", "message"), [*BAD_TEXTS, ("\xff", "text")])
def test_bad_keys_of_a_command_are_refused(kms: Kms, text: str, message: str) -> None:
    kms.answer.write_text(text)
    with pytest.raises(SealError, match=message) as caught:
        MasterKeyring.from_command(kms.argv)
    assert not any(line in str(caught.value) for line in text.split())


def test_a_failing_command_is_named_and_its_words_are_not_repeated() -> None:
    argv = ["/bin/sh", "-c", "echo credential-1 >&2; echo credential-2; exit 3"]
    with pytest.raises(SealError, match="/bin/sh failed with exit status 3") as caught:
        MasterKeyring.from_command(argv)
    assert "credential" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_a_command_writes_nothing_to_our_standard_error(
    kms: Kms, capfd: pytest.CaptureFixture[str]
) -> None:
    kms.answer.write_text(lines_of(KEY))
    kms.argv[2] = "echo credential >&2; " + kms.argv[2]
    MasterKeyring.from_command(kms.argv)
    assert capfd.readouterr() == ("", "")


def test_no_shell_reads_the_command(tmp_path: Path) -> None:
    with pytest.raises(SealError, match="cannot be started"):
        MasterKeyring.from_command([f"true; touch {tmp_path / 'made'}"])
    with pytest.raises(SealError, match="not base64"):
        MasterKeyring.from_command(["/bin/echo", "$(id)"])
    with pytest.raises(SealError, match="empty"):
        MasterKeyring.from_command([])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "script",
    [
        # It ended, and a child of it holds its output open.
        "sleep 100000 & exit 0",
        # Its output is closed, and it does not end.
        pytest.param("exec >&-; sleep 100000", marks=pytest.mark.long),
        pytest.param("sleep 100000", marks=pytest.mark.long),
        pytest.param('trap "" TERM; while :; do sleep 1; done', marks=pytest.mark.long),
    ],
)
def test_a_slow_command_is_killed_with_all_that_it_started(tmp_path: Path, script: str) -> None:
    leader = tmp_path / "pid"
    with pytest.raises(SealError, match=r"within 2 seconds"):
        MasterKeyring.from_command(
            ["/bin/sh", "-c", f'echo $$ >"$1"; {script}', "kms", str(leader)], timeout_s=2
        )
    group = int(leader.read_text())
    # A killed orphan is there until the system's first process has waited for it.
    wait_until(lambda: not alive(group), what="the end of all that the command started")


def alive(group: int) -> list[int]:
    """Processes of a group that are not dead and waited for."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


def test_a_command_that_does_not_stop_writing_is_stopped() -> None:
    with pytest.raises(SealError, match="more than 65536 bytes"):
        MasterKeyring.from_command(["/bin/sh", "-c", "yes"], timeout_s=PATIENCE_S)


def test_a_command_is_asked_again_for_an_unknown_key_but_not_often(
    kms: Kms, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("templates.keys.key_command.time.monotonic", lambda: now)
    kms.answer.write_text(lines_of(KEY))
    keyring = MasterKeyring.from_command(kms.argv)
    sealed = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    kms.answer.write_text(lines_of(OTHER, KEY))

    now += 9
    with pytest.raises(SealError, match="put the missing key back"):
        keyring.open(sealed, purpose="p", bound_to=[])
    assert kms.count == 1
    now += 2
    assert keyring.open(sealed, purpose="p", bound_to=[]) == b"text"
    assert kms.count == 2
    assert keyring.key_ids == MasterKeyring([OTHER, KEY]).key_ids
    assert keyring.current == sealed_key_id(keyring.seal(b"", purpose="p", bound_to=[]))

    never = MasterKeyring([hashlib.sha256(b"never").digest()]).seal(b"", purpose="p", bound_to=[])
    now += 60
    for _ in range(5):
        with pytest.raises(SealError, match="put the missing key back"):
            keyring.open(never, purpose="p", bound_to=[])
    assert kms.count == 3


def test_threads_that_meet_an_unknown_key_ask_once(
    kms: Kms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.keys.key_command.ASK_AGAIN_S", 0.0)
    kms.answer.write_text(lines_of(KEY))
    keyring = MasterKeyring.from_command(kms.argv)
    kms.answer.write_text(lines_of(KEY, OTHER))
    sealed = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    start = threading.Barrier(8)

    def open_it() -> bytes:
        start.wait()
        return keyring.open(sealed, purpose="p", bound_to=[])

    with ThreadPoolExecutor(8) as threads:
        opened = [each.result() for each in [threads.submit(open_it) for _ in range(8)]]
    assert opened == [b"text"] * 8
    assert kms.count == 2


def test_a_service_keeps_its_keys_while_the_command_fails(
    kms: Kms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.keys.key_command.ASK_AGAIN_S", 0.0)
    kms.answer.write_text(lines_of(KEY))
    keyring = MasterKeyring.from_command(kms.argv)
    mine = keyring.seal(b"text", purpose="p", bound_to=[])
    theirs = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    kms.answer.unlink()
    with pytest.raises(SealError, match=r"asked again, .* exit status 7"):
        keyring.open(theirs, purpose="p", bound_to=[])
    assert keyring.open(mine, purpose="p", bound_to=[]) == b"text"
    kms.answer.write_text(lines_of(KEY, OTHER))
    assert keyring.open(theirs, purpose="p", bound_to=[]) == b"text"


def test_a_blob_that_anybody_may_have_made_up_runs_no_command(
    kms: Kms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.keys.key_command.ASK_AGAIN_S", 0.0)
    kms.answer.write_text(lines_of(KEY))
    keyring = MasterKeyring.from_command(kms.argv)
    theirs = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    with pytest.raises(SealError, match="put the missing key back"):
        keyring.open(theirs, purpose="p", bound_to=[], refresh=False)
    assert kms.count == 1

    store = TemplateStore(f"sqlite:///{tmp_path / 'store.db'}", keyring)
    store.upgrade()
    store.tenants.create("default")
    with pytest.raises(InvalidIdentifier, match="start again without one"):
        store.subjects.list("default", cursor=base64.urlsafe_b64encode(theirs).decode())
    store.close()
    assert kms.count == 1


def test_a_key_file_is_followed_without_refreshing(tmp_path: Path) -> None:
    running = MasterKeyring.create(tmp_path / "key")
    MasterKeyring.add_current(tmp_path / "key")
    sealed = MasterKeyring.load(tmp_path / "key").seal(b"new", purpose="p", bound_to=[])
    assert running.open(sealed, purpose="p", bound_to=[], refresh=False) == b"new"


def test_a_command_that_failed_is_a_reason_to_look(
    kms: Kms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.keys.key_command.ASK_AGAIN_S", 0.0)
    kms.answer.write_text(lines_of(KEY))
    keyring = MasterKeyring.from_command(kms.argv)
    theirs = MasterKeyring([OTHER]).seal(b"text", purpose="p", bound_to=[])
    assert keyring.stale_reason is None
    kms.answer.unlink()
    with pytest.raises(SealError):
        keyring.open(theirs, purpose="p", bound_to=[])
    assert "exit status 7" in str(keyring.stale_reason)
    kms.answer.write_text(lines_of(KEY, OTHER))
    keyring.open(theirs, purpose="p", bound_to=[])
    assert keyring.stale_reason is None


@pytest.mark.parametrize(("mode", "good"), [(0o777, False), (0o1777, True), (0o755, True)])
def test_a_folder_that_others_may_write_to_is_refused(
    tmp_path: Path, mode: int, good: bool
) -> None:
    folder, link = tmp_path / "keys", tmp_path / "link"
    folder.mkdir()
    current = MasterKeyring.create(folder / "key").current
    link.symlink_to(folder / "key")
    folder.chmod(mode)
    for path in (folder / "key", link):
        if good:
            assert MasterKeyring.load(path).current == current
            continue
        with pytest.raises(SealError, match="chmod o-w"):
            MasterKeyring.load(path)
        with pytest.raises(SealError, match="chmod o-w"):
            MasterKeyring.add_current(path)
    if not good:
        with pytest.raises(SealError, match="chmod o-w"):
            MasterKeyring.create(folder / "new")
        assert not (folder / "new").exists()


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
