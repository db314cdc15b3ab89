"""Against heads and sheets in space that a pinhole camera sees."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.errors import LowQuality
from models.head_pose import head_pose
from tests.heads import head, photo

SMALL = st.floats(-25, 25)
STEEP = st.floats(-60, 60)


def change(points: np.ndarray, start: np.ndarray) -> tuple[float, float]:
    pose, first = head_pose(points), head_pose(start)
    return pose.yaw - first.yaw, pose.pitch - first.pitch


@pytest.mark.parametrize("distance", [300.0, 500.0, 1500.0])
@pytest.mark.parametrize("yaw", [-40, -25, 25, 40])
def test_a_turning_head_turns_by_its_angle(yaw: float, distance: float) -> None:
    sideways, nod = change(head(yaw=yaw, distance=distance), head(distance=distance))
    assert sideways == pytest.approx(yaw, abs=9)
    assert abs(nod) < 6


@pytest.mark.parametrize("distance", [300.0, 500.0, 1500.0])
@pytest.mark.parametrize("pitch", [-25, -15, 15, 25])
def test_a_nodding_head_nods_by_its_angle(pitch: float, distance: float) -> None:
    sideways, nod = change(head(pitch=pitch, distance=distance), head(distance=distance))
    assert abs(sideways) < 1e-6
    assert nod == pytest.approx(pitch, abs=10)


@given(STEEP, STEEP, st.floats(-180, 180), st.floats(150, 2000), SMALL, SMALL)
def test_a_flat_photo_turns_by_nothing_however_it_is_held(
    yaw: float, pitch: float, roll: float, distance: float, x: float, y: float
) -> None:
    # Close enough for a strong perspective, of a head that looked ahead or aside.
    for of in ({}, {"yaw": 30.0}, {"pitch": 20.0}):
        held = photo(of=of, yaw=yaw, pitch=pitch, roll=roll, distance=distance, at=(x, y))
        assert change(held, photo(of=of)) == pytest.approx((0, 0), abs=1e-5)


@given(st.floats(-179, 179), SMALL, SMALL)
def test_roll_is_measured_and_changes_no_other_angle(roll: float, yaw: float, pitch: float) -> None:
    # About the camera's axis: a turn of the picture.
    upright, tilted = head(yaw=yaw, pitch=pitch), head(yaw=yaw, pitch=pitch, roll=roll)
    first, second = head_pose(upright), head_pose(tilted)
    assert (second.yaw, second.pitch) == pytest.approx((first.yaw, first.pitch), abs=1e-5)
    assert (second.roll - first.roll - roll + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)
    assert second.scale == pytest.approx(first.scale, rel=1e-5)


@given(SMALL, st.floats(-20, 20), st.floats(0.3, 4))
def test_scale_follows_size_and_not_the_turn(yaw: float, pitch: float, factor: float) -> None:
    far = head(yaw=yaw, pitch=pitch, distance=5000.0)
    assert head_pose(far).scale == pytest.approx(head_pose(head(distance=5000.0)).scale, rel=0.08)
    assert head_pose(far * factor).scale == pytest.approx(factor * head_pose(far).scale)


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.outer(np.arange(5), [1.0, 2.0])])
def test_points_that_span_no_plane_are_refused(points: np.ndarray) -> None:
    with pytest.raises(LowQuality):
        head_pose(points)
