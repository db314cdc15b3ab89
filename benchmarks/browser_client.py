"""The JavaScript client in Chromium, beside the Python private client; and what left the browser.

A service serves its pack (``serve_pack``). A page of its own origin holds tokens, one for each
attempt, and enrolls photos 1-3 of every person by templates that it lifts itself; photos 4-5 are
lifted once each and verified against the person (genuine) and all others (impostor). The Python
private client then does the same with the same photos. An enrollment that is refused counts as
failed genuine attempts. Every byte that the browser sends goes through a recording proxy, no other
host has an address for it, and the recording is searched for photos and descriptors; those that
are sent on purpose afterwards must be found. Last, every person stands before a fake camera, and
``<veilface-login>`` is timed from the click to its answer.

Needs Chromium and the built client (``make javascript``).

Example
-------
::

    python -m benchmarks.browser_client --data ../shared/data --work browser-client-run
"""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from playwright.sync_api import BrowserContext, Page, sync_playwright

from benchmarks.deployment import VEILFACE, service
from benchmarks.end_to_end import (
    AttemptCounts,
    Person,
    impostor_attempts,
    people_of,
)
from benchmarks.private_client import (
    command_line,
    fresh_database,
    key_of,
    prepared,
    private_outcome,
)
from models.decoding import decode_image
from models.errors import FaceError
from models.pack import FacePolicy, ModelPack
from tests.leaks import LeakSearch
from tests.patience import PATIENCE_S
from tests.web.camera import FakeCamera
from tests.web.client_page import Application, application, for_browsers
from tests.web.conftest import installed_browser
from veilface_client import Client, PrivateClient

PROGRAM = Path(__file__).with_suffix(".js")
ONLY_HERE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
PHOTO_FORMS = (
    "photo",
    "half of a photo",
    "base64 of a photo",
    "decoded pixels",
    "aligned crop",
)
DESCRIPTOR_FORMS = ("float32", "float64", "base64 of float32", "decimal text")
_REQUEST = re.compile(rb"(GET|POST|PUT) (/\S*) HTTP/1\.1\r\n(.*?)\r\n\r\n", re.DOTALL)
_NAMED = re.compile(rb"^(/v1/subjects/|/v1/pack/|/photos/)[^/]+|^(/client/|/ort/).+")
_LENGTH = re.compile(rb"^content-length: (\d+)", re.IGNORECASE | re.MULTILINE)


@dataclass
class Visit:
    """A page that is open, whose program is called from here."""

    page: Page
    application: Application

    def call(self, name: str, *arguments: object) -> Any:
        """Call a function of the page's program."""
        return self.page.evaluate(
            "([name, given]) => window.visit[name](...given)", [name, arguments]
        )

    def show(self, photos: Sequence[Path]) -> list[str]:
        """Let the page have these photos; the names under which it does."""
        names = [photo.name for photo in photos]
        for photo in photos:
            self.application.photos[photo.name] = photo.read_bytes()
        return names


@contextmanager
def page_of(url: str, key: str, *, level: str) -> Iterator[Application]:
    """Serve the page, whose tokens are of this key and this level."""
    with Client(url, key) as client:

        def authorize(asked: Mapping[str, str]) -> dict[str, str]:
            verifies = asked["action"] == "verify"
            issued = client.create_token(
                asked["subject"],
                "verify" if verifies else "enroll",
                level=level if verifies else None,
            )
            return {"subject": asked["subject"], "token": issued.token}

        with application(url, authorize) as served:
            served.program = for_browsers(PROGRAM.read_text(encoding="utf-8"))
            yield served


def visit(context: BrowserContext, served: Application) -> Visit:
    """Open the page in a tab."""
    page = context.new_page()
    page.set_default_timeout(1000 * PATIENCE_S)
    page.goto(served.url + "/")
    page.wait_for_function("() => window.visit !== undefined")
    return Visit(page, served)


