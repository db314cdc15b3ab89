"""The JavaScript client in Chromium, beside the Python private client; and what left the browser.

A service serves its pack (``serve_pack``). A page of its own origin holds tokens, one for each
attempt, and enrolls photos 1-3 of every person by templates that it lifts itself; photos 4-5 are
lifted once each and verified against the person (genuine) and all others (impostor). The Python
private client then does the same with the same photos. An enrollment that is refused counts as
failed genuine attempts. Then every person stands before a fake camera, and ``<veilface-login>``,
which the service's own page has in private mode too, is timed from the click to its answer. Every
byte that the browser sends goes through a recording proxy, no other host has an address for it, and
the recording is searched for the photos, what the camera showed, and their embeddings; those that
are sent on purpose afterwards must be found.

Needs Chromium and the built client (``make javascript``).
"""

import argparse
import base64
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from playwright.sync_api import BrowserContext, expect, sync_playwright

from benchmarks import deployment
from benchmarks.people import AttemptCounts, Person, attempt_all, impostor_attempts, people_of
from models.pack import ModelPack
from tests.clients.recorded import faces_of, requests_in
from tests.leaks import LeakSearch
from tests.patience import PATIENCE_S
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.client_page import Application, application, for_browsers
from tests.web.conftest import installed_browser
from veilface_client import Client, PrivateClient

PROGRAM = Path(__file__).with_suffix(".js")
ONLY_HERE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
PLANTED = {
    "photo": ("photo", "bytes"),
    "half of a photo": ("photo", "bytes"),
    "base64 of a photo": ("photo", "base64"),
    "decoded pixels": ("pixels", "bytes"),
    "aligned crop": ("crop", "bytes"),
    "float32": ("embedding", "float32"),
    "float64": ("embedding", "float64"),
    "base64 of float32": ("embedding", "base64"),
    "decimal text": ("embedding", "decimals"),
}
"""What is sent on purpose: what must be found of it, and how the form of the leak begins."""


