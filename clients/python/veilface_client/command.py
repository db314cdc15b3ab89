"""``veilface-client``: enroll and verify from a shell, over the service.

The API key comes from the environment, never from an option: other users of a machine see those.
"""

import argparse
import asyncio
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import httpx

from veilface_client import __version__, results
from veilface_client.async_client import AsyncClient
from veilface_client.errors import VeilfaceError

KEY, URL = "VEILFACE_API_KEY", "VEILFACE_URL"
ACCEPTED, REJECTED, USAGE, FAILED = 0, 1, 2, 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status.

    0: enrolled or accepted; 1: rejected; 2: wrong usage; 3: failed, and stderr says why;
    where the answer was lost, also that it may have been done.
    """
    parser = _parser()
    asked = parser.parse_args(arguments)
    token = os.environ.get(KEY)
    if not token:
        parser.error(f"the API key is missing: set the environment variable {KEY}")
    if not asked.url:
        parser.error(f"the service is missing: give --url, or set {URL}")
    limits = httpx.Timeout(asked.timeout, connect=5.0)
    try:
        client = AsyncClient(asked.url, token, timeout=limits)
    except ValueError as error:
        parser.error(str(error))
    try:
        answer = asyncio.run(_answer(client, asked))
    except TimeoutError:
        return _failed(
            f"no answer within {asked.timeout:g} s; the service may have done what was asked"
        )
    except FileNotFoundError as error:
        parser.error(f"no such photo: {error.filename}")
    except OSError as error:
        return _failed(f"{error.filename}: {error.strerror}")
    except (VeilfaceError, ValueError) as error:
        return _failed(str(error))
    if asked.json:
        # What the service kept to itself, and a template that was not asked for, are left out.
        text = json.dumps(answer.model_dump(mode="json", exclude_none=True))
    else:
        text = _sentence(asked.subject, answer)
    try:
        print(text, flush=True)  # noqa: T201
    except BrokenPipeError:
        # The reader has gone, and the exit status answers too. Python would write again at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return REJECTED if isinstance(answer, results.Decision) and not answer else ACCEPTED


async def _answer(
    client: AsyncClient, asked: argparse.Namespace
) -> results.Enrollment | results.Decision:
    """Ask the service; the time limit holds for all of it, however slowly bytes come."""
    async with asyncio.timeout(asked.timeout), client:
        if asked.command == "enroll":
            return await client.enroll(asked.subject, asked.photos, replace=asked.replace)
        return await client.verify(asked.subject, asked.photos, level=asked.level)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="veilface-client",
        description="Enroll and verify people by photos, over a Veilface service.",
        epilog=f"The API key is read from the environment variable {KEY}. Exit status: 0 enrolled "
        "or accepted, 1 rejected, 2 wrong usage, 3 failed; stderr says why, and "
        "where the answer was lost that it may have been done.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("subject", help="id of the person")
    common.add_argument("photos", nargs="+", type=Path, metavar="PHOTO")
    common.add_argument("--url", default=os.environ.get(URL), help=f"the service; default: {URL}")
    common.add_argument("--json", action="store_true", help="print the answer as JSON")
    common.add_argument(
        "--timeout",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="for the whole answer; default 60",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    enroll = commands.add_parser(
        "enroll", parents=[common], help="enroll a person by 1 to 10 photos"
    )
    may_replace = enroll.add_mutually_exclusive_group()
    may_replace.add_argument(
        "--no-replace",
        dest="replace",
        action="store_const",
        const=False,
        default=True,
        help="refuse a person who is enrolled already",
    )
    may_replace.add_argument(
        "--replace", metavar="TEMPLATE_ID", help="replace the enrollment with this template id only"
    )
    verify = commands.add_parser(
        "verify", parents=[common], help="check whether 1 to 5 photos show a person"
    )
    verify.add_argument("--level", help="security level; default: the contract's")
    return parser


def _sentence(subject: str, answer: results.Enrollment | results.Decision) -> str:
    if isinstance(answer, results.Decision):
        return f"{answer.decision}: {subject}, level {answer.level}"
    done = "Replaced the enrollment of" if answer.replaced else "Enrolled"
    return f"{done} {subject} from {len(answer.images)} photos; template {answer.template_id}."


def _failed(reason: str) -> int:
    print(f"error: {reason}", file=sys.stderr)  # noqa: T201
    return FAILED
