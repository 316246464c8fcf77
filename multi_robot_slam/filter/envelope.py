"""Cholesky factorisation H = L L^T of a sparse matrix of poses, inside its envelope.

Where two poses share no measurement their block of H is zero. L fills each row from its first
block that is not zero up to the diagonal, the envelope, and nothing else (George, Liu: Computer
solution of large sparse positive definite systems, 1981). Reverse Cuthill-McKee brings poses that
saw the same landmarks together, however much later a loop was closed, which keeps the envelope
small: for a tour of a building a fifth of the triangle, and a twentieth of its arithmetic. Rows and
columns are handled in tiles, each product of tiles by BLAS.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from threadpoolctl import ThreadpoolController

from multi_robot_slam.filter.smoothing_problem import Problem

TILE = 24
"""Poses of a tile: large enough for BLAS to be fast, small enough to follow the envelope."""

one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")
"""BLAS with one thread: the same bytes on any number of cores, and no waiting for a busy one."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """Where L is not zero, in the order of elimination, and where that is kept.

    Of the rows of tile t the columns begins[t] .. edges[t + 1] - 1 are kept, one row after the
    other, in one array for all tiles.
    """

    order: np.ndarray
    """(P,): the poses in their order."""
    place: np.ndarray
    """(P,): place of each pose in the order."""
    edges: np.ndarray
    """(T + 1,): tile t has the rows edges[t] .. edges[t + 1] - 1, three for each pose."""
    begins: np.ndarray
    """(T,): first column of the tile's rows, an edge."""
    origins: np.ndarray
    """(3 P,): row r, column c is element origins[r] + c."""
    size: int
    """Number of elements."""

    @property
    def rows(self) -> np.ndarray:
        """(3 P,): row of x, y and yaw of each pose in turn, by place, among rows by pose."""
        return (3 * self.order[:, None] + np.arange(3)).ravel()

    def tiles(self, elements: np.ndarray) -> list[np.ndarray]:
        """Views of the rows of each tile, (rows, columns kept)."""
        return [
            elements[self.origins[start] + begin : self.origins[stop - 1] + stop].reshape(
                stop - start, stop - begin
            )
            for start, stop, begin in zip(self.edges[:-1], self.edges[1:], self.begins, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Factor:
    """L, in the order of elimination."""

    envelope: Envelope
    tiles: list[np.ndarray]
    """The rows of each tile left of the diagonal."""
    inverses: list[np.ndarray]
    """Inverse of each tile on the diagonal of L."""

    def solve_lower(self, right: np.ndarray) -> np.ndarray:
        """L^-1 of `right` (3 P, ...), whose rows are in the order of the poses."""
        result = right[self.envelope.rows]
        for rows, left, tile, inverse in self._by_tile():
            result[rows] = inverse @ (result[rows] - tile @ result[left])
        return result

    def solve_upper(self, right: np.ndarray) -> np.ndarray:
        """L^-T of `right` (3 P, ...), in its precision; the result's rows are by pose."""
        solved = right.copy()
        for rows, left, tile, inverse in reversed(self._by_tile()):
            solved[rows] = inverse.T.astype(right.dtype, copy=False) @ solved[rows]
            solved[left] -= tile.T.astype(right.dtype, copy=False) @ solved[rows]
        result = np.empty_like(solved)
        result[self.envelope.rows] = solved
        return result

    def _by_tile(self) -> list[tuple[slice, slice, np.ndarray, np.ndarray]]:
        edges, begins = self.envelope.edges, self.envelope.begins
        return [
            (slice(edges[t], edges[t + 1]), slice(begins[t], edges[t]), tile, inverse)
            for t, (tile, inverse) in enumerate(zip(self.tiles, self.inverses, strict=True))
        ]


def factorise(envelope: Envelope, elements: np.ndarray) -> Factor:
    """Cholesky factor of the matrix of which `elements` (size,) are the envelope; in place.

    Of the tiles on the diagonal only the lower triangle is read. Raises `LinAlgError` if the matrix
    is not positive definite.
    """
    edges, begins = envelope.edges, envelope.begins
    lefts, inverses = [], []
    for i, tile in enumerate(envelope.tiles(elements)):
        left = tile[:, : edges[i] - begins[i]]
        for k in range(begins[i] // edges[1], i):
            common = max(begins[i], begins[k])
            own = left[:, edges[k] - begins[i] : edges[k + 1] - begins[i]]
            before = left[:, common - begins[i] : edges[k] - begins[i]]
            own[:] = (own - before @ lefts[k][:, common - begins[k] :].T) @ inverses[k].T
        diagonal = tile[:, left.shape[1] :] - left @ left.T
        root = cholesky(diagonal, lower=True, check_finite=False)
        unit = np.eye(len(root))
        inverses.append(solve_triangular(root, unit, lower=True, check_finite=False))
        lefts.append(left)
    return Factor(envelope, lefts, inverses)


def envelope_of(problem: Problem) -> Envelope:
    """The envelope of the information of a problem's poses, landmarks out."""
    order = _order(problem)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    edges = np.append(np.arange(0, len(order), TILE), len(order))
    first = np.minimum.reduceat(_first_columns(problem, place), edges[:-1])
    begins, edges = 3 * (first // TILE) * TILE, 3 * edges
    widths = np.repeat(edges[1:] - begins, np.diff(edges))
    ends = np.cumsum(widths)
    origins = ends - widths - np.repeat(begins, np.diff(edges))
    return Envelope(order, place, edges, begins, origins, int(ends[-1]))


def _order(problem: Problem) -> np.ndarray:
    """(P,) the poses by reverse Cuthill-McKee of the graph of poses and landmarks."""
    poses, size = len(problem.robots), len(problem.robots) + len(problem.ids)
    moving = problem.seen_from >= 0
    following = np.flatnonzero(problem.previous >= 0)
    one = [problem.seen_from[moving], following, problem.sighted.seen_from]
    other = [poses + problem.landmarks[moving], problem.previous[following], problem.sighted.seen]
    one, other = np.concatenate(one), np.concatenate(other)
    rows, columns = np.append(one, other), np.append(other, one)
    graph = csr_array((np.ones(len(rows), np.int8), (rows, columns)), (size, size))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
    return order[order < poses]


def _first_columns(problem: Problem, place: np.ndarray) -> np.ndarray:
    """(P,) place of the first pose that the pose at each place shares a measurement with."""
    moving = problem.seen_from >= 0
    at, landmarks = place[problem.seen_from[moving]], problem.landmarks[moving]
    earliest = np.full(len(problem.ids), len(place))
    np.minimum.at(earliest, landmarks, at)
    first = np.arange(len(place))
    np.minimum.at(first, at, earliest[landmarks])
    following = np.flatnonzero(problem.previous >= 0)
    for one, other in (
        (place[following], place[problem.previous[following]]),
        (place[problem.sighted.seen_from], place[problem.sighted.seen]),
    ):
        np.minimum.at(first, np.maximum(one, other), np.minimum(one, other))
    return first
