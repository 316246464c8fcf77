"""Which landmarks are there: evidence from every look at where one should be.

What a gross error made is never seen again; what was moved is no longer seen where it was. Both
stay in the filter, where they do no harm, and out of the map. Not every look (`looks`) finds what
is there: detectors miss.

While nothing changes, any order of the h looks that found it and the x that did not is as likely as
any other, whatever the detector, so that the last m of them all fail by chance with probability

    C(h + x - m, h) / C(h + x, h)                                                              (X1)

All of this is worked out from the frames when a map is made, with what is known of the paths then;
only of settled frames the counts are kept. No step of the filter does anything for it.
"""

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from multi_robot_slam.filter.kernels import FAR
from multi_robot_slam.filter.looks import Frames, go_through
from multi_robot_slam.filter.settings import ExistenceSettings
from multi_robot_slam.filter.views import Views
from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.smoothing.aliases import Aliases

MOST_LOOKS = 20
"""As many count of those before the last ones that failed, so that what was seen for hours and then
moved goes after four, and not after two, which a passer-by is enough for."""

ALIKE_BY_CHANCE = 0.01
"""Share of the matches that another landmark may win: E_0 is chosen for no more."""


class Placed(NamedTuple):
    """Where N landmarks are, for the paths of the frames."""

    ids: np.ndarray
    """(N,) int64, ascending."""
    places: np.ndarray
    """(N, 3) float64 in `map` [m]."""
    sigmas: np.ndarray
    """(N,) float64: standard deviation in the plane [m]."""

    @classmethod
    def of(cls, ids: np.ndarray, values: np.ndarray) -> "Placed":
        """The landmarks `ids` (N,) whose means and covariances are `values` (N, 9)."""
        values = values.astype(float)
        variances = np.maximum(values[:, 3] + values[:, 6], 0)  # in single precision of any sign
        return cls(ids, values[:, :3], np.sqrt(variances))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the frames say of n landmarks."""

    ids: np.ndarray
    """(n,) int64, ascending; so the others."""
    places: np.ndarray
    """From how many places each was seen."""
    last_place: np.ndarray
    """The place from which it was seen last."""
    horizon: np.ndarray
    """The largest id there was when it was seen last."""
    found: np.ndarray
    """Looks that found it."""
    failed: np.ndarray
    """Looks that did not."""
    in_a_row: np.ndarray
    """Those of them since it was seen last."""

    @classmethod
    def nothing(cls, ids: np.ndarray) -> "Evidence":
        """Of the landmarks `ids` (n,), ascending, none of which was seen."""
        return cls(ids.astype(np.int64), *(np.zeros(len(ids), np.int64) for _ in range(6)))

    def of(self, ids: np.ndarray) -> "Evidence":
        """The same of the landmarks `ids` (N,), ascending; nothing where there is none."""
        result = Evidence.nothing(ids)
        known = np.isin(ids, self.ids)
        rows = np.searchsorted(self.ids, ids[known])
        for name in COUNTS:
            getattr(result, name)[known] = getattr(self, name)[rows]
        return result

    def renamed(self, aliases: Aliases) -> "Evidence":
        """With joined landmarks under the id that they go by.

        While one was seen under one id, looks for it under the other failed: these do not count.
        """
        if not len(aliases.among(self.ids)):
            return self
        own = aliases.of(self.ids)
        order = np.lexsort((self.horizon, own))
        ids, first, counts = np.unique(own[order], return_index=True, return_counts=True)
        last = order[first + counts - 1]
        result = Evidence(ids, *(getattr(self, name)[last].copy() for name in COUNTS))
        for name in ("places", "found"):
            getattr(result, name)[:] = np.add.reduceat(getattr(self, name)[order], first)
        before = np.add.reduceat((self.failed - self.in_a_row)[order], first)
        result.failed[:] = before + result.in_a_row
        return result


COUNTS = tuple(field.name for field in fields(Evidence))[1:]


@dataclass(frozen=True, eq=False)
class Existence:
    """The evidence from the frames so far, and what the next ones go on from."""

    evidence: Evidence
    views: Views
    anchors: np.ndarray
    """(K, 3) float64: the pose from which each robot's place began."""
    visits: np.ndarray
    """(K,) int64: places that each has been to."""

    @classmethod
    def nothing(cls, robots: int) -> "Existence":
        return cls(
            Evidence.nothing(np.empty(0, np.int64)),
            Views.nothing(robots),
            np.full((robots, 3), FAR),
            np.zeros(robots, np.int64),
        )

    def with_another(self, robot: int) -> "Existence":
        """With another robot after the others, whose camera is that of `robot`."""
        return Existence(
            self.evidence,
            self.views.with_another(robot),
            np.vstack([self.anchors, np.full(3, FAR)]),
            np.append(self.visits, 0),
        )

    def seen(self, frames: Frames) -> Views:
        """Where cameras find landmarks again, by these and more `frames`."""
        robots = np.repeat(frames.robots, np.diff(frames.starts))
        return self.views.also(robots[frames.is_known], frames.rays[frames.is_known])

    def also(
        self, frames: Frames, placed: Placed, views: Views, settings: ExistenceSettings
    ) -> "Existence":
        """With the evidence of `frames` for the landmarks `placed`, by `views` of the cameras."""
        ids = np.union1d(self.evidence.ids, placed.ids)
        evidence = self.evidence.of(ids)
        rows = np.searchsorted(ids, placed.ids)
        places, sigmas = np.full((len(ids), 3), FAR), np.zeros(len(ids))
        places[rows], sigmas[rows] = placed.places, placed.sigmas
        seen = np.searchsorted(ids, frames.ids).clip(max=max(len(ids) - 1, 0))
        if len(seen):
            seen[~np.isin(frames.ids, ids)] = -1
        anchors, visits = self.anchors.copy(), self.visits.copy()
        go_through(
            frames,
            seen,
            places,
            sigmas,
            views,
            (settings.apart_m, settings.apart_rad),
            anchors,
            visits,
            tuple(getattr(evidence, name) for name in COUNTS),
        )
        return Existence(evidence, self.seen(frames), anchors, visits)

    def renamed(self, aliases: Aliases) -> "Existence":
        """With joined landmarks under the id that they go by."""
        return replace(self, evidence=self.evidence.renamed(aliases)) if len(aliases) else self

    def forget(self, ids: np.ndarray) -> "Existence":
        """Without the landmarks `ids`."""
        kept = np.setdiff1d(self.evidence.ids, ids)
        return replace(self, evidence=self.evidence.of(kept)) if len(ids) else self


