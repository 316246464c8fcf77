"""What leaves the window becomes part of the prior: nothing is lost, nothing taken for certain.

The frames that leave and the old prior are a problem of their own. At the optimum of the whole
window z its step and the covariance there are

    z' = z - H^-1 g,    C = H^-1

of poses and old centres. New anchors and new centres y are linear in them, y = y(z) + G (z' - z),
cov(y) = G C G^T: an anchor is the robot's last pose that leaves, a centre the best landmark given
poses and old centres, which may be several. The landmark's Lambda is now the sum that it came to.

What the problem does not hold, r, follows what it holds of the old prior N(m, P), b:

    K = P_rb P_bb^-1,   m_r' = m_r + K (b' - m_b),   P_rr' = P_rr - K P_br + K C_bb K^T,
    P_ry' = K C_bz G^T

Many landmarks seen first from few poses have centres that move only together, and a covariance
without inverse. So a share of what is unknown of such a landmark in any case is moved from Lambda
into the covariance of its centre: the landmark's distribution is the same.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.models.symmetric import inverses, pack, unpack
from multi_robot_slam.smoothing.cost import landmarks_and_distances, prior_residuals
from multi_robot_slam.smoothing.hubs import cheapest_envelope
from multi_robot_slam.smoothing.kernels import landmarks as kernels
from multi_robot_slam.smoothing.linearised import gradient_of
from multi_robot_slam.smoothing.prior import Active, Prior
from multi_robot_slam.smoothing.problem import PoseSightings, Problem
from multi_robot_slam.smoothing.solve import Smoothed, factorised

MOVED = 0.1
"""Share of a new landmark's covariance in the plane, given its height, that its centre takes."""


class Leaving(NamedTuple):
    """The problem of what leaves the window, and where it is at the window's optimum."""

    problem: Problem
    views: np.ndarray
    """(V, 3)"""
    landmarks: np.ndarray
    """(N, 3)"""
    weights: np.ndarray
    """(O + S,)"""


class Belief(NamedTuple):
    """What the problem of what leaves says: of old anchors and centres b, and of the new ones y."""

    old_step: np.ndarray
    """(3 A + 2 a,): b' less its prior mean."""
    old_deviations: np.ndarray
    """(3 A + 2 a, U): C_bb is their product."""
    anchors: np.ndarray
    """(A, 3)"""
    centres: np.ndarray
    """(N, 3)"""
    covariances: np.ndarray
    """(N, 6): Lambda^-1."""
    deviations: np.ndarray
    """(3 A + 2 N, U): cov(y) is their product, but for what was moved."""
    moved: np.ndarray
    """(N, 2, 2): what was moved from Lambda^-1 to the covariance of the centre."""


@one_thread
def absorb(
    problem: Problem,
    smoothed: Smoothed,
    count: int,
    prior: Prior,
    forgotten: np.ndarray | None = None,
) -> Prior:
    """The prior after the first `count` records of a problem, which leave the window.

    With it and the later records `problem_of` makes a problem whose optimum and covariance are
    those of `problem`: exactly in a linear world, else to first order. Landmarks that had several
    centres have one.

    Parameters
    ----------
    smoothed : the optimum of `problem`; its weights are those of the observations that leave.
    count : no sighting may tie one of these records to a later one: whole steps.
    prior : the one that `problem` was posed with.
    forgotten : ids of landmarks that have no centre after: what they say of the rest stays.

    Returns
    -------
    Anchors are each robot's last pose among the `count` records, or the old one. Centres are those
    of the old prior and of landmarks seen first in the records that leave, ids ascending.

    """
    leaving = _leaving(problem, smoothed, count, prior)
    if not len(leaving.views):
        return prior
    ids = leaving.problem.ids
    kept = np.flatnonzero(np.isin(ids, forgotten, invert=True)) if forgotten is not None else None
    active, belief = leaving.problem.prior, _belief(leaving, kept)
    robots, resting = _resting(prior, active)
    means, covariance, mixed = _follow(prior, active, belief)
    poses = prior.poses.copy()
    poses[active.robots], poses[robots] = belief.anchors, means[: 3 * len(robots)].reshape(-1, 3)
    centres = prior.centres[resting]
    centres[:, :2] = means[3 * len(robots) :].reshape(-1, 2)
    information = np.append(inverses(belief.covariances), prior.information[resting], axis=0)
    ids = np.append(ids if kept is None else ids[kept], prior.ids[resting])
    order = np.argsort(ids, kind="stable")
    joint = np.block([[_covariance(belief), mixed.T], [mixed, covariance]])
    rows = _rows(active.robots, robots, len(belief.centres), order)
    result = Prior(
        poses,
        ids[order],
        np.append(belief.centres, centres, axis=0)[order],
        information[order],
        joint[np.ix_(rows, rows)],
    )
    return result if forgotten is None else result.forget(forgotten)


