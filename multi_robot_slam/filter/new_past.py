"""New pasts for the particles of one association history: smoothed, drawn, and weighed.

`rejuvenation` has the mathematics. The snapshot is read, never changed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.forgetting import without_chance_finds
from multi_robot_slam.filter.history import Past, Record, signature_of
from multi_robot_slam.filter.settings import FilterSettings, threads
from multi_robot_slam.filter.snapshot import Snapshot
from multi_robot_slam.smoothing import draws, joining, solve
from multi_robot_slam.smoothing.absorption import resting
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.known_distance import covariances_of
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import Problem, problem_of
from multi_robot_slam.smoothing.solve import Smoothed, SmoothingError

NEAR_ENOUGH = 0.1
"""Distance from the optimum, in standard deviations, at which smoothing ends.

The importance weights are exact around any centre.
"""


class Drawn(NamedTuple):
    """What the n particles of one association history go on from."""

    past: Past
    poses: np.ndarray
    """(K, 3, n) float64: the last of each robot."""
    ids: np.ndarray
    """(N,) int64: landmarks, ascending."""
    planes: np.ndarray
    """(N, 9, n): mean and covariance of each, as in `Landmarks`."""
    log_weights: np.ndarray
    """(n,) float64: logarithm of the weights, tempered; their mean weight is 1."""
    effective_particles: float
    """Effective sample size of the importance weights before they were tempered, 1 .. n."""
    log_densities: np.ndarray
    """(n,) float64: logarithm of the posterior density over that of the optimum."""
    prior: Prior
    """The one the past begins with, joined landmarks under the id they go by."""
    problem: Problem
    smoothed: Smoothed


def draw(
    old: Snapshot,
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
    lineage = list(old.history.lineage(members))[::-1]
    records = [old.pieces.within(record) for record, _ in lineage]
    poses = _first_guess(old, lineage)
    identities = [record.matches[:, rows[0]] for record, rows in lineage]
    problem, smoothed, aliases = _smooth(old, records, poses, identities, alike, settings)
    identities = [aliases.of(own) for own in identities]
    prior = old.prior.renamed(aliases.of(old.prior.ids))
    normals = rng.standard_normal((smoothed.factor.size, len(members)), np.float32)
    normals[:, 0] = 0
    paths, centres, drawn_densities = draws.draw(problem, smoothed, normals)
    planes, densities = draws.landmarks_and_log_density(
        problem, paths, centres, smoothed.weights, old.held.dtype, threads(settings)
    )
    exact = densities - drawn_densities
    if not (np.isfinite(exact).all() and np.isfinite(planes).all()):
        raise SmoothingError(f"smoothing {len(poses)} poses: a path drawn is not finite")
    log_weights = tempered(exact)
    log_weights -= log_weights.max()
    log_weights -= np.log(np.exp(log_weights).mean())
    own = paths[len(problem.anchors) :]
    ids, planes = _with_resting(problem, smoothed, prior, planes)
    return Drawn(
        Past(members, own, identities, aliases, signature_of(identities)),
        _last_poses(problem, paths),
        ids,
        planes,
        log_weights,
        resampling.effective_sample_size(resampling.normalise(exact)),
        densities - densities[0],
        prior,
        problem,
        smoothed,
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


def _smooth(
    old: Snapshot,
    records: list[Record],
    poses: np.ndarray,
    identities: list[np.ndarray],
    alike: np.ndarray,
    settings: FilterSettings,
) -> tuple[Problem, Smoothed, Aliases]:
    """Smooth, and join landmarks that turn out to be one."""
    if settings.rejuvenation.least_seen > 1:
        identities = without_chance_finds(records, identities, old.prior.ids)
    also = _nearby(old, records, identities, alike)
    covariances = None
    if settings.noise_at == "landmark":
        ids, places = old.held.ids, old.held.places
        covariances = covariances_of(records, identities, poses, ids, places)
    start = old.optimum.smoothed if old.optimum else None

    def smoothed_with(aliases: Aliases, poses: np.ndarray) -> tuple[Problem, Smoothed]:
        nonlocal start
        problem = problem_of(
            records,
            [aliases.of(own) for own in identities],
            old.prior.renamed(aliases.of(old.prior.ids)),
            settings.motion,
            old.scales.factors,
            also=aliases.of(also),
            covariances=covariances,
            noisier=old.noise.used,
        )
        start = solve.smooth(problem, poses, settings.robust_above, NEAR_ENOUGH, start)
        return problem, start

    return joining.smooth_and_join(
        smoothed_with,
        poses,
        alike,
        settings.gate,
        settings.exclusive,
        settings.correlated,
        Aliases().joined(old.pieces.pairs),
    )


def _first_guess(old: Snapshot, lineage: Sequence[tuple[Record, np.ndarray]]) -> np.ndarray:
    """(P, 3): the last optimum, and the mean of the particles since."""
    known = old.optimum.poses if old.optimum else np.empty((0, 3))
    since = [record.poses[:, rows].mean(axis=1) for record, rows in lineage[len(known) :]]
    return np.concatenate([known, np.array(since).reshape(-1, 3)])


def _nearby(
    old: Snapshot, records: list[Record], identities: list[np.ndarray], alike: np.ndarray
) -> np.ndarray:
    """Ids of settled landmarks to draw with those the window saw.

    What may be seen next: whatever was seen with what each robot saw last. And what looks like a
    landmark that the window saw: it may be the same.
    """
    last = dict(old.covisible.last)
    last |= {r.robot: own for r, own in zip(records, identities, strict=True) if len(own)}
    next_to = old.covisible.near(np.concatenate([np.empty(0, np.int64), *last.values()]))
    seen = np.unique(np.concatenate([np.empty(0, np.int64), *identities, next_to]))
    pairs = alike[np.isin(alike, seen).any(axis=1)]
    return np.union1d(next_to, pairs)


def _last_poses(problem: Problem, paths: np.ndarray) -> np.ndarray:
    """(K, 3, n): where each robot's path ends."""
    last = {int(robot): p for p, robot in enumerate(problem.robots)}
    return np.array([paths[last[robot]] for robot in range(len(last))])


def _with_resting(
    problem: Problem, smoothed: Smoothed, prior: Prior, planes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ids (N,) and planes (N, 9, n) of the problem's landmarks and of those that rest."""
    ids, values = resting(prior, problem, smoothed)
    if not len(ids):
        return problem.ids, planes
    order = np.argsort(np.concatenate([problem.ids, ids]))
    together = np.empty((len(order), *planes.shape[1:]), planes.dtype)
    places = np.argsort(order)
    together[places[: len(problem.ids)]] = planes
    together[places[len(problem.ids) :]] = values[:, :, None]
    return np.concatenate([problem.ids, ids])[order], together
