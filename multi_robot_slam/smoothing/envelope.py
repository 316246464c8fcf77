"""Cholesky factorisation H = L L^T of a sparse matrix of poses, inside its envelope.

Where two poses share no measurement their block of H is zero, a landmark's elimination ties all
poses that saw it. A few landmarks, the hubs, are kept as unknowns instead, after all poses (`hubs`
chooses them), those seen early last. L fills each row from its first block that is not zero up to
the diagonal, the envelope, and nothing else (George, Liu: Computer solution of large sparse
positive definite systems, 1981). Reverse Cuthill-McKee brings poses that saw the same landmarks
together, however late a loop was closed, which keeps the envelope small: for a tour of a
building a fifth of the triangle, and a twentieth of its arithmetic. Rows and columns are handled in
tiles, each product of tiles by BLAS.

Unknowns have three rows each: the P poses x, y and yaw, then the H hubs x, y and z; U = P + H.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from multi_robot_slam.smoothing.problem import Problem

TILE = 24
"""Unknowns of a tile: large enough for BLAS to be fast, small enough to follow the envelope."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """Where L is not zero, in the order of elimination, and where that is kept.

    Of the rows of tile t the columns begins[t] .. edges[t + 1] - 1 are kept, one row after the
    other, in one array for all tiles.
    """

    hubs: np.ndarray
    """(H,): the landmarks that are not eliminated."""
    order: np.ndarray
    """(U,): the unknowns in their order, poses before hubs."""
    place: np.ndarray
    """(U,): place of each unknown in the order."""
    edges: np.ndarray
    """(T + 1,): tile t has the rows edges[t] .. edges[t + 1] - 1, three for each unknown."""
    begins: np.ndarray
    """(T,): first column of the tile's rows, an edge."""
    origins: np.ndarray
    """(3 U,): row r, column c is element origins[r] + c."""
    size: int
    """Number of elements."""

    @property
    def rows(self) -> np.ndarray:
        """(3 U,): the rows by place among the rows by unknown."""
        return (3 * self.order[:, None] + np.arange(3)).ravel()

    @property
    def places(self) -> np.ndarray:
        """(3 U,): the rows by unknown among the rows by place."""
        return (3 * self.place[:, None] + np.arange(3)).ravel()

    @property
    def multiplications(self) -> int:
        """Of the factorisation, but for the tiles on the diagonal."""
        common = np.maximum(self.begins[:, None], self.begins)
        inside = np.clip(self.edges[None, :-1] - common, 0, None) * np.diff(self.edges)
        return int(np.diff(self.edges) @ np.tril(inside).sum(axis=1))

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

    @property
    def size(self) -> int:
        """3 U, the number of rows."""
        return int(self.envelope.edges[-1])

    def solve_lower(self, right: np.ndarray) -> np.ndarray:
        """L^-1 (3 U, ...), by place, of `right` (3 P, ...), by pose, which is zero for the hubs."""
        result = np.zeros((self.size, *right.shape[1:]))
        result[self.envelope.places[: len(right)]] = right
        for rows, left, tile, inverse in self._by_tile():
            result[rows] = inverse @ (result[rows] - tile @ result[left])
        return result

    def solve_upper(self, right: np.ndarray) -> np.ndarray:
        """L^-T of `right` (3 U, ...), by place, in its precision; the result is by unknown."""
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
    lefts: list[np.ndarray] = []
    inverses: list[np.ndarray] = []
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


def envelope_of(problem: Problem, hubs: np.ndarray) -> Envelope:
    """The envelope of the information of a problem's poses and `hubs` (H,), other landmarks out."""
    is_hub = np.zeros(len(problem.ids), bool)
    is_hub[hubs] = True
    order = _order(problem, is_hub)
    late_first = np.argsort(-_earliest(problem, _inverse(order))[hubs], kind="stable")
    order = np.append(order, len(order) + late_first)
    place = _inverse(order)
    edges = np.append(np.arange(0, len(order), TILE), len(order))
    first = np.minimum.reduceat(_first_columns(problem, hubs, is_hub, place), edges[:-1])
    begins, edges = 3 * (first // TILE) * TILE, 3 * edges
    widths = np.repeat(edges[1:] - begins, np.diff(edges))
    ends = np.cumsum(widths)
    origins = ends - widths - np.repeat(begins, np.diff(edges))
    return Envelope(hubs, order, place, edges, begins, origins, int(ends[-1]))


def _order(problem: Problem, is_hub: np.ndarray) -> np.ndarray:
    """(P,) the poses by reverse Cuthill-McKee of the graph of poses and eliminated landmarks."""
    poses, size = len(problem.robots), len(problem.robots) + len(problem.ids)
    out = (problem.seen_from >= 0) & ~is_hub[problem.landmarks]
    following = np.flatnonzero(problem.previous >= 0)
    landmarks, sighted = poses + problem.landmarks[out], problem.sighted
    one = np.concatenate([problem.seen_from[out], following, sighted.seen_from])
    other = np.concatenate([landmarks, problem.previous[following], sighted.seen])
    rows, columns = np.append(one, other), np.append(other, one)
    graph = csr_array((np.ones(len(rows), np.int8), (rows, columns)), (size, size))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
    return order[order < poses]


def _inverse(order: np.ndarray) -> np.ndarray:
    """The place of each in the order."""
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return place


def _earliest(problem: Problem, place: np.ndarray) -> np.ndarray:
    """(N,) place of the first pose that saw each landmark."""
    moving = problem.seen_from >= 0
    earliest = np.full(len(problem.ids), len(place) - 1)
    np.minimum.at(earliest, problem.landmarks[moving], place[problem.seen_from[moving]])
    return earliest


def _first_columns(
    problem: Problem, hubs: np.ndarray, is_hub: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """(U,) place of the first unknown that the one at each place shares a measurement with."""
    earliest = _earliest(problem, place)
    first = np.arange(len(place))
    of_hubs = place[len(problem.robots) :]
    first[of_hubs] = np.minimum(of_hubs, earliest[hubs])
    out = (problem.seen_from >= 0) & ~is_hub[problem.landmarks]
    np.minimum.at(first, place[problem.seen_from[out]], earliest[problem.landmarks[out]])
    following = np.flatnonzero(problem.previous >= 0)
    for one, other in (
        (place[following], place[problem.previous[following]]),
        (place[problem.sighted.seen_from], place[problem.sighted.seen]),
    ):
        np.minimum.at(first, np.maximum(one, other), np.minimum(one, other))
    return first