def published(
    evidence: Evidence, descriptors: np.ndarray, descriptor_gate: float, settings: ExistenceSettings
) -> np.ndarray:
    """(n,) bool: which landmarks of the `evidence` are there.

    A landmark that was found elsewhere, since it was last seen, by what looks like it, is more
    likely to have moved: that there are two of the kind is as unlikely as `ALIKE_BY_CHANCE`, and
    what looks like it is found as easily.

    Parameters
    ----------
    descriptors : (n, 128) of the landmarks; descriptor_gate : E_0.
    """
    is_seen = evidence.places >= settings.published_from
    if settings.gone_below == 0:
        return is_seen
    limit = np.log(settings.gone_below)
    found, before = evidence.found, evidence.failed - evidence.in_a_row
    gone = log_chance(found, before, evidence.in_a_row) < limit
    may_have_moved = _of_kind(MOST_LOOKS, 0, evidence.in_a_row) < limit
    missed = np.flatnonzero(is_seen & ~gone & may_have_moved)
    others = np.flatnonzero(is_seen)
    alike = squared_distances(descriptors[missed], descriptors[others]) <= descriptor_gate
    alike &= evidence.ids[others] > evidence.horizon[missed, None]
    pairs = np.argwhere(alike)
    old, new = missed[pairs[:, 0]], others[pairs[:, 1]]
    both = _of_kind(
        found[old] + found[new], before[old] + evidence.failed[new], evidence.in_a_row[old]
    )
    gone[old[both < limit]] = True
    return is_seen & ~gone


def _of_kind(found: np.ndarray | int, failed: np.ndarray | int, in_a_row: np.ndarray) -> np.ndarray:
    """Logarithm of (X1) times that of two that look alike both being there."""
    return log_chance(found, failed, in_a_row) + np.log(ALIKE_BY_CHANCE)


def log_chance(
    found: np.ndarray | int, failed: np.ndarray | int, in_a_row: np.ndarray
) -> np.ndarray:
    """Logarithm of (X1): `in_a_row` more looks fail after those that `found` and `failed`."""
    share = np.minimum(1.0, MOST_LOOKS / np.maximum(found + failed, 1))
    looks, failed = share * (found + failed), share * failed
    before = gammaln(looks + 1) - gammaln(failed + 1)
    return before - gammaln(looks + in_a_row + 1) + gammaln(failed + in_a_row + 1)
