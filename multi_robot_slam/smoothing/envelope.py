"""Cholesky factorisation H = L L^T of a sparse matrix of poses, inside its envelope.

Where two poses share no measurement their block of H is zero, a landmark's elimination ties all
poses that saw it. A few landmarks, the hubs, are kept as unknowns instead, after all poses (`hubs`
chooses them), those seen early last. L fills each row from its first block that is not zero up to
the diagonal, the envelope, and nothing else (George, Liu: Computer solution of large sparse
positive definite systems, 1981). Reverse Cuthill-McKee brings poses that saw the same landmarks
together, however late a loop was closed, which keeps the envelope small: for a tour of a
building a fifth of the triangle, and a twentieth of its arithmetic. Rows and columns are handled in
tiles, each product of tiles by BLAS.

Unknowns are the A + P poses, x, y and yaw, the a centres of the prior, x and y, and the H hubs, x,
y and z, in this order; U of them. They are eliminated in another: the poses of records, hubs,
anchors, and the centres last, since the prior ties anchors and centres to each other.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from multi_robot_slam.smoothing.kernels import tiles
from multi_robot_slam.smoothing.problem import Problem

TILE = 32
"""Poses of a tile: large enough for BLAS to be fast, small enough to follow the envelope."""


class Layout(NamedTuple):
    """T tiles of rows, and where their elements are kept."""

    edges: np.ndarray
    """(T + 1,): tile t has the rows edges[t] .. edges[t + 1] - 1."""
    first_tiles: np.ndarray
    """(T,): first tile whose columns the tile's rows have."""
    offsets: np.ndarray
    """(T + 1,): elements before each tile, and their number."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """Where L is not zero, in the order of elimination, and where that is kept.

    Of the rows of tile t the columns begins[t] .. edges[t + 1] - 1 are kept, one column after the
    other, in one array for all tiles.
    """

    hubs: np.ndarray
    """(H,): the landmarks that are not eliminated."""
    order: np.ndarray
    """(U,): the unknowns in their order of elimination."""
    rows_of: np.ndarray
    """(U,): first row of each unknown in that order."""
    places: np.ndarray
    """(rows,): the rows by unknown among the rows by place."""
    layout: Layout

    @property
    def edges(self) -> np.ndarray:
        """(T + 1,): first row of each tile, and the number of rows."""
        return self.layout.edges

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(self.layout.offsets[-1])

    @property
    def begins(self) -> np.ndarray:
        """(T,): first column of the tile's rows, an edge."""
        return self.edges[self.layout.first_tiles]

    @property
    def multiplications(self) -> int:
        """Of the factorisation, but for the tiles on the diagonal."""
        common = np.maximum(self.begins[:, None], self.begins)
        inside = np.clip(self.edges[None, :-1] - common, 0, None) * np.diff(self.edges)
        return int(np.diff(self.edges) @ np.tril(inside).sum(axis=1))

    def addresses(self) -> tuple[np.ndarray, np.ndarray]:
        """(rows,) each: row r, column c is element origins[r] + c heights[r]."""
        heights = np.repeat(np.diff(self.edges), np.diff(self.edges))
        inside = np.arange(len(heights)) - np.repeat(self.edges[:-1], np.diff(self.edges))
        first = np.repeat(self.layout.offsets[:-1], np.diff(self.edges)) + inside
        return first - heights * np.repeat(self.begins, np.diff(self.edges)), heights


@dataclass(frozen=True, eq=False)
class Factor:
    """L, in the order of elimination."""

    envelope: Envelope
    elements: np.ndarray
    """(`Envelope.size`,): L, inverted where it has tiles on the diagonal."""

    @property
    def size(self) -> int:
        """The number of rows."""
        return int(self.envelope.edges[-1])

    def solve_lower(self, right: np.ndarray) -> np.ndarray:
        """L^-1 (rows, ...), by place, of `right`, by unknown; what it lacks at the end is zero."""
        result = np.zeros((self.size, *right.shape[1:]))
        result[self.envelope.places[: len(right)]] = right
        tiles.solve_lower(self.elements, self.envelope.layout, result.reshape(self.size, -1))
        return result

    def solve_upper(self, right: np.ndarray) -> np.ndarray:
        """L^-T of `right` (rows, ...), by place, in its precision; the result is by unknown."""
        solved = np.array(right, order="C")
        elements = self.elements.astype(right.dtype, copy=False)
        tiles.solve_upper(elements, self.envelope.layout, solved.reshape(self.size, -1))
        return solved[self.envelope.places]


