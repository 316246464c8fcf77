"""Both proposals against the exact Kalman answer on a linear-Gaussian world.

The robot never turns, and its odometry has no heading error: positions of robot and landmarks are
jointly Gaussian. The filter's weighted mean and covariance must be theirs, within the Monte-Carlo
error of the particles.
"""

from dataclasses import replace

import linear_world
import numpy as np
import pytest
from linear_world import LANDMARKS, SIGMA_MOVE, SIGMA_SEE, STEPS, world

from msg_defs.types import ObservationSet
from multi_robot_slam.filter import rbpf, resampling
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.motion import MotionSettings

PARTICLES = 20_000


EXTRA = np.array([0.4, 0.2, 0.0]) * (np.arange(STEPS) == 3)[:, None]
"""A gap before one of the frames."""


def exact(moves, seen, start, extra):
    """Kalman filter over x, y of the robot and all landmarks: mean, covariance."""
    size = 2 + 3 * LANDMARKS
    mean, covariance = np.zeros(size), np.diag([0.0] * 2 + [1e8] * (size - 2))
    mean[:2], covariance[:2, :2] = start.mean[:2], start.covariance[:2, :2]
    H = np.zeros((3 * LANDMARKS, size))
    H[:, 2:] = np.eye(3 * LANDMARKS)
    H[0::3, 0] = H[1::3, 1] = -1
    for t in range(STEPS):
        mean[:2] += moves[t]
        covariance[:2, :2] += SIGMA_MOVE**2 * np.eye(2) * (t > 0) + np.diag(extra[t, :2] ** 2)
        S = H @ covariance @ H.T + SIGMA_SEE**2 * np.eye(len(H))
        K = np.linalg.solve(S, H @ covariance).T
        mean += K @ (seen[t].ravel() - H @ mean)
        covariance -= K @ H @ covariance
    return mean, covariance


def filtered(moves, seen, start, extra, proposal, seed):
    """Weighted mean and covariance of the same state, and the particles' effective number."""
    noise = MotionSettings(SIGMA_MOVE, SIGMA_MOVE, 0.0, 0.0)
    settings = FilterSettings(
        particles=PARTICLES,
        gate=1e6,
        rejuvenation=NO_REJUVENATION,
        proposal=proposal,
        resample_below=0.5,
        motion=noise,
    )
    rng = np.random.default_rng(seed)
    state = rbpf.init(np.zeros((1, 3)), settings, np.float64)
    descriptors = np.eye(LANDMARKS, 128, dtype=np.float32)
    for t in range(STEPS):
        camera = np.stack([-seen[t, :, 1], seen[t, :, 2], seen[t, :, 0]], axis=1)
        R = np.tile([SIGMA_SEE**2, 0, 0, SIGMA_SEE**2, 0, SIGMA_SEE**2], (LANDMARKS, 1))
        z = ObservationSet("", t, camera, R, descriptors)
        frame = linear_world.frame(t, moves[t], z, extra[t])
        frame = replace(frame, start=None if t else start)
        info = rbpf.step(state, [frame], settings, rng)
    landmarks = state.landmarks
    landmarks.bring_up_to_date(landmarks.alive())
    planes = landmarks.planes[landmarks.alive()]
    weights = resampling.normalise(state.log_weights)
    places = np.concatenate([state.poses[0, :2], planes[:, :3].reshape(-1, PARTICLES)])
    mean = places @ weights
    covariance = (places - mean[:, None]) * weights @ (places - mean[:, None]).T
    for n in range(LANDMARKS):
        xx, xy, xz, yy, yz, zz = planes[n, 3:] @ weights
        block = slice(2 + 3 * n, 5 + 3 * n)
        covariance[block, block] += [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    return mean, covariance, info.effective_particles


KNOWN = Start(np.zeros(3), np.zeros((3, 3)))
BELIEVED = Start(
    np.array([0.5, -1.0, 0.0]), np.array([[0.25, 0.1, 0.0], [0.1, 0.16, 0.0], [0.0, 0.0, 0.0]])
)


@pytest.mark.parametrize("proposal", ["motion", "informed"])
@pytest.mark.parametrize(
    ("seed", "start", "extra"),
    [(0, KNOWN, 0 * EXTRA), (1, KNOWN, 0 * EXTRA), (0, BELIEVED, 0 * EXTRA), (2, KNOWN, EXTRA)],
)
def test_posterior_is_the_kalman_filter_s(proposal, seed, start, extra):
    moves, seen = world(seed)
    moves[1:] += extra[1:, :2] / 2
    mean, covariance = exact(moves, seen, start, extra)
    estimate, spread, effective = filtered(moves, seen, start, extra, proposal, seed)
    assert effective > 100
    # The particles are correlated after resampling, so their number is a tenth at the least.
    error = np.sqrt(np.diag(covariance) / (PARTICLES / 10))
    assert (np.abs(estimate - mean) < 5 * error).all()
    np.testing.assert_allclose(spread, covariance, atol=0.15 * np.diag(covariance).max())