def browser_outcome(
    opened: Visit, people: Sequence[Person], *, impostors: int
) -> tuple[AttemptCounts, list[float]]:
    """Enroll and verify everybody in the browser; also the seconds from each photo to its answer.

    The page must be prepared. Attempts are those of
    :func:`benchmarks.private_client.private_outcome`.
    """
    counts = AttemptCounts()
    seconds: list[float] = []
    lifted: set[str] = set()

    def accepted(answer: dict[str, Any]) -> bool:
        if "error" in answer:
            counts.other_answers[answer["error"]] += 1
            return False
        return answer["accepted"] is True

    for person in people:
        answer = opened.call("enroll", person.name, opened.show(person.enroll))
        if "error" in answer:
            counts.refused_enrollments[person.name] = answer["error"]
    for person in people:
        for name in opened.show(person.probes):
            answer = opened.call("verify", person.name, name)
            counts.genuine += 1
            counts.genuine_rejected += not accepted(answer)
            if "accepted" in answer:
                seconds.append(answer["seconds"])
                lifted.add(name)
    there = [person for person in people if person.name not in counts.refused_enrollments]
    for person, (photo,) in impostor_attempts(there, impostors):
        counts.impostor += 1
        # A photo that was not lifted for its own person is lifted for nobody.
        if photo.name in lifted:
            counts.impostor_accepted += accepted(opened.call("attempt", person.name, photo.name))
        else:
            counts.other_answers["not lifted"] += 1
    return counts, seconds


def before_the_camera(
    opened: Visit, camera: FakeCamera, people: Sequence[Person]
) -> list[dict[str, Any]]:
    """Log everybody in by the element, one after the other; what it told, and after how long.

    Whoever waited for the graphs too logs in once more, and only that counts.
    """
    answers = []
    loaded = False
    for person in people:
        for counts in (True,) if loaded else (False, True):
            answer = _log_in(opened, camera, person)
            if counts:
                answers.append(answer)
            loaded = answer["error"] is None
            if not loaded:
                # The camera stays on after an error: it would show this person for the next.
                opened.call("leave")
    return answers


def _log_in(opened: Visit, camera: FakeCamera, person: Person) -> dict[str, Any]:
    camera.shows(person.probes[0])
    opened.call("meet", person.name)
    before = len(opened.call("seen"))
    opened.page.get_by_role("button", name="Start camera").click()
    opened.page.get_by_role("button", name="Log in").click()
    opened.page.wait_for_function(f"() => window.visit.seen().length > {before}")
    answer: dict[str, Any] = opened.call("seen")[-1]
    return answer


def faces_of(pack: ModelPack, people: Sequence[Person]) -> LeakSearch:
    """What must not be found: files, pixels, crops and descriptors of all photos."""
    vectors: dict[str, Any] = {}
    strings: dict[str, bytes] = {}
    for person in people:
        rows = []
        for photo in (*person.enroll, *person.probes):
            data = photo.read_bytes()
            strings[f"photo {photo.name}"] = data
            pixels = decode_image(data)
            strings[f"pixels {photo.name}"] = pixels.tobytes()
            opaque = np.full((*pixels.shape[:2], 1), 255, dtype=np.uint8)
            strings[f"pixels with alpha {photo.name}"] = np.dstack([pixels, opaque]).tobytes()
            try:
                taken = pack.crop_photo(data, policy=FacePolicy.LARGEST)
            except FaceError:
                continue
            strings[f"crop {photo.name}"] = taken.crop.tobytes()
            row = pack.embed(taken.crop[None])[0]
            vectors[f"descriptor {photo.name}"] = row
            rows.append(row)
        mean = np.mean(rows[: len(person.enroll)], axis=0)
        vectors[f"mean of {person.name}"] = mean
        vectors[f"unit mean of {person.name}"] = mean / np.linalg.norm(mean)
    return LeakSearch(vectors=vectors, strings=strings)


def planted_and_missed(opened: Visit, photo: Path, search: LeakSearch) -> list[str]:
    """Send this photo and its descriptor in every form; those that the search did not find."""
    (name,) = opened.show([photo])
    missed = []
    for form in (*PHOTO_FORMS, *DESCRIPTOR_FORMS):
        opened.application.recording.forget()
        opened.call("plant", form, name)
        kind = "descriptor " if form in DESCRIPTOR_FORMS else ("photo ", "pixels ", "crop ")
        found = search.find(opened.application.recording.sent)
        if not any(leak.what.startswith(kind) and leak.what.endswith(name) for leak in found):
            missed.append(form)
    return missed


def requests_in(recording: bytes) -> dict[str, dict[str, object]]:
    """Count requests by what they ask for, with the members and bytes of their bodies."""
    bodies: dict[str, list[bytes]] = {}
    for head in _REQUEST.finditer(recording):
        path = _NAMED.sub(rb"\1\2*", head[2])
        length = _LENGTH.search(head[3])
        body = recording[head.end() : head.end() + int(length[1])] if length else b""
        bodies.setdefault(f"{head[1].decode()} {path.decode()}", []).append(body)
    return {
        call: {
            "times": len(each),
            "members": sorted({name for body in each if body for name in json.loads(body)}),
            "bytes_of_a_body_at_most": max(map(len, each)),
        }
        for call, each in sorted(bodies.items())
    }


