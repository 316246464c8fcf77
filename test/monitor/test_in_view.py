"""What must be in view is seen again, or the robot is elsewhere."""

import numpy as np
from scipy.stats import betabinom

from msg_defs.types import CameraMount
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.monitor import in_view
from multi_robot_slam.monitor.in_view import InView

STEP = np.array([0.3, 0.0, 0.0])
MOUNT = CameraMount(forward_m=0.1, left_m=0.0, up_m=1.0, yaw_rad=3.0)


def frames(count, seed=0, carried_at=None, missed=0.1):
    """A robot that drives along two walls, its camera looking back; it may be carried off."""
    rng = np.random.default_rng(seed)
    descriptors = rng.random((2000, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    landmarks = rng.uniform([-100, -3, 0], [100, 3, 2], (2000, 3))
    for t in range(count):
        x = 0.3 * t + (40 if carried_at is not None and t >= carried_at else 0)
        local = landmarks - [x, 0, 0]
        behind = (local[:, 0] < -2) & (local[:, 0] > -8)
        narrow = abs(local[:, 1]) < -0.5 * local[:, 0]
        chosen = np.flatnonzero(behind & narrow)
        chosen = chosen[rng.random(len(chosen)) >= missed]
        noise = np.tile(np.array([1, 0, 0, 1, 0, 1]) * 1e-4, (len(chosen), 1))
        yield RobotFrame(
            0, t, STEP if t else np.zeros(3), local[chosen], noise, descriptors[chosen]
        )


def alarms(sent):
    one = InView(MOUNT, 0.04)
    return [t for t, frame in enumerate(sent) if one.note(frame)], one


def test_a_robot_that_drives_on_sees_again_what_it_saw():
    for seed in range(3):
        found, one = alarms(frames(60, seed))
        assert not found
        assert 0.7 < one.share <= 1


def test_a_robot_that_was_carried_off_is_noticed_within_five_frames():
    found, one = alarms(frames(40, carried_at=30))
    assert len(found) == 1
    assert 30 < found[0] <= 34
    assert one.evidence.is_alarming


def test_a_frame_that_sees_nothing_says_nothing():
    def sent():
        for t, frame in enumerate(frames(40)):
            dark = frame.positions[:0], frame.covariances[:0], frame.descriptors[:0]
            yield RobotFrame(0, t, frame.motion, *dark) if 30 <= t < 35 else frame

    found, _ = alarms(sent())
    assert not found


def test_the_tail_is_that_of_the_beta_binomial():
    strength = 1 / in_view.CORRELATION - 1
    for seen, expected, mean in ((0, 10, 0.9), (3, 12, 0.7), (8, 8, 0.5)):
        law = betabinom(expected, mean * strength, (1 - mean) * strength)
        found = in_view.beta_binomial_tail(seen, expected, mean)
        np.testing.assert_allclose(found, law.cdf(seen), rtol=1e-9)