@one_thread
def resting(prior: Prior, problem: Problem, smoothed: Smoothed) -> tuple[np.ndarray, np.ndarray]:
    """Ids (r,) and marginals (r, 9) of the landmarks that the prior holds and the problem does not.

    Mean [m] and covariance [m^2], laid out like the planes of the filter: where the optimum of the
    problem leaves them.
    """
    centres = _resting(prior, problem.prior)[1]
    if not len(centres):
        return np.empty(0, np.int64), np.empty((0, 9))
    rows = problem.prior_columns
    unit = np.zeros((smoothed.factor.size, len(rows)))
    unit[rows, np.arange(len(rows))] = 1
    old_deviations = smoothed.factor.solve_lower(unit).T
    old_step = prior_residuals(problem, smoothed.views)
    rows = prior.rows(np.empty(0, np.int64), centres)
    gain = _gain(prior, problem.prior, rows)
    means = prior.centres[centres] + np.pad((gain @ old_step).reshape(-1, 2), ((0, 0), (0, 1)))
    of_problem = prior.covariance[np.ix_(rows, _active_rows(prior, problem.prior))]
    spread = (gain @ old_deviations).reshape(len(centres), 2, -1)
    blocks = spread @ spread.transpose(0, 2, 1)
    blocks -= gain.reshape(len(centres), 2, -1) @ of_problem.reshape(len(centres), 2, -1).transpose(
        0, 2, 1
    )
    own = rows.reshape(-1, 2)
    blocks += prior.covariance[own[:, :, None], own[:, None, :]]
    covariances = inverses(prior.information[centres])
    covariances[:, [0, 1, 3]] += blocks[:, [0, 0, 1], [0, 1, 1]]
    return prior.ids[centres], np.append(means, covariances, axis=1)


def _leaving(problem: Problem, smoothed: Smoothed, count: int, prior: Prior) -> Leaving:
    """The problem of the first `count` records and of landmarks that have several centres."""
    anchors = len(problem.anchors)
    of_centre = problem.seen_from >= problem.poses
    seen = (problem.seen_from < anchors + count) & ~of_centre
    centres = np.bincount(problem.landmarks[of_centre], minlength=len(problem.ids))
    is_in = (np.bincount(problem.landmarks[seen], minlength=len(problem.ids)) > 0) | (centres > 1)
    kept = seen | (of_centre & is_in[problem.landmarks])
    sighted = problem.sighted.seen_from < anchors + count
    robots = np.unique(problem.robots[anchors : anchors + count])
    views = np.concatenate(
        [
            np.flatnonzero(np.isin(problem.anchors, robots)),
            anchors + np.arange(count),
            np.unique(problem.seen_from[kept & of_centre]),
        ]
    )
    place = np.full(len(problem.columns) - 1, -1)
    place[views] = np.arange(len(views))
    own_centres = problem.prior.rows[views[len(robots) + count :] - problem.poses]
    landmarks = np.bincount(problem.landmarks[kept], minlength=len(problem.ids))[is_in]
    part = Problem(
        prior=prior.active(robots, own_centres),
        robots=problem.robots[views[: len(robots) + count]],
        previous=place[problem.previous[:count]],
        motions=problem.motions[:count],
        sigmas=problem.sigmas[:count],
        seen_from=place[problem.seen_from[kept]],
        starts=np.append(0, np.cumsum(landmarks)),
        positions=problem.positions[kept],
        information=problem.information[kept],
        ids=problem.ids[is_in],
        sighted=PoseSightings(
            place[problem.sighted.seen_from[sighted]],
            place[problem.sighted.seen[sighted]],
            problem.sighted.positions[sighted],
            problem.sighted.information[sighted],
        ),
    )
    weights = smoothed.weights[np.append(kept, sighted)]
    return Leaving(part, smoothed.views[views], smoothed.landmarks[is_in, :3], weights)


