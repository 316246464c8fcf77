"""New pasts for the particles of one association history: smoothed, drawn, and weighed.

`rejuvenation` has the mathematics. The state is read, never changed.
"""

from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.history import Past, Record, signature_of
from multi_robot_slam.filter.settings import FilterSettings, threads
from multi_robot_slam.filter.state import Fixed, State
from multi_robot_slam.smoothing import draws, joining, marginals, solve
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.odometry_scale import Scales, learn
from multi_robot_slam.smoothing.problem import Problem, problem_of
from multi_robot_slam.smoothing.solve import Smoothed, SmoothingError

NEAR_ENOUGH = 0.1
"""Distance from the optimum, in standard deviations, at which smoothing ends.

The importance weights are exact around any centre.
"""


class Drawn(NamedTuple):
    """What the particles of one association history go on from."""

    past: Past
    problem: Problem
    fixed: Fixed
    """The part of the past that moves no more."""
    scales: Scales
    """Factors of the odometry."""
    planes: np.ndarray
    """(N, 9, n): mean and covariance of each landmark, as in `Landmarks`."""
    log_weights: np.ndarray
    """(n,) float64: logarithm of the weights, tempered; their mean weight is 1."""
    effective_particles: float
    """Effective sample size of the importance weights before they were tempered, 1 .. n."""
    log_densities: np.ndarray
    """(n,) float64: logarithm of the posterior density over that of the optimum."""


def draw(
    state: State,
    members: np.ndarray,
    alike: np.ndarray,
    settings: FilterSettings,
    rng: np.random.Generator,
) -> Drawn:
    """Smooth the history `members` share, and draw a path for each; the first is the optimum.

    Parameters
    ----------
    members : (n,) particles that share an association history.
    alike : (A, 2) ids of landmarks that look alike.

    Raises
    ------
    SmoothingError
        The history has no optimum, or a path drawn from around it is not finite.

    """
    fixed = state.fixed[state.fixed_of[members[0]]]
    records, poses, identities = _past(state, members, fixed.records)
    problem, smoothed, aliases = _smooth(
        state.scales.factors, fixed, records, poses, identities, alike, settings
    )
    normals = rng.standard_normal((smoothed.factor.size, len(members)), np.float32)
    normals[:, 0] = 0
    paths, drawn_densities = draws.draw(problem, smoothed, normals)
    planes, densities = draws.landmarks_and_log_density(
        problem, paths, smoothed.weights, state.landmarks.planes.dtype, threads(settings)
    )
    exact = densities - drawn_densities
    if not (np.isfinite(exact).all() and np.isfinite(planes).all()):
        raise SmoothingError(f"smoothing {len(poses)} poses: a path drawn is not finite")
    log_weights = tempered(exact)
    log_weights -= log_weights.max()
    log_weights -= np.log(np.exp(log_weights).mean())
    renamed = aliases.among(fixed.known.ids)
    scales, fixed = _fix(state, fixed, problem, smoothed, settings.rejuvenation.window)
    identities = [aliases.of(own) for own in identities]
    signature = signature_of([*identities, fixed.known.ids.astype(np.int32)])
    return Drawn(
        Past(members, paths, identities, renamed, signature),
        problem,
        fixed,
        scales,
        planes,
        log_weights,
        resampling.effective_sample_size(resampling.normalise(exact)),
        densities - densities[0],
    )


def tempered(log_weights: np.ndarray) -> np.ndarray:
    """`log_weights` (n,) times the largest b <= 1 that leaves half of the sample size effective.

    Of a posterior far from Gaussian few draws have any weight, and to keep those alone would lose
    more than the weights correct.
    """

    def lacking(b: float) -> float:
        weights = resampling.normalise(b * log_weights)
        return 0.5 * len(weights) - resampling.effective_sample_size(weights)

    return log_weights * (1.0 if lacking(1.0) <= 0 else brentq(lacking, 0.0, 1.0, xtol=1e-6))


def _past(
    state: State, members: np.ndarray, fixed: int
) -> tuple[list[Record], np.ndarray, list[np.ndarray]]:
    """Records after the `fixed` ones, the mean of the members' paths (P, 3), their identities."""
    count = len(state.history.records) - fixed
    lineage = list(islice(state.history.lineage(members), count))[::-1]
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, rows].mean(axis=1) for record, rows in lineage])
    return records, poses, [record.matches[:, rows[0]] for record, rows in lineage]


def _smooth(
    factors: np.ndarray,
    fixed: Fixed,
    records: list[Record],
    poses: np.ndarray,
    identities: list[np.ndarray],
    alike: np.ndarray,
    settings: FilterSettings,
) -> tuple[Problem, Smoothed, Aliases]:
    """Smooth, and join landmarks that turn out to be one."""

    def smoothed_with(aliases: Aliases, poses: np.ndarray) -> tuple[Problem, Smoothed]:
        problem = problem_of(
            records,
            [aliases.of(own) for own in identities],
            fixed.start_poses,
            settings.motion,
            fixed.known._replace(ids=aliases.of(fixed.known.ids)),
            factors,
        )
        return problem, solve.smooth(problem, poses, settings.robust_above, NEAR_ENOUGH)

    return joining.smooth_and_join(smoothed_with, poses, alike, settings.gate, settings.exclusive)


def _fix(
    state: State, fixed: Fixed, problem: Problem, smoothed: Smoothed, window: int
) -> tuple[Scales, Fixed]:
    """The odometry's factors, and the past with the poses before the window fixed: whole steps."""
    records = state.history.records
    first = max(len(records) - window, fixed.records)
    while fixed.records < first and records[first].step == records[first - 1].step:
        first -= 1
    count = first - fixed.records
    motions = np.array([record.motion for record in records[fixed.records :]])
    scales = learn(state.scales, problem, smoothed, motions, count / len(motions))
    return scales, Fixed(first, *marginals.marginalise(problem, smoothed, count))
