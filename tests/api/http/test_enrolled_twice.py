"""What the same photos, enrolled twice by the service, give to who opens both templates."""

import os
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from attacks.stored.several_templates import nearest_common_points
from models.pack import ModelPack
from templates.contract import wire
from templates.keys.holder_key import encode_holder_key
from templates.keys.rotation import holder_rotation
from templates.space.agreement import mean_embedding
from templates.space.subspace import SubspaceBatch
from tests.api.client import Client
from tests.api.deployment import AXES, Deployment, M, images, photo

PEOPLE = range(30, 42)
KEY, OTHER = os.urandom(32), os.urandom(32)


def photos_of(person: int) -> list[bytes]:
    return [photo(person, shot) for shot in range(3)]


def stolen(
    client: Client, subject: str, photos: Sequence[bytes], key: bytes | None
) -> SubspaceBatch:
    """Enroll, read what is stored, and undo its rotations: every key is the thief's."""
    answer = client.put(
        f"/v1/subjects/{subject}/enrollment",
        files=images(*photos),
        data={} if key is None else {"holder_key": encode_holder_key(key)},
    )
    assert answer.status_code in (200, 201)
    template, in_rotation = client.app.state.runtime.read("default", subject)
    rotation = in_rotation.rotation.of(template.template_id)
    opened = wire.decode(template.wire).subspace.turned_by(rotation.turned_back)
    if key is None:
        return opened
    return opened.turned_by(holder_rotation(key, template.holder_salt, AXES).turned_back)


@pytest.fixture(scope="module")
def descriptors(deployment: Deployment) -> NDArray[np.float64]:
    assert deployment.settings.pack is not None
    pack = ModelPack.load(deployment.settings.pack, threads=1)
    samples = [pack.embed_photos(photos_of(person)) for person in PEOPLE]
    rows = [np.stack([one.embedding for one in of_person]) for of_person in samples]
    means = np.stack([mean_embedding(of_person, consistency=-1.0) for of_person in rows])
    return deployment.source.project(means).astype(np.float64)


@pytest.mark.parametrize(
    ("names", "keys", "one_set"),
    [
        (("{}", "{}"), (None, None), True),
        (("one {}", "another {}"), (None, None), True),
        # A key may have been lost, and another one made.
        (("{} with a key", "{} with a key"), (KEY, OTHER), True),
        # The control: of who keeps a key two names have two lifts, which meet in the descriptor.
        (("{} at work", "{} at home"), (KEY, KEY), False),
    ],
)
def test_both_templates_are_one_set_and_tell_what_one_tells(
    client: Client,
    descriptors: NDArray[np.float64],
    names: tuple[str, str],
    keys: tuple[bytes | None, bytes | None],
    one_set: bool,
) -> None:
    first, again = (
        SubspaceBatch.of(
            [
                stolen(client, name.format(person).replace(" ", "-"), photos[::order], key)
                for person, photos in zip(PEOPLE, map(photos_of, PEOPLE), strict=True)
            ]
        )
        for name, key, order in zip(names, keys, (1, -1), strict=True)
    )
    for one, other in zip(first, again, strict=True):
        rows = np.vstack([one.foot, one.basis, other.foot, other.basis]).astype(np.float64)
        spanned = int(np.count_nonzero(np.linalg.svd(rows, compute_uv=False) > 0.05))
        assert spanned == (M + 1 if one_set else 2 * M + 1)
    # The strongest guess from two lifts of one descriptor; of one set it is any point.
    guesses = nearest_common_points([first, again])
    cosines = np.einsum("ij,ij->i", guesses, descriptors)
    if one_set:
        assert cosines.mean() < 0.6
    else:
        assert cosines.min() > 0.95
