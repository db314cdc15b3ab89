"""Active presentation attack detection: a challenge of head movements, and whether frames meet it.

What is asked is drawn anew each time, so a recording meets one draw in 60. But a challenge may be
asked for again: an attacker with one recording asks about 60 times, and only rate limits stand
against that. What a flat picture does before a camera is no turn of a head (``models.head_pose``,
``models.relief``). What this does not stop is said in docs/liveness.md.
"""

import itertools
import math
import secrets
from collections.abc import Container, Sequence
from enum import StrEnum

from models.head_pose import HeadPose

MOVEMENTS = 3
MIN_FRAMES = 5
MAX_FRAMES = 12

TURN_DEGREES = 20.0
CLOSER = 1.25
"""Change from the first frame that a movement has at least: yaw or pitch, and scale as a factor."""
FRONT_YAW, FRONT_PITCH = 25.0, 40.0
"""Degrees within which the first frame looks ahead; where 0 is differs between people."""
STILL_FRONT = 0.5
"""Share of those changes below which a frame still looks ahead."""
JUMP_DEGREES = 75.0
JUMP_SCALE = 1.7
JUMP_WIDTHS = 1.5
"""What lies between two frames at most: yaw, pitch or roll; scale as a factor; the centre's way in
widths of the template."""
_TEMPLATE_WIDTH = 112.0


class Movement(StrEnum):
    """A movement, as the person sees it who makes it."""

    TURN_LEFT = "turn_left"
    TURN_RIGHT = "turn_right"
    LOOK_UP = "look_up"
    LOOK_DOWN = "look_down"
    COME_CLOSER = "come_closer"


class LivenessFailure(StrEnum):
    """Why a probe is not taken for a living person's."""

    NOT_FRONTAL = "not_frontal"
    JUMP = "jump"
    NO_TURN = "no_turn"
    MISSING_MOVEMENT = "missing_movement"
    WRONG_ORDER = "wrong_order"
    ANOTHER_PERSON = "another_person"
    PASSIVE = "passive"


def draw_movements() -> tuple[Movement, ...]:
    """Draw what a challenge asks for: three different movements, each order as likely."""
    orders = list(itertools.permutations(Movement, MOVEMENTS))
    return secrets.choice(orders)


def movements_failure(
    poses: Sequence[HeadPose], movements: Sequence[Movement], *, flat: Container[int] = ()
) -> LivenessFailure | None:
    """Say why frames do not show these movements and no others, in this order; None if they do.

    The first frame looks ahead; the others are measured by their change from it, so that nothing
    depends on a person's proportions or on how the camera is held. Of two movements in one frame
    the larger counts, by its own measure. Coming closer counts once: whoever stays near makes the
    later movements there, and those frames count by their turn. Frames between movements are free.
    """
    if abs(poses[0].yaw) > FRONT_YAW or abs(poses[0].pitch) > FRONT_PITCH:
        return LivenessFailure.NOT_FRONTAL
    if any(_jumps(before, after, poses[0]) for before, after in itertools.pairwise(poses)):
        return LivenessFailure.JUMP
    shown: list[Movement] = []
    for place, pose in enumerate(poses):
        movement = movement_of(pose, poses[0], near=Movement.COME_CLOSER in shown)
        if movement is Movement.COME_CLOSER or (movement is not None and place not in flat):
            shown.append(movement)
    if not set(shown) - {Movement.COME_CLOSER}:
        return LivenessFailure.NO_TURN
    if not set(movements) <= set(shown):
        return LivenessFailure.MISSING_MOVEMENT
    if [movement for movement, _ in itertools.groupby(shown)] != list(movements):
        return LivenessFailure.WRONG_ORDER
    return None


def movement_of(pose: HeadPose, first: HeadPose, *, near: bool = False) -> Movement | None:
    """Return the movement that a head has made since its first frame, if it made any."""
    reached = _turns(pose, first)
    if not near:
        reached[Movement.COME_CLOSER] = math.log(pose.scale / first.scale) / math.log(CLOSER)
    largest = max(reached, key=reached.__getitem__)
    return largest if reached[largest] >= 1 else None


def frontal_frames(poses: Sequence[HeadPose]) -> list[int]:
    """Places of the frames that look ahead as the first one does; the first is one of them."""
    return [
        place
        for place, pose in enumerate(poses)
        if max(_turns(pose, poses[0]).values()) < STILL_FRONT
    ]


def _turns(pose: HeadPose, first: HeadPose) -> dict[Movement, float]:
    """How far each turn has gone, 1 where it counts."""
    yaw, pitch = (pose.yaw - first.yaw) / TURN_DEGREES, (pose.pitch - first.pitch) / TURN_DEGREES
    return {
        Movement.TURN_LEFT: yaw,
        Movement.TURN_RIGHT: -yaw,
        Movement.LOOK_DOWN: pitch,
        Movement.LOOK_UP: -pitch,
    }


def _jumps(before: HeadPose, after: HeadPose, first: HeadPose) -> bool:
    """Whether no head moves so between two frames; stepping back to where it began is no jump."""
    roll = (after.roll - before.roll + 180) % 360 - 180
    angles = after.yaw - before.yaw, after.pitch - before.pitch, roll
    grown = after.scale / before.scale
    width = _TEMPLATE_WIDTH * max(before.scale, after.scale)
    way = max(abs(new - old) for new, old in zip(after.centre, before.centre, strict=True))
    return (
        max(map(abs, angles)) > JUMP_DEGREES
        or grown >= JUMP_SCALE
        or (grown <= 1 / JUMP_SCALE and after.scale <= first.scale / CLOSER)
        or way > JUMP_WIDTHS * width
    )
