"""Where one piece of a map lies in another: landmarks that look alike vote for a planar pose.

Of A pairs that look alike nearly all may be wrong. Each two of them at equal distances in both
pieces propose a pose, and of each pose it is asked how many more pairs agree. By chance a pair does
with probability p, counted over all pairs of landmarks that do not agree, so that of H poses the
best has k more with probability at most

    H P(Bin(A - 2, p) >= k)                                                                   (Q1)

A poster, a door or a shelf may be there twice, and all that is on it then agrees at once. So what
agrees is counted in things, places that are `THING_M` apart, the pose takes two of them, and none
counts for which there is another pose: k is what the best has more than the runner-up.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import bdtrc

from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.models.symmetric import unpack

THING_M = 1.5
"""What is nearer together may be one thing of which there are copies; posters and doors are less
than 1.2 m wide."""

FALSE_RATE = 1e-6
"""Largest (Q1) at which a pose is believed: with a vote a second, one false tie in 11 days of
exploring that have nothing in common."""

IN_HEIGHT, IN_PLANE, IN_SPACE = 6.635, 9.210, 11.345
"""99 % quantiles of chi2 with one, two and three degrees of freedom."""

MOST_PAIRS = 300
"""Pairs that are used; those that are more alike come first."""

MOST_CROSSED = 200
"""Landmarks of each piece that tell p."""

ROUNDS = 5
"""Of least squares; each uses the pairs that agree with the one before."""

AT_A_TIME = 1_000_000
"""Products of poses and pairs."""


class Points(NamedTuple):
    """n landmarks of a piece."""

    places: np.ndarray
    """(n, 3) float64 in the piece's own frame [m]."""
    covariances: np.ndarray
    """(n, 6) float64: `xx xy xz yy yz zz` [m^2]."""

    def of(self, rows: np.ndarray) -> "Points":
        """Some of them."""
        return Points(self.places[rows], self.covariances[rows])


class Vote(NamedTuple):
    """The pose that most things agree on."""

    pose: np.ndarray
    """(3,): where the frame of the second piece lies in that of the first: x, y [m], yaw [rad]."""
    covariance: np.ndarray
    """(3, 3) [m^2, m rad, rad^2]: as if landmarks erred independently."""
    pairs: np.ndarray
    """(n, 2): rows of the landmarks that agree, each in one pair at most."""
    things: int
    """How many places these are."""
    runner_up: int
    """The same of the best other pose; two, which any has, at least."""
    middle: np.ndarray
    """(2,): of what agrees, in the second piece [m]."""
    chance: float
    """(Q1): how many poses so good are expected of pieces that have nothing in common."""

    @property
    def is_believed(self) -> bool:
        """The pose is no chance."""
        return self.chance <= FALSE_RATE


class _Pairs(NamedTuple):
    """m pairs of landmarks; planar places as complex numbers."""

    rows: np.ndarray
    """(m, 2)."""
    ours: np.ndarray
    """(m,) complex [m]."""
    theirs: np.ndarray
    """(m,) complex [m]."""
    variances: np.ndarray
    """(m,): of the difference of both, in the direction in which it is largest [m^2]."""
    shares: np.ndarray
    """(m,): one over the number of these landmarks of ours that may be of one thing."""

    def of(self, which: np.ndarray) -> "_Pairs":
        return _Pairs(*(values[which] for values in self))


def vote(ours: Points, theirs: Points, alike: np.ndarray, thing_m: float = THING_M) -> Vote | None:
    """The pose that most things agree on; None where no two pairs agree.

    Parameters
    ----------
    alike : (A, 2) rows of landmarks that look alike, those first that do most.
    thing_m : what is nearer together may be one thing of which there are copies.

    """
    alike = alike[:MOST_PAIRS]
    pairs = _of_equal_height(ours, theirs, alike, thing_m)
    found, proposed = _best(ours, theirs, pairs, thing_m)
    if found is None:
        return None
    pose, covariance, agree = found
    things, runner_up, chance = count_things(ours.places[agree[:, 0]], thing_m), 2, float(proposed)
    middle = theirs.places[agree[:, 1], :2].mean(axis=0)
    if things > runner_up:
        explained = distances(ours, theirs, pairs.rows, pose, covariance) <= IN_SPACE
        other, _ = _best(ours, theirs, pairs.of(~explained), thing_m)
        if other is not None:
            runner_up = max(runner_up, count_things(ours.places[other[2][:, 0]], thing_m))
        p = _by_chance(ours, theirs, pose, covariance, agree)
        others = proposed - len(agree) * (len(agree) - 1) // 2
        chance = (1 + max(others, 0)) * _tail(things - runner_up, len(alike) - 2, p)
    return Vote(pose, covariance, agree, things, runner_up, middle, chance)