def factorise(envelope: Envelope, elements: np.ndarray) -> Factor:
    """Cholesky factor of the matrix of which `elements` (size,) are the envelope; in place.

    Of the tiles on the diagonal only the lower triangle is read. Raises `LinAlgError` if the matrix
    is not positive definite.
    """
    if not tiles.factorise(elements, envelope.layout):
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return Factor(envelope, elements)


def envelope_of(problem: Problem, hubs: np.ndarray) -> Envelope:
    """The envelope of the information of poses, centres and `hubs` (H,), other landmarks out."""
    is_hub = np.zeros(len(problem.ids), bool)
    is_hub[hubs] = True
    views = len(problem.columns) - 1
    order = _order(problem, is_hub)
    earliest = _earliest(problem, _inverse(order, views))
    hubs_in_order = views + np.argsort(-earliest[hubs], kind="stable")
    anchors = np.arange(len(problem.anchors))
    order = np.concatenate([order, hubs_in_order, anchors, np.arange(problem.poses, views)])
    place = _inverse(order, len(order))
    first = _first_places(problem, hubs, is_hub, place)
    tied = len(order) - len(anchors) - len(problem.prior.rows)
    starts = np.append(np.arange(0, tied, TILE), np.arange(tied, len(order), 3 * TILE // 2))
    reached = np.minimum.reduceat(first, starts)
    first_tiles = np.searchsorted(starts, reached, side="right") - 1
    widths = np.full(len(order), 3)
    widths[problem.poses : views] = 2
    ends = np.cumsum(widths[order])
    edges = np.append((ends - widths[order])[starts], ends[-1])
    rows_of = (ends - widths[order])[place]
    inside = np.arange(ends[-1]) - np.repeat(np.cumsum(widths) - widths, widths)
    kept = np.diff(edges) * (edges[1:] - edges[first_tiles])
    return Envelope(
        hubs=hubs,
        order=order,
        rows_of=rows_of,
        places=np.repeat(rows_of, widths) + inside,
        layout=Layout(edges, first_tiles, np.append(0, np.cumsum(kept))),
    )


def _order(problem: Problem, is_hub: np.ndarray) -> np.ndarray:
    """(P,) the records' poses by reverse Cuthill-McKee of the graph of poses and landmarks."""
    poses, size = problem.poses, problem.poses + len(problem.ids)
    out = (problem.seen_from < poses) & ~is_hub[problem.landmarks]
    own = len(problem.anchors) + np.arange(len(problem.previous))
    landmarks, sighted = poses + problem.landmarks[out], problem.sighted
    one = np.concatenate([problem.seen_from[out], own, sighted.seen_from])
    other = np.concatenate([landmarks, problem.previous, sighted.seen])
    rows, columns = np.append(one, other), np.append(other, one)
    graph = csr_array((np.ones(len(rows), np.int8), (rows, columns)), (size, size))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
    return order[(order >= len(problem.anchors)) & (order < poses)]


def _inverse(order: np.ndarray, size: int) -> np.ndarray:
    """(size,) the place of each in the order; of those that are not in it: its end."""
    place = np.full(size, len(order))
    place[order] = np.arange(len(order))
    return place


def _earliest(problem: Problem, place: np.ndarray) -> np.ndarray:
    """(N,) place of the first view that saw each landmark."""
    earliest = np.full(len(problem.ids), len(place) - 1)
    np.minimum.at(earliest, problem.landmarks, place[problem.seen_from])
    return earliest


def _first_places(
    problem: Problem, hubs: np.ndarray, is_hub: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """(U,) place of the first unknown that the one at each place shares a measurement with."""
    earliest, views = _earliest(problem, place), len(problem.columns) - 1
    first = np.arange(len(place))
    own = len(problem.anchors) + np.arange(len(problem.previous))
    sighted, seen, of_hub = problem.sighted, problem.landmarks, is_hub[problem.landmarks]
    hub_places = np.empty(len(problem.ids), np.int64)
    hub_places[hubs] = place[views:]
    for one, other in (
        (place[own], place[problem.previous]),
        (place[sighted.seen_from], place[sighted.seen]),
        (place[problem.seen_from[~of_hub]], earliest[seen[~of_hub]]),
        (place[problem.seen_from[of_hub]], hub_places[seen[of_hub]]),
    ):
        np.minimum.at(first, np.maximum(one, other), np.minimum(one, other))
    tied = np.append(place[: len(problem.anchors)], place[problem.poses : views])
    first[tied] = np.minimum(first[tied], tied.min(initial=len(place)))
    return first
