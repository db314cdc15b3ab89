"""What a browser sent, as a proxy recorded it: its requests, and the faces that are not in it."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from models.decoding import decode_image
from models.errors import FaceError
from models.pack import ModelPack
from models.selection import FacePolicy
from tests.leaks import LeakSearch

_REQUEST = re.compile(rb"([A-Z]+) (/\S*) HTTP/1\.1\r\n(.*?)\r\n\r\n", re.DOTALL)
_NAMED = re.compile(rb"^(/v1/subjects/|/v1/pack/|/photos/)[^/]+|^(/client/|/ort/).+")
_LENGTH = re.compile(rb"^content-length: (\d+)", re.IGNORECASE | re.MULTILINE)


def faces_of(
    pack: ModelPack,
    people: Mapping[str, Sequence[Path]],
    more: Mapping[str, bytes] = MappingProxyType({}),
) -> LeakSearch:
    """What must not be found: files, pixels, crops, embeddings and their mean for each person.

    ``more`` are photos that belong to no mean.
    """
    photos = {photo.name: photo.read_bytes() for each in people.values() for photo in each}
    vectors: dict[str, Any] = {}
    strings: dict[str, bytes] = {}
    for name, data in {**photos, **more}.items():
        pixels = decode_image(data)
        opaque = np.full((*pixels.shape[:2], 1), 255, dtype=np.uint8)
        strings[f"photo {name}"] = data
        strings[f"pixels {name}"] = pixels.tobytes()
        strings[f"pixels with alpha {name}"] = np.dstack([pixels, opaque]).tobytes()
        try:
            crop = pack.crop_photo(data, policy=FacePolicy.LARGEST).crop
        except FaceError:
            continue
        strings[f"crop {name}"] = crop.tobytes()
        vectors[f"embedding {name}"] = pack.embed(crop[None])[0]
    for person, each in people.items():
        names = [f"embedding {photo.name}" for photo in each]
        embeddings = [vectors[name] for name in names if name in vectors]
        if embeddings:
            mean = np.mean(embeddings, axis=0)
            vectors[f"mean of {person}"] = mean
            vectors[f"unit mean of {person}"] = mean / np.linalg.norm(mean)
    return LeakSearch(vectors=vectors, strings=strings)


def requests_in(recording: bytes) -> tuple[dict[str, dict[str, object]], int]:
    """Count requests by what they ask for, with the members and bytes of their bodies.

    Also returns how many bytes are part of no request; the proxy's line ends between connections
    are none of the browser's.
    """
    bodies: dict[str, list[bytes]] = {}
    rest = end = 0
    for head in _REQUEST.finditer(recording):
        path = _NAMED.sub(rb"\1\2*", head[2])
        length = _LENGTH.search(head[3])
        body = recording[head.end() : head.end() + int(length[1])] if length else b""
        bodies.setdefault(f"{head[1].decode()} {path.decode()}", []).append(body)
        rest += len(recording[end : head.start()].strip(b"\n"))
        end = head.end() + len(body)
    rest += len(recording[end:].strip(b"\n"))
    calls: dict[str, dict[str, object]] = {
        call: {
            "times": len(each),
            "members": sorted({name for body in each if body for name in json.loads(body)}),
            "bytes_of_a_body_at_most": max(map(len, each)),
        }
        for call, each in sorted(bodies.items())
    }
    return calls, rest