def pairs_alike(ours: np.ndarray, theirs: np.ndarray, gate: float) -> np.ndarray:
    """(A, 2) rows of descriptors (n, 128) and (m, 128) with E <= `gate`, most alike first."""
    squared = squared_distances(ours, theirs)
    rows = np.argwhere(squared <= gate)
    return rows[np.argsort(squared[tuple(rows.T)], kind="stable")]


def distances(
    ours: Points, theirs: Points, rows: np.ndarray, pose: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """(m,): D of pairs of landmarks `rows` (m, 2) where the pieces lie so to each other."""
    apart, spread, jacobian = _residuals(ours, theirs, rows, pose)
    spread = spread + jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return np.einsum("ni,ni->n", apart, np.linalg.solve(spread, apart[:, :, None])[:, :, 0])


def count_things(places: np.ndarray, thing_m: float) -> int:
    """How many of `places` (n, 3) are `thing_m` apart in the plane from those counted before."""
    counted = np.empty((0, 2))
    for place in places[:, :2]:
        if not len(counted) or np.hypot(*(counted - place).T).min() >= thing_m:
            counted = np.vstack([counted, place])
    return len(counted)


def _tail(k: int, trials: int, p: float) -> float:
    """P(Bin(trials, p) >= k)."""
    if k <= 0:
        return 1.0
    return float(bdtrc(k - 1, trials, p)) if k <= trials else 0.0


def _of_equal_height(ours: Points, theirs: Points, alike: np.ndarray, thing_m: float) -> _Pairs:
    """The pairs (A, 2) whose heights differ by no more than they are uncertain."""
    a, b = alike.T
    height = ours.places[a, 2] - theirs.places[b, 2]
    is_equal = height**2 <= IN_HEIGHT * (ours.covariances[a, 5] + theirs.covariances[b, 5])
    a, b = alike[is_equal].T
    places = _as_complex(ours.places[a])
    is_near = np.abs(places[:, None] - places) < thing_m
    variances = _largest_variance(ours.covariances[a]) + _largest_variance(theirs.covariances[b])
    return _Pairs(
        alike[is_equal],
        places,
        _as_complex(theirs.places[b]),
        variances,
        1 / np.maximum(is_near.sum(axis=1), 1),
    )


def _best(
    ours: Points, theirs: Points, pairs: _Pairs, thing_m: float
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray] | None, int]:
    """Pose, covariance and rows (n, 2) of what agrees; and of how many poses it is the best.

    None where less than two pairs agree on any.
    """
    one, other = _equally_far(pairs, thing_m)
    if not len(one):
        return None, 0
    scores = np.empty(len(one))
    step = max(1, AT_A_TIME // len(pairs.rows))
    for first in range(0, len(one), step):
        some = slice(first, first + step)
        scores[some] = _evidence(pairs, one[some], other[some])
    winner = int(np.argmax(scores))
    start, agree = _proposed(pairs, one[winner], other[winner])
    return _fitted(ours, theirs, pairs.rows, start, pairs.rows[agree], thing_m), len(one)


def _equally_far(pairs: _Pairs, thing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Each two of the pairs, (H,) and (H,), whose landmarks are as far apart in both pieces."""
    one, other = np.triu_indices(len(pairs.rows), 1)
    ours = np.abs(pairs.ours[one] - pairs.ours[other])
    theirs = np.abs(pairs.theirs[one] - pairs.theirs[other])
    variances = pairs.variances[one] + pairs.variances[other]
    are_equal = (ours - theirs) ** 2 <= IN_HEIGHT * variances
    chosen = are_equal & (np.minimum(ours, theirs) >= thing_m)
    return one[chosen], other[chosen]


def _moved(pairs: _Pairs, one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, ...]:
    """Turn (H,) and shift (H,) of the poses that two pairs each propose, complex.

    And (H, m): how far every pair is from agreeing, squared, and the variance of that.
    """
    turns = (pairs.ours[other] - pairs.ours[one]) * np.conj(pairs.theirs[other] - pairs.theirs[one])
    turns /= np.abs(turns)
    middle = 0.5 * (pairs.theirs[one] + pairs.theirs[other])
    shifts = 0.5 * (pairs.ours[one] + pairs.ours[other]) - turns * middle
    own = pairs.variances[one] + pairs.variances[other]
    by_turn = own / np.abs(pairs.theirs[other] - pairs.theirs[one]) ** 2
    levers = np.abs(pairs.theirs - middle[:, None]) ** 2
    variances = pairs.variances + own[:, None] / 4 + by_turn[:, None] * levers
    apart = pairs.ours - turns[:, None] * pairs.theirs - shifts[:, None]
    return turns, shifts, apart.real**2 + apart.imag**2, variances


def _evidence(pairs: _Pairs, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(H,): logarithm of how much more likely what agrees does so by the pose than by chance.

    By chance it would lie anywhere among the landmarks of ours; pairs of one thing share one vote.
    """
    _, _, squared, variances = _moved(pairs, one, other)
    everywhere = 2 * np.var(pairs.ours) + np.finfo(float).tiny
    worth = np.log(np.maximum(everywhere / (IN_PLANE * variances), 1))
    return np.where(squared <= IN_PLANE * variances, worth, 0) @ pairs.shares


def _proposed(pairs: _Pairs, one: int, other: int) -> tuple[np.ndarray, np.ndarray]:
    """The pose (3,) that two pairs propose, and which agree (m,)."""
    turn, shift, squared, variances = _moved(pairs, np.array([one]), np.array([other]))
    pose = np.array([shift[0].real, shift[0].imag, np.angle(turn[0])])
    return pose, squared[0] <= IN_PLANE * variances[0]


def _fitted(
    ours: Points,
    theirs: Points,
    rows: np.ndarray,
    pose: np.ndarray,
    agree: np.ndarray,
    thing_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Least squares from `pose` over what agrees, until that stays the same."""
    for _ in range(ROUNDS):
        if count_things(ours.places[agree[:, 0]], thing_m) < 2:
            return None
        pose, covariance = _least_squares(ours, theirs, agree, pose)
        squared = distances(ours, theirs, rows, pose, covariance)
        before, agree = agree, one_to_one(rows, squared, IN_SPACE)
        if np.array_equal(before, agree):
            break
    if count_things(ours.places[agree[:, 0]], thing_m) < 2:
        return None
    return pose, covariance, agree


def _least_squares(
    ours: Points, theirs: Points, rows: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One step from `pose` (3,), and the covariance (3, 3), of pairs `rows` (n, 2)."""
    apart, spread, jacobian = _residuals(ours, theirs, rows, pose)
    weighted = np.linalg.solve(spread, jacobian)
    covariance = np.linalg.inv(np.einsum("nij,nik->jk", jacobian, weighted))
    return pose - covariance @ np.einsum("nij,ni->j", weighted, apart), covariance


def _residuals(
    ours: Points, theirs: Points, rows: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What pairs are apart (n, 3), its covariance (n, 3, 3) and its derivative (n, 3, 3)."""
    a, b = rows.T
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    turned = theirs.places[b] @ turn.T
    apart = ours.places[a] - turned - [pose[0], pose[1], 0]
    spread = unpack(ours.covariances[a]) + turn @ unpack(theirs.covariances[b]) @ turn.T
    jacobian = np.zeros((len(rows), 3, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = -1
    jacobian[:, 0, 2], jacobian[:, 1, 2] = turned[:, 1], -turned[:, 0]
    return apart, spread, jacobian


def one_to_one(rows: np.ndarray, squared: np.ndarray, limit: float) -> np.ndarray:
    """Of the pairs `rows` (m, 2) with D up to `limit` the closest, each landmark in one at most."""
    order = np.argsort(squared, kind="stable")
    order = order[squared[order] <= limit]
    for column in (0, 1):
        _, first = np.unique(rows[order, column], return_index=True)
        order = order[np.sort(first)]
    return rows[np.sort(order)]


def _by_chance(
    ours: Points, theirs: Points, pose: np.ndarray, covariance: np.ndarray, agree: np.ndarray
) -> float:
    """p: the probability that two landmarks that have nothing to do with each other agree."""
    a, b = spread(len(ours.places)), spread(len(theirs.places))
    rows = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    moved = theirs.places[:, :2] @ [[cos, sin], [-sin, cos]] + pose[:2]
    squared = np.sum((ours.places[rows[:, 0], :2] - moved[rows[:, 1]]) ** 2, axis=1)
    variances = _largest_variance(ours.covariances)[rows[:, 0]]
    variances = variances + _largest_variance(theirs.covariances)[rows[:, 1]]
    near = moved[rows[:, 1]] - moved[agree[:, 1]].mean(axis=0)
    variances += covariance[0, 0] + covariance[1, 1] + covariance[2, 2] * np.sum(near**2, axis=1)
    width = len(theirs.places)
    is_pair = np.isin(rows @ [width, 1], agree @ [width, 1])
    close = rows[~is_pair & (squared <= IN_SPACE * variances)]
    squared = distances(ours, theirs, close, pose, covariance)
    return (1 + np.count_nonzero(squared <= IN_SPACE)) / (1 + np.count_nonzero(~is_pair))


def spread(count: int) -> np.ndarray:
    """At most `MOST_CROSSED` of the numbers below `count`, evenly."""
    kept = min(count, MOST_CROSSED)
    return np.arange(kept) * count // max(kept, 1)


def _largest_variance(covariances: np.ndarray) -> np.ndarray:
    """(n,): of (n, 6), in the direction of the plane in which it is largest."""
    xx, xy, yy = covariances[:, 0], covariances[:, 1], covariances[:, 3]
    return 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)


def _as_complex(places: np.ndarray) -> np.ndarray:
    return places[:, 0] + 1j * places[:, 1]