@contextmanager
def chromium(folder: Path, camera: FakeCamera) -> Iterator[BrowserContext]:
    """Start the system's browser with a profile of its own, whose cache is on the disk."""
    executable = installed_browser()
    if executable is None:
        raise SystemExit("there is no Chromium: name one in VEILFACE_TEST_BROWSER")
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            folder,
            executable_path=executable,
            # Chromium refuses to be root inside its own sandbox; the page it visits is ours.
            args=["--no-sandbox", ONLY_HERE, *camera.flags],
        )
        try:
            yield context
        finally:
            context.close()


def main() -> None:
    """Run both clients and print their figures as JSON."""
    parser = command_line(__doc__.splitlines()[0])
    parser.add_argument("--people", type=int, default=20)
    args = parser.parse_args()
    env = prepared(args) | {"VEILFACE_PACK": str(args.pack), "VEILFACE_SERVE_PACK": "true"}
    people = people_of(args.data / "lfw" / "photos")[: args.people]
    impostors = len(people) - 1
    search = faces_of(ModelPack.load(args.pack, threads=1), people)

    with ExitStack() as stack:
        env["VEILFACE_DATABASE_URL"] = fresh_database(stack, args.work / "browser")
        address = stack.enter_context(service(env, workers=1, log=args.work / "browser.log"))
        key = key_of(env)
        served = stack.enter_context(page_of(address, key, level=args.level))
        camera = FakeCamera(args.work / "camera.mjpeg")
        profile = args.work / "profile"
        shutil.rmtree(profile, ignore_errors=True)
        context = stack.enter_context(chromium(profile, camera))
        asked: set[str] = set()
        context.on("request", lambda request: asked.add(request.url.split("/", 3)[2]))
        load_before = os.getloadavg()[0]
        first = visit(context, served)
        downloaded = [first.call("prepare")]
        first.page.close()
        opened = visit(context, served)
        downloaded.append(opened.call("prepare"))
        browser, seconds = browser_outcome(opened, people, impostors=impostors)
        by_camera = before_the_camera(
            opened, camera, [p for p in people if p.name not in browser.refused_enrollments]
        )
        load_after = os.getloadavg()[0]
        sent = served.recording.sent
        leaks = search.find(sent)
        missed = planted_and_missed(opened, people[0].probes[0], search)
        strangers = sorted(asked - {served.url.removeprefix("http://")})
        with PrivateClient(
            address, key, pack=args.pack, command=VEILFACE, dim=args.probe_dim
        ) as client:
            python, _ = private_outcome(
                client, people, level=args.level, impostors=impostors, at_once=1
            )

    answered = [each for each in by_camera if each["error"] is None]
    report = {
        "pack": args.pack.name,
        "strategy": args.strategy,
        "m": args.dim,
        "probe_m": args.probe_dim,
        "level": args.level,
        "people": len(people),
        "javascript_client_in_chromium": browser.summary(),
        "python_private_client": python.summary(),
        "visits": [
            {"bytes_downloaded": each["bytes"], "seconds_until_ready": round(each["seconds"], 2)}
            for each in downloaded
        ],
        "photo_to_answer": _seconds(seconds),
        "click_to_answer_by_the_element": {
            **_seconds([each["seconds"] for each in answered]),
            "accepted": sum(each["accepted"] for each in answered),
            "errors": [each["error"] for each in by_camera if each["error"] is not None],
        },
        "load_average_before_and_after": [round(load_before, 1), round(load_after, 1)],
        "sent": {
            "bytes": len(sent),
            "requests": requests_in(sent),
            "other_hosts": strangers,
            "leaks": [f"{leak.what}: {leak.form}" for leak in leaks],
            "planted_forms": len(PHOTO_FORMS) + len(DESCRIPTOR_FORMS),
            "planted_and_missed": missed,
        },
    }
    print(json.dumps(report, indent=2))


def _seconds(seconds: Sequence[float]) -> dict[str, object]:
    return {
        "times": len(seconds),
        "median_s": round(median(seconds), 2),
        "longest_s": round(max(seconds), 2),
    }


if __name__ == "__main__":
    main()
