"""Heads that turn and sheets that are held, in space: which meet a challenge, and why not."""

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest

from models.head_pose import HeadPose, head_pose
from tests.heads import POSES, head, performed, photo
from verify.challenge import (
    MOVEMENTS,
    LivenessFailure,
    Movement,
    draw_movements,
    movements_failure,
)

ORDERS = list(itertools.permutations(Movement, MOVEMENTS))
ASKED = (Movement.TURN_LEFT, Movement.LOOK_UP, Movement.COME_CLOSER)


def of_head(names: Sequence[str], *, noise: float = 0.0, seed: int = 0) -> list[HeadPose]:
    rng = np.random.default_rng(seed)
    return [head_pose(head(**POSES[name]) + noise * rng.normal(size=(5, 2))) for name in names]


@pytest.mark.parametrize("asked", ORDERS, ids=" ".join)
def test_who_does_as_told_passes_and_nobody_else_does(asked: tuple[Movement, ...]) -> None:
    poses = of_head(performed(asked))
    assert movements_failure(poses, asked) is None
    # An answer to an earlier challenge: of 60 orders it fits its own.
    assert [order for order in ORDERS if movements_failure(poses, order) is None] == [asked]


def staying_near(asked: Sequence[Movement], *, near: float) -> list[HeadPose]:
    """Of a person who does as told and stays where coming closer has brought them."""
    poses, distance = [], 500.0
    for name in performed(asked):
        distance = near if name == Movement.COME_CLOSER else distance
        poses.append(head_pose(head(**{**POSES[name], "distance": distance})))
    return poses


@pytest.mark.parametrize("asked", ORDERS, ids=" ".join)
def test_who_stays_near_passes_as_who_moves_back(asked: tuple[Movement, ...]) -> None:
    for near in (390.0, 350.0, 310.0):
        poses = staying_near(asked, near=near)
        assert [order for order in ORDERS if movements_failure(poses, order) is None] == [asked]


def test_a_detectors_noise_changes_nothing() -> None:
    # 1.5 pixels, of eyes that are 100 apart.
    for seed in range(20):
        poses = of_head(performed(ASKED), noise=1.5, seed=seed)
        assert movements_failure(poses, ASKED) is None


@pytest.mark.parametrize("of", [{}, {"yaw": 15.0}, {"pitch": -10.0}], ids=str)
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_a_photo_turned_by_the_same_angles_fails(of: dict[str, float], factor: float) -> None:
    for asked in ORDERS:
        frames = []
        for name in performed(asked):
            pose = {key: value * factor for key, value in POSES[name].items() if key != "distance"}
            distance = POSES[name].get("distance", 500.0)
            frames.append(head_pose(photo(of=of, **{"distance": distance, **pose})))
        assert movements_failure(frames, asked) is LivenessFailure.NO_TURN


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["front", "look_up", "front", "turn_left", "come_closer"], LivenessFailure.WRONG_ORDER),
        # One movement too many, though all that was asked is there in its order.
        (
            ["front", "turn_left", "front", "look_down", "look_up", "come_closer"],
            LivenessFailure.WRONG_ORDER,
        ),
        (
            ["front", "turn_left", "look_up", "turn_left", "come_closer"],
            LivenessFailure.WRONG_ORDER,
        ),
        (["front", "turn_left", "front", "look_up", "front"], LivenessFailure.MISSING_MOVEMENT),
        (["front", "turn_right", "front", "look_up", "come_closer"], "missing_movement"),
        (["front"] * 5, LivenessFailure.NO_TURN),
        (["front", "come_closer", "front", "come_closer", "front"], LivenessFailure.NO_TURN),
        (["turn_left", "front", "look_up", "front", "come_closer"], LivenessFailure.NOT_FRONTAL),
    ],
)
def test_what_fails_says_why(names: list[str], why: str) -> None:
    assert movements_failure(of_head(names), ASKED) == why


@pytest.mark.parametrize(
    "elsewhere",
    [{"at": (300, 0)}, {"distance": 250.0}, {"distance": 1000.0}, {"roll": 120.0}],
    ids=str,
)
def test_frames_between_which_the_head_jumps_fail(elsewhere: dict[str, float]) -> None:
    poses = of_head(performed(ASKED))
    poses.insert(4, head_pose(head(**elsewhere)))  # type: ignore[arg-type]
    assert movements_failure(poses, ASKED) is LivenessFailure.JUMP


def test_every_order_is_drawn() -> None:
    # 60 orders: that one of them is missing among 6,000 draws has a chance below 1e-40.
    drawn = Counter(draw_movements() for _ in range(6000))
    assert set(drawn) == set(ORDERS)
    assert max(drawn.values()) < 200