def _belief(leaving: Leaving, kept: np.ndarray | None) -> Belief:
    """Of all landmarks of the problem, or of the rows `kept` of them.

    One step of Gauss-Newton from where the window's optimum has all, and the covariance there.

    The landmarks too count as they lie at that optimum, though they have a gradient there: so what
    remains has the same derivatives as before.
    """
    problem, views, at_optimum, weights = leaving
    columns, envelope = problem.columns, cheapest_envelope(problem)
    landmarks, _ = landmarks_and_distances(problem, views, weights)
    covariances, apart = landmarks[:, 3:], at_optimum - landmarks[:, :3]
    linearised = np.append(at_optimum, covariances, axis=1)
    jacobians = np.zeros((apart.size, columns[-1]))
    everything, observations = np.arange(len(landmarks)), problem.observations(weights)
    kernels.add_landmark_jacobians(everything, observations, views, columns, linearised, jacobians)
    gradient = gradient_of(problem, views, linearised, weights)
    pull = unpack(inverses(covariances)) @ apart[:, :, None]
    gradient += jacobians.T @ pull.ravel()
    factor = factorised(problem, views, linearised, weights, envelope)
    step = -factor.solve_upper(factor.solve_lower(gradient))[: columns[-1]]
    deviations = factor.solve_upper(np.eye(factor.size))[: columns[-1]]
    moves = (jacobians @ step).reshape(-1, 3)
    is_new = _is_new(problem)
    if kept is not None:
        jacobians = jacobians.reshape(len(landmarks), 3, columns[-1])[kept]
        jacobians = jacobians.reshape(3 * len(kept), columns[-1])
        landmarks, covariances, moves = landmarks[kept], covariances[kept], moves[kept]
        is_new = is_new[kept]
    of_landmarks = (jacobians @ deviations).reshape(len(landmarks), 3, deviations.shape[1])
    last = {robot: p for p, robot in enumerate(problem.robots.tolist())}
    anchors = 3 * np.array([last[robot] for robot in problem.anchors], int)[:, None] + np.arange(3)
    covariances, moved = _share(is_new, covariances)
    covariances[:, 5] += np.sum(of_landmarks[:, 2] ** 2, axis=1)
    old = problem.prior_columns
    return Belief(
        old_step=prior_residuals(problem, views) + step[old],
        old_deviations=deviations[old],
        anchors=views[anchors[:, 0] // 3] + step[anchors],
        centres=landmarks[:, :3] + moves,
        covariances=covariances,
        deviations=np.append(
            deviations[anchors.ravel()],
            of_landmarks[:, :2].reshape(2 * len(landmarks), deviations.shape[1]),
            axis=0,
        ),
        moved=moved,
    )


def _is_new(problem: Problem) -> np.ndarray:
    """(N,) bool: landmarks without a centre so far."""
    is_new = np.ones(len(problem.ids), bool)
    is_new[problem.landmarks[problem.seen_from >= problem.poses]] = False
    return is_new


def _share(is_new: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lambda^-1 (N, 6) without what is moved to the centres, and that (N, 2, 2).

    Of landmarks that are new, a share of the covariance in the plane given the height.
    """
    in_plane = unpack(inverses(covariances))[:, :2, :2]
    moved = MOVED * is_new[:, None, None] * np.linalg.inv(in_plane)
    return covariances - pack(np.pad(moved, ((0, 0), (0, 1), (0, 1)))), moved


def _covariance(belief: Belief) -> np.ndarray:
    """(3 A + 2 N, 3 A + 2 N) of new anchors and centres."""
    covariance = belief.deviations @ belief.deviations.T
    first = 3 * len(belief.anchors)
    rows = first + np.arange(len(covariance) - first).reshape(-1, 2)
    covariance[rows[:, :, None], rows[:, None, :]] += belief.moved
    return covariance


def _follow(
    prior: Prior, active: Active, belief: Belief
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, covariance of the resting anchors and centres, and their covariance with the new."""
    rows = prior.rows(*_resting(prior, active))
    gain = _gain(prior, active, rows)
    before = np.append(prior.poses, prior.centres[:, :2])[rows]
    of_old = gain @ belief.old_deviations
    covariance = prior.covariance[np.ix_(rows, rows)]
    covariance -= gain @ prior.covariance[np.ix_(_active_rows(prior, active), rows)]
    covariance += of_old @ of_old.T
    covariance = 0.5 * (covariance + covariance.T)
    return before + gain @ belief.old_step, covariance, of_old @ belief.deviations.T


def _gain(prior: Prior, active: Active, rows: np.ndarray) -> np.ndarray:
    """K (rows, 3 A + 2 a)."""
    return prior.covariance[np.ix_(rows, _active_rows(prior, active))] @ active.information


def _active_rows(prior: Prior, active: Active) -> np.ndarray:
    return prior.rows(active.robots, active.rows)


def _resting(prior: Prior, active: Active) -> tuple[np.ndarray, np.ndarray]:
    """Robots and centres, rows of the prior's ids, that a problem does not hold."""
    robots = np.setdiff1d(np.arange(len(prior.poses)), active.robots)
    return robots, np.setdiff1d(np.arange(len(prior.ids)), active.rows)


def _rows(active: np.ndarray, resting: np.ndarray, new: int, order: np.ndarray) -> np.ndarray:
    """Where the rows of the new prior are among: active anchors, new centres, then resting ones.

    Parameters
    ----------
    active, resting : robots.
    new : centres beside the active anchors.
    order : of all centres.

    """
    robots = len(active) + len(resting)
    anchors, centres = 3 * np.arange(robots), 3 * len(active) + 2 * np.arange(len(order))
    anchors[len(active) :] += 2 * new
    centres[new:] += 3 * len(resting)
    anchors = anchors[np.argsort(np.append(active, resting))]
    return np.append(
        anchors[:, None] + np.arange(3), centres[order][:, None] + np.arange(2)
    ).astype(np.int64)
