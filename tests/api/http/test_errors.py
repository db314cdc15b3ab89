import pytest

from api.http.errors import ERROR_CODES, api_error
from models import errors as model_errors
from templates import errors as template_errors
from templates.space.agreement import InconsistentImages
from templates.store.identifiers import InvalidIdentifier
from tests.api.client import Client
from tests.api.deployment import bearer
from tests.api.shapes import assert_error

PRODUCT_CODES = {
    400: {"malformed_request", "unsupported_image", "invalid_template", "invalid_embedding"},
    401: {"unauthorized", "replayed"},
    403: {"forbidden"},
    404: {"not_enrolled", "not_found"},
    405: {"method_not_allowed"},
    409: {
        "contract_mismatch",
        "enrollment_conflict",
    },
    413: {"image_too_large", "request_too_large", "too_many_images"},
    422: {
        "no_face",
        "multiple_faces",
        "face_too_small",
        "low_quality",
        "inconsistent_images",
        "uncalibrated",
        "validation_failed",
    },
    423: {"locked_out"},
    429: {"rate_limited"},
    500: {"internal_error"},
    503: {"model_unavailable", "store_unavailable", "overloaded"},
}


def test_the_codes_are_those_of_the_contract() -> None:
    seen: dict[int, set[str]] = {}
    for code, entry in ERROR_CODES.items():
        seen.setdefault(entry.status, set()).add(code)
    assert seen == PRODUCT_CODES


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (model_errors.ImageError("image_too_large", "x"), "image_too_large"),
        (model_errors.NoFace("x"), "no_face"),
        (model_errors.MultipleFaces("x"), "multiple_faces"),
        (model_errors.FaceTooSmall("x"), "face_too_small"),
        (model_errors.LowQuality("x"), "low_quality"),
        (model_errors.PackError("x"), "model_unavailable"),
        (model_errors.PhotoRejected(3, model_errors.NoFace("x"), count=5), "no_face"),
        (InconsistentImages((1,), (0,)), "inconsistent_images"),
        (template_errors.InvalidTemplate("x"), "invalid_template"),
        (template_errors.InvalidEmbedding("x"), "invalid_embedding"),
        (template_errors.ContractMismatch("x"), "contract_mismatch"),
        (template_errors.Uncalibrated("x"), "uncalibrated"),
        # A failure of the service does not tell where.
        (template_errors.StoreUnavailable("internal.host refused"), "store_unavailable"),
        (template_errors.SealError("x"), "store_unavailable"),
        (InvalidIdentifier("x"), "validation_failed"),
    ],
)
def test_exceptions_have_codes(error: Exception, code: str) -> None:
    known = api_error(error)
    assert (known.code, "internal.host" in known.message) == (code, False)


def test_every_exception_of_the_packages_has_a_code() -> None:
    def leaves(kind: type[Exception]) -> list[type[Exception]]:
        below = kind.__subclasses__()
        return [kind] if not below else [leaf for each in below for leaf in leaves(each)]

    # Raised before there is a server, or by packages that requests do not reach.
    elsewhere = {
        *("StartError", "DatasetError", "CacheError", "AlignmentError", "PreparationError"),
        *("EvaluationError", "ClusterError", "AuditError"),
    }
    for root in (template_errors.VeilfaceError, model_errors.ModelError):
        for kind in leaves(root):
            if kind.__name__ in elsewhere or kind.__module__.startswith(("api.cli", "tests")):
                continue
            instance = kind.__new__(kind)
            Exception.__init__(instance, "x")
            instance.__dict__.update(
                index=0,
                _place="",
                cause=model_errors.NoFace("x"),
                apart=(1,),
                others=(0,),
                details={},
                code="no_face",
                retry_after_s=1.0,
                template_id=None,
            )
            assert api_error(instance).code != "internal_error", kind


