"""The landmark columns all particles share, and the lazy ancestry that spares copying them.

The observation that creates a landmark in at least one particle makes one column: one descriptor,
one id, and per particle a mean and a covariance. Resampling copies nothing: a column remembers the
generation in which its planes were last written, `rows` maps today's particles to the rows of that
generation, and the column is gathered only when it is next observed.
"""

from typing import Any

import numpy as np

from msg_defs.types import DESCRIPTOR_SIZE
from multi_robot_slam.filter import kernels
from multi_robot_slam.filter.reserved import enlarged, reserved
from multi_robot_slam.models import parallel

FREE = -1
"""Id of a column that holds no landmark."""

MOST_IDS = 2**31 - 1
"""Observations that can be numbered: months of three robots, hours of a thousand a frame."""

ROOM = 2**27
"""Bytes of planes to set aside at the start; what is not written takes no memory."""


class Landmarks:
    """Columns for M particles; grows without a pause, reuses what no particle holds any more.

    Attributes
    ----------
    planes : (N, 9, M) mean x y z [m] and covariance xx xy xz yy yz zz [m^2].
    descriptors : (N, 128) float32.
    boxes : (N, 4) float64: x low, x high, y low, y high, see `kernels.bound`.
    ids : (N,) int32, ascending in the order of creation; FREE where the column is unused.
    pieces : (N,) int32: the piece of the map that each belongs to, in whose frame it is.

    """

    def __init__(self, particles: int, dtype: type = np.float32, capacity: int | None = None):
        if capacity is None:
            capacity = int(np.clip(ROOM / (kernels.PLANES * 4 * particles), 16, 1024))
        planes = reserved((capacity, kernels.PLANES, particles), dtype)
        self._hold(planes, np.empty((capacity, DESCRIPTOR_SIZE), np.float32))

    def _hold(self, planes: np.ndarray, descriptors: np.ndarray) -> None:
        """Begin with these `planes` (N, 9, M) and `descriptors` (N, 128), all columns free."""
        capacity, _, particles = planes.shape
        self.planes = planes
        self.descriptors = descriptors
        self.boxes = np.empty((capacity, 4))
        self.ids = np.full(capacity, FREE, np.int32)
        self.pieces = np.zeros(capacity, np.int32)
        self.top = 0
        self._next_id = 0
        self._partial = np.zeros(capacity, bool)
        self._generations = np.zeros(capacity, np.int32)
        self._rows = np.arange(particles, dtype=np.int32)[None].copy()
        self._current = 0
        self._reserved = np.empty(0, int)

    def __getstate__(self) -> dict[str, Any]:
        """All columns that were ever used: what is set aside beyond them holds nothing."""
        columns = ("planes", "descriptors", "boxes", "ids", "pieces", "_partial", "_generations")
        used = {name: getattr(self, name)[: self.top] for name in columns}
        return {**self.__dict__, **used}

    @classmethod
    def holding(
        cls,
        ids: np.ndarray,
        planes: np.ndarray,
        descriptors: np.ndarray,
        next_id: int,
        pieces: np.ndarray | int = 0,
    ) -> "Landmarks":
        """A map that holds the landmarks `ids` (N,) in its first N columns, all up to date.

        Their boxes are yet to be measured, see `bound`. A column that no particle has is free.

        Parameters
        ----------
        planes : (N, 9, M), `kernels.NO_LANDMARK` where a particle does not have a landmark. They
            are not copied and belong to the map from now on; from `reserved` they never are.
        descriptors : (N, 128) float32, which belong to the map, too.
        next_id : of the landmark that is created next, larger than all `ids`.
        pieces : (N,), or that of all.
        """
        landmarks = cls.__new__(cls)
        landmarks._hold(planes, descriptors)
        landmarks.ids[:] = ids
        landmarks.pieces[:] = pieces
        landmarks.top = len(ids)
        landmarks._next_id = next_id
        landmarks._release_unowned(np.arange(len(ids)))
        return landmarks

    def reserve(self, wanted: int) -> np.ndarray:
        """Columns (B,) for landmarks that `wanted` observations may create; then call `commit`.

        `OverflowError` once there have been more observations than there are ids.
        """
        if self._next_id + wanted > MOST_IDS:
            raise OverflowError(
                f"{MOST_IDS} observations have been numbered; start the filter anew"
            )
        free = np.flatnonzero(self.ids[: self.top] == FREE)[:wanted]
        fresh = np.arange(self.top, self.top + wanted - len(free))
        self.top += len(fresh)
        while self.top > len(self.ids):
            self._grow()
        columns = np.concatenate([free, fresh])
        self.ids[columns] = self._next_id + np.arange(wanted)
        self._next_id += wanted
        self._reserved = columns
        self._generations[columns] = self._current
        return columns

    def commit(
        self, columns: np.ndarray, created: np.ndarray, descriptors: np.ndarray, piece: int = 0
    ) -> None:
        """Keep the reserved columns that were `created` (B,) in some particle; free the others."""
        self.descriptors[columns] = descriptors
        self.pieces[columns] = piece
        self._partial[columns] = created < self.planes.shape[2]
        self._release(columns[created == 0])
        self._reserved = columns[:0]

    def release_reserved(self) -> None:
        """Free the columns that were reserved and not committed."""
        self._release(self._reserved)
        self._reserved = self._reserved[:0]

    def near(self, box: np.ndarray) -> np.ndarray:
        """Columns whose box meets `box` (4,), ascending; no other can lie inside the gate."""
        return kernels.near(self.boxes, self.ids[: self.top], box)

    def bound(self, columns: np.ndarray, gate: float) -> None:
        """Measure the boxes of `columns`, which must be up to date, for the gate D_0."""
        kernels.bound(self.planes, columns, np.sqrt(gate), self.boxes)

    def bring_up_to_date(self, columns: np.ndarray, threads: int = 1) -> None:
        """Gather the planes of `columns` (distinct) written before the last resampling."""
        stale = columns[self._generations[columns] != self._current]
        generations = self._generations[stale]
        parallel.over(
            kernels.gather, len(stale), 1, threads, self.planes, stale, self._rows, generations
        )
        self._generations[stale] = self._current

    def resample(self, ancestors: np.ndarray) -> None:
        """Particle m continues as particle ancestors[m] (ascending); no plane is copied."""
        alive = self.alive()
        used = np.flatnonzero(np.bincount(self._generations[alive]))
        kernels.compose(self._rows, used, ancestors)
        self._release_unowned(alive[self._partial[alive]])
        if self._current in used:
            self._open_generation(used)

    @property
    def next_id(self) -> int:
        """Of the landmark that is created next."""
        return self._next_id

    def alive(self) -> np.ndarray:
        """Columns that hold a landmark in at least one particle, ascending."""
        return np.flatnonzero(self.ids[: self.top] != FREE)

    def columns_of(self, ids: np.ndarray) -> np.ndarray:
        """The columns (N,) that hold the landmarks `ids` (N,), all of which live."""
        columns = self.alive()
        order = np.argsort(self.ids[columns])
        return columns[order[np.searchsorted(self.ids[columns], ids, sorter=order)]]

    def rows_of(self, columns: np.ndarray, particles: np.ndarray) -> np.ndarray:
        """(N, n): where the planes of `columns` (N,) have what the particles (n,) hold."""
        return self._rows[self._generations[columns][:, None], particles]

    def planes_of(self, columns: np.ndarray, particles: np.ndarray) -> np.ndarray:
        """(N, 9, n): a copy of what the particles (n,) hold in `columns` (N,)."""
        rows = self.rows_of(columns, particles)
        return self.planes[columns[:, None], :, rows].transpose(0, 2, 1)

    def of_particle(self, particle: int) -> tuple[np.ndarray, np.ndarray]:
        """Columns (N,) that `particle` has and their planes (N, 9), in order of creation."""
        columns = self.alive()
        columns = columns[np.argsort(self.ids[columns])]
        values = self.planes[columns, :, self._rows[self._generations[columns], particle]]
        has = values[:, 0] < kernels.FAR / 2
        return columns[has], values[has]

    def mixture(self, columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Mean and covariance (N, 9) of `columns` (N,) over all particles that have them.

        `weights` (M,) of the particles. How the means differ from particle to particle is in it.
        """
        result = np.zeros((len(columns), kernels.PLANES))
        rows = self._rows[self._generations[columns]]
        kernels.mix(self.planes, columns, rows, weights, result)
        return result

    def forget(self, ids: np.ndarray) -> None:
        """Free the columns of those of the landmarks `ids` that there are."""
        columns = self.alive()
        self._release(columns[np.isin(self.ids[columns], ids)])

    def _release_unowned(self, columns: np.ndarray) -> None:
        owners = kernels.count_owners(self.planes, columns, self._rows, self._generations[columns])
        self._partial[columns] = owners < self.planes.shape[2]
        self._release(columns[owners == 0])

    def _release(self, columns: np.ndarray) -> None:
        self.ids[columns] = FREE
        self._partial[columns] = False

    def _open_generation(self, used: np.ndarray) -> None:
        is_used = np.zeros(len(self._rows) + 1, bool)
        is_used[used] = True
        self._current = int(np.argmin(is_used))
        if self._current == len(self._rows):
            self._rows = enlarged(self._rows)
        self._rows[self._current] = np.arange(self._rows.shape[1])

    def _grow(self) -> None:
        old = len(self.ids)
        self.planes = enlarged(self.planes)
        self.descriptors = enlarged(self.descriptors)
        self.boxes = enlarged(self.boxes)
        self.ids = enlarged(self.ids)
        self.ids[old:] = FREE
        self.pieces = enlarged(self.pieces)
        self._partial = enlarged(self._partial)
        self._generations = enlarged(self._generations)