@dataclass
class Visit:
    """A page that is open, whose program is called from here."""

    tab: BrowserTab
    application: Application

    def call(self, name: str, *arguments: object) -> Any:
        """Call a function of the page's program."""
        return self.tab.page.evaluate(
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

        def authorize(wish: Mapping[str, str]) -> dict[str, str]:
            verifies = wish["action"] == "verify"
            issued = client.create_token(
                wish["subject"],
                "verify" if verifies else "enroll",
                level=level if verifies else None,
            )
            return {"subject": wish["subject"], "token": issued.token}

        with application(url, authorize) as served:
            served.program = for_browsers(PROGRAM.read_text(encoding="utf-8"))
            yield served


def visit(context: BrowserContext, served: Application) -> Visit:
    """Open the page in a tab."""
    tab = BrowserTab.of(context, served.url + "/")
    tab.page.set_default_timeout(1000 * PATIENCE_S)
    tab.page.goto(tab.url)
    tab.wait_for("() => window.visit !== undefined")
    return Visit(tab, served)


def browser_outcome(
    opened: Visit, people: Sequence[Person], *, impostors: int
) -> tuple[AttemptCounts, list[float]]:
    """Enroll and verify everybody in the browser; also the seconds from each photo to its answer.

    The page must be prepared. Attempts are those of :func:`benchmarks.people.attempt_all`.
    """
    counts = AttemptCounts()
    seconds: list[float] = []

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
            counts.add(accepted(answer), genuine=True)
            if "accepted" in answer:
                seconds.append(answer["seconds"])
    there = [person for person in people if person.name not in counts.refused_enrollments]
    for person, (photo,) in impostor_attempts(there, impostors):
        counts.add(accepted(opened.call("attempt", person.name, photo.name)), genuine=False)
    return counts, seconds


def before_the_camera(
    opened: Visit, camera: FakeCamera, people: Sequence[Person]
) -> tuple[list[dict[str, Any]], dict[str, bytes]]:
    """Log everybody in by the element, one after the other.

    Returns what it told each, and after how long; and by names what the browser saw of them, as
    PNG. Whoever waited for the graphs too logs in once more, and only that counts.
    """
    answers = []
    shown = {}
    loaded = False
    for person in people:
        camera.shows(person.probes[0])
        answer, shown[f"camera of {person.name}"] = _log_in(opened, person)
        if answer["error"] is None and not loaded:
            answer, _ = _log_in(opened, person)
        answers.append(answer)
        loaded = answer["error"] is None
        if not loaded:
            # The camera stays on after an error: it would show this person for the next.
            opened.call("leave")
    return answers, shown


def _log_in(opened: Visit, person: Person) -> tuple[dict[str, Any], bytes]:
    opened.call("meet", person.name)
    before = len(opened.call("seen"))
    opened.tab.page.get_by_role("button", name="Start camera").click()
    button = opened.tab.page.get_by_role("button", name="Log in")
    button.wait_for()
    frame = base64.b64decode(opened.call("frame"))
    button.click()
    opened.tab.wait_for("(before) => window.visit.seen().length > before", before)
    answer: dict[str, Any] = opened.call("seen")[-1]
    return answer, frame


def planted_and_missed(opened: Visit, photo: Path, search: LeakSearch) -> list[str]:
    """Send this photo and its embedding in every form; those that the search did not find."""
    (name,) = opened.show([photo])
    missed = []
    for planted, (kind, form) in PLANTED.items():
        opened.application.recording.forget()
        opened.call("plant", planted, name)
        leaks = search.find(opened.application.recording.sent)
        if not any(leak.what == f"{kind} {name}" and leak.form.startswith(form) for leak in leaks):
            missed.append(planted)
    return missed


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


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    deployment.add_options(parser)
    parser.add_argument("--people", type=int, default=20)


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return a row for each client, for each time and for what was sent."""
    people = people_of(args.data / "lfw" / "photos")[: args.people]
    expect.set_options(timeout=1000 * PATIENCE_S)
    impostors = len(people) - 1
    with ExitStack() as stack:
        service = stack.enter_context(deployment.running(args, serve_pack="true"))
        pack = ModelPack.load(args.pack, threads=1)
        key, level = service.token, args.level
        served = stack.enter_context(page_of(service.url, key, level=level))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        camera = FakeCamera(folder / "camera.mjpeg")
        context = stack.enter_context(chromium(folder / "profile", camera))
        first = visit(context, served)
        downloaded = [first.call("prepare")]
        first.tab.page.close()
        opened = visit(context, served)
        downloaded.append(opened.call("prepare"))
        browser, seconds = browser_outcome(opened, people, impostors=impostors)
        there = [each for each in people if each.name not in browser.refused_enrollments]
        by_camera, shown = before_the_camera(opened, camera, there)
        sent = served.recording.sent
        calls, rest = requests_in(sent)
        more = {photo.name: photo.read_bytes() for person in people for photo in person.probes}
        enrolled = {person.name: person.enroll for person in people}
        search = faces_of(pack, enrolled, {**more, **shown})
        leaks = search.find(sent)
        missed = planted_and_missed(opened, people[0].probes[0], search)
        tabs = [first.tab, opened.tab]
        complaints = [complaint for tab in tabs for complaint in tab.complaints]
        complaints += opened.tab.violations()
        # Each tab has noted every request of the browser.
        here = (served.url, "blob:", "data:")
        strays = sorted({each for each in first.tab.requests if not each.startswith(here)})
        with PrivateClient(service.url, key, pack=args.pack, dim=args.probe_dim) as client:
            python = attempt_all(client, people, level=level, face="largest", impostors=impostors)

    def counts(outcome: AttemptCounts) -> str:
        return ", ".join(f"{name} {value}" for name, value in outcome.row().items())

    visits = [f"{each['bytes']:,} bytes in {each['seconds']:.2f} s" for each in downloaded]
    figures: dict[str, object] = {
        "JavaScript client in Chromium": counts(browser),
        "Python private client": counts(python),
        "until a lift can be made, first and second visit": "; ".join(visits),
        "photo to answer": _seconds(seconds),
        "click to answer, `<veilface-login>`": _answered(by_camera),
        "sent": f"{len(sent):,} bytes; {rest} of no request; to other hosts: {strays or 'none'}",
        **{
            f"sent by {call}": f"{each['times']} times, {each['members']}, at most "
            f"{each['bytes_of_a_body_at_most']} bytes"
            for call, each in calls.items()
        },
        "leaks": [f"{leak.what}: {leak.form}" for leak in leaks] or "none",
        "sent on purpose and not found": missed or f"none of {len(PLANTED)}",
        "complaints of the browser": complaints or "none",
    }
    rows: list[dict[str, object]] = [{"": name, "seen": value} for name, value in figures.items()]
    rows.append({"": "nothing of a face left", "verdict": "FAIL" if leaks or missed else "PASS"})
    return rows


def _answered(answers: Sequence[Mapping[str, Any]]) -> str:
    answered = [each for each in answers if each["error"] is None]
    errors = [each["error"] for each in answers if each["error"] is not None]
    accepted = sum(each["accepted"] for each in answered)
    times = _seconds([each["seconds"] for each in answered])
    return f"{times}, accepted {accepted}, errors: {errors or 'none'}"


def _seconds(seconds: Sequence[float]) -> str:
    if not seconds:
        return "never"
    return f"{median(seconds):.2f} s (median of {len(seconds)}), at most {max(seconds):.2f} s"