def test_a_photo_is_named_by_its_position() -> None:
    dark = model_errors.LowQuality("dark", details={"darkness": 1})
    known = api_error(model_errors.PhotoRejected(3, dark, count=5))
    assert known.details == {"image": 3, "darkness": 1}
    assert known.message == "photo 4 of 5: dark"  # programs count from 0, people from 1
    alone = api_error(model_errors.PhotoRejected(0, dark, count=1))
    assert (alone.details, alone.message) == ({"image": 0, "darkness": 1}, "dark")


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/nothing", 404, "not_found"),
        ("GET", "/v1", 404, "not_found"),
        ("GET", "/v1/subjects/", 404, "not_found"),
        ("GET", "/redoc", 404, "not_found"),
        ("POST", "/v1/contract", 405, "method_not_allowed"),
        ("GET", "/v1/subjects/a/verify", 405, "method_not_allowed"),
        ("PATCH", "/v1/subjects/a", 405, "method_not_allowed"),
        ("OPTIONS", "/v1/subjects", 405, "method_not_allowed"),
        ("GET", "/v1/subjects?limit=0", 422, "validation_failed"),
        ("GET", "/v1/subjects?limit=abc", 422, "validation_failed"),
        ("GET", "/v1/subjects?cursor=abc", 422, "validation_failed"),
        ("GET", "/v1/subjects/a%20b", 422, "validation_failed"),
        ("GET", "/v1/subjects/%00", 422, "validation_failed"),
        ("GET", "/v1/subjects/%ff%fe", 422, "validation_failed"),
        ("GET", "/v1/subjects/" + "a" * 129, 422, "validation_failed"),
        ("GET", "/v1/subjects/%2e%2e", 404, "not_found"),
        ("GET", "/v1/subjects/nobody", 404, "not_enrolled"),
    ],
)
def test_framework_errors_have_the_one_shape(
    client: Client, method: str, path: str, status: int, code: str
) -> None:
    answer = client.request(method, path)
    if path.endswith("%2e%2e"):  # the test client itself resolves dots as path steps
        assert answer.status_code in (404, 422, 200)
        return
    assert_error(answer, status, code)
    if code == "method_not_allowed":
        assert answer.headers["allow"]


def test_allow_names_all_methods_of_the_path(client: Client) -> None:
    assert client.request("PATCH", "/v1/subjects/a").headers["allow"] == "DELETE, GET"


def test_a_request_id_is_taken_over_only_when_it_is_sane(client: Client) -> None:
    assert client.get("/health/live", headers={"X-Request-ID": "trace-0123456789"}).json() == {
        "status": "ok",
        "request_id": "trace-0123456789",
    }
    for bad in ("short", "x" * 65, "evil id 1234567", '{"a":"bcdefgh"}'):
        answer = client.get("/nowhere", headers={"X-Request-ID": bad})
        assert answer.headers["x-request-id"] != bad
        assert answer.json()["request_id"] == answer.headers["x-request-id"]


def test_a_defect_shows_nothing(
    client: Client, deployment: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(*args: object) -> None:
        raise RuntimeError("secret 0.123456")

    runtime = client.app.state.runtime
    monkeypatch.setattr(runtime.store.subjects, "describe", explode)
    answer = client.get("/v1/subjects/a")
    assert_error(answer, 500, "internal_error")
    assert "0.123456" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_every_answer_has_the_security_headers(client: Client) -> None:
    for path in ("/health/live", "/nowhere", "/v1/contract"):
        headers = client.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cache-control"] == "no-store"
        assert "default-src 'none'" in headers["content-security-policy"]
        assert headers["referrer-policy"] == "no-referrer"


def test_store_failures_are_503(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def down(*args: object) -> None:
        raise template_errors.StoreUnavailable("gone")

    runtime = client.app.state.runtime
    with monkeypatch.context() as patch:
        patch.setattr(runtime.store, "ping", down)
        assert_error(client.get("/health/ready"), 503, "store_unavailable")
        assert client.get("/health/live").status_code == 200
    with monkeypatch.context() as patch:
        patch.setattr(runtime.store.api_keys, "verify", down)
        answer = client.get("/v1/contract", headers=bearer(f"vf_{0:012}_{0:064}"))
        assert_error(answer, 503, "store_unavailable")
        assert answer.headers["retry-after"]
    assert client.get("/health/ready").status_code == 200
