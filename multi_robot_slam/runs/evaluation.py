"""How good a run is: trajectory and map errors, association quality, each with its unit.

Errors are estimate minus truth in `map`. Unaligned ones come first: the start poses are given.
Aligned ones judge the shape alone, for runs whose truth lives in another frame. The truth is looked
up at the estimate's stamps. A figure that needs truth the run does not have is None.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from msg_defs.types import LandmarkMap
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.runs import levels, places
from multi_robot_slam.runs.associations import (
    Associations,
    Origins,
    association_quality,
    associations,
    origins,
)
from multi_robot_slam.runs.consistency import nees, published_errors
from multi_robot_slam.runs.map_errors import aligned_place_errors, attributed, place_errors
from multi_robot_slam.runs.provenance import Provenance
from multi_robot_slam.runs.robot_errors import RobotErrors, robot_errors
from multi_robot_slam.runs.run import Run
from multi_robot_slam.runs.trajectory_errors import PoseErrors, aligned, relative_errors, rmse

RELATIVE_TO_M = (1, 10)
"""Distances over which the relative error is taken [m]."""

PREFIXES = {kind: f"{kind}_" for kind in RobotErrors._fields} | {"path": "", "yardstick": "batch_"}
"""What the names of figures begin with, for each kind of path."""

Figures = dict[str, Any]
"""What `result.json` holds."""


def evaluate(run: Run) -> Figures:
    """Every figure of merit of a run, ready for `result.json`; None where there is no truth.

    Of the team and, under `robots`, of each robot, whose poses the team's figures pool:

    `path_rmse_m`, `heading_rmse_rad`: of the best particle's whole path at the end, unaligned.
    `path_aligned_rmse_m`, `heading_aligned_rmse_rad`: after each robot's path was brought closest
    to its truth; `path_team_aligned_rmse_m`, `heading_team_aligned_rmse_rad`: after all together
    were, by one rotation and shift. `rte_1m_rmse_m`, `rte_1m_rmse_rad`, `rte_10m_...`: of the
    motion over so many metres (`relative_errors`), which is the same aligned or not.
    These ten also of other paths: `odometry_...`; `online_...`, the poses as published, at steps
    and in between; `online_mean_...`, the means as published at steps; `mean_...`, the mean of all
    particles' paths; `refined_...`, smoothed over the best particle's associations; `batch_...`,
    the yardstick, smoothed over the true ones.
    `truth_coverage`: share of the path's poses whose truth is known, on which these figures rest.
    `pose_nees`: normalised error of mean and covariance as published; 3 is consistent.
    `frames`, `keyframes`: how many of its frames could be used, and how many became steps.
    `association_precision`, `association_recall`: see `association_quality`.
    `worst_level`: what the monitor said at worst (`levels`); of each robot also `level`, at the
    end, and `worst_level_at_s`, `worst_level_cause`, `worst_level_remedy`.
    `place_known_from_s`, `tied_...` of each robot: since when its place in `map` is known, and by
    what (`places`).

    Of the team alone:

    `map_rmse_m`: of the final map, one landmark for each true one (`map_errors`);
    `map_aligned_rmse_m`: after the map was turned and shifted in the plane to lie closest to it;
    `map_all_rmse_m`: of all landmarks that come from a true one, duplicates included;
    `landmark_nees`: normalised error of these, given the best particle's path; `refined_...` of the
    refined map. `landmarks`: in the map; `landmarks_seen`: true ones observed; `misses`: of these,
    how many no landmark of the map comes from; `duplicates`: landmarks of the map beyond the first
    of each true landmark; `landmarks_by_majority`, `landmarks_unattributed`: how many have an
    origin by majority, or none, and then no part in map error, duplicates and misses (`origins`).
    `bag`: where the recording is, `namespace`: of the team in it. `version`, `scenario`, `machine`:
    what made the run (`provenance`), None where nobody noted it.
    """
    team, robots = _pose_figures(run)
    observed = associations(run)
    origin = origins(observed)
    durations = [step.duration_ms for step in run.steps]
    for index, (name, figures) in enumerate(robots.items()):
        figures |= _frame_figures(run, [name])
        figures |= levels.of_robot(run.steps, name)
        figures |= places.of_robot(run.config, run.steps, name)
        figures |= _association_figures(observed, origin, observed.robots == index)
    return {
        **team,
        **_map_figures(run, observed, origin),
        **_association_figures(observed, origin, True),
        "step_ms_mean": float(np.mean(durations)) if durations else None,
        "step_ms_p99": float(np.percentile(durations, 99)) if durations else None,
        "step_ms_max": float(np.max(durations)) if durations else None,
        "steps": len(run.steps),
        **_frame_figures(run, robots),
        **levels.of_team(run.steps),
        "particles": run.config.filter.particles,
        "seed": run.config.seed,
        "bag": None if run.bag is None else str(run.bag),
        "namespace": run.namespace,
        **_provenance_figures(run.provenance),
        "dropped": dict(run.dropped),
        "robots": robots,
    }


def _frame_figures(run: Run, names: Iterable[str]) -> Figures:
    """What became of the frames of the robots `names`; None where it was not noted of one."""
    counts = [run.frames.get(name) for name in names]
    known = [count for count in counts if count is not None]
    if len(known) < len(counts):
        return dict.fromkeys(("frames", "keyframes"))
    return {"frames": sum(c.seen for c in known), "keyframes": sum(c.used for c in known)}


def _pose_figures(run: Run) -> tuple[Figures, dict[str, Figures]]:
    """The team's figures of all paths and poses, and those of each robot."""
    errors = robot_errors(run)
    published = published_errors(run)
    team: Figures = {}
    robots: dict[str, Figures] = {name: {} for name in run.robots}
    for kind in RobotErrors._fields:
        plain = {name: getattr(robot, kind) for name, robot in errors.items()}
        alone = {name: aligned([path])[0] for name, path in plain.items()}
        together = dict(zip(plain, aligned(list(plain.values())), strict=True))
        prefix = PREFIXES[kind]
        team |= _path_figures(prefix, errors, plain, alone, together)
        for name, figures in robots.items():
            figures |= _path_figures(prefix, errors.keys() & {name}, plain, alone, together)
    team["pose_nees"] = nees(*map(np.concatenate, zip(*published.values(), strict=True)))
    for name, figures in robots.items():
        figures["pose_nees"] = nees(*published[name])
    team["truth_coverage"] = _coverage(run, errors, errors)
    for name, figures in robots.items():
        figures["truth_coverage"] = _coverage(run, errors, errors.keys() & {name})
    return team, robots


def _coverage(run: Run, errors: Mapping[str, RobotErrors], names: Iterable[str]) -> float | None:
    """Share of the paths' poses, of the robots `names`, whose truth is known: 0 to 1."""
    names = list(names)
    poses = sum(len(run.robots[name].path.stamps_ns) for name in names)
    return sum(len(errors[name].path.stamps_ns) for name in names) / poses if poses else None


def _path_figures(
    prefix: str,
    names: Iterable[str],
    plain: Mapping[str, PoseErrors],
    alone: Mapping[str, PoseErrors],
    together: Mapping[str, PoseErrors],
) -> Figures:
    """Of one kind of path of the robots `names`: unaligned, aligned one by one, or all together."""
    names = list(names)
    figures = {}
    for words, paths in (("", plain), ("aligned_", alone), ("team_aligned_", together)):
        pooled = _pooled(paths[name].errors for name in names)
        figures[f"{prefix}path_{words}rmse_m"] = rmse(pooled[:, :2])
        figures[f"{prefix}heading_{words}rmse_rad"] = rmse(pooled[:, 2])
    for distance in RELATIVE_TO_M:
        pooled = _pooled(relative_errors(plain[name], distance) for name in names)
        figures[f"{prefix}rte_{distance}m_rmse_m"] = rmse(pooled[:, :2])
        figures[f"{prefix}rte_{distance}m_rmse_rad"] = rmse(pooled[:, 2])
    return figures


def _pooled(errors: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.empty((0, 3)), *errors])


def _association_figures(
    observed: Associations, origin: Origins, among: np.ndarray | bool
) -> Figures:
    precision, recall = association_quality(observed, origin, among)
    return {"association_precision": precision, "association_recall": recall}


def _map_figures(run: Run, observed: Associations, origin: Origins) -> Figures:
    in_map = run.landmarks.ids.tolist()
    found = attributed(run.landmarks, origin)
    has_truth = bool(len(observed.ids))
    seen = len(np.unique(observed.truth))
    figures = {
        "landmarks_seen": seen,
        "misses": seen - int(found.is_first.sum()),
        "duplicates": int((~found.is_first).sum()),
        "landmarks_by_majority": sum(i in origin.by_majority for i in in_map),
        "landmarks_unattributed": len(in_map) - len(found.rows),
    }
    return {
        **_place_figures("", run.landmarks, run.true_landmarks, origin),
        **_place_figures("refined_", run.refined_landmarks, run.true_landmarks, origin),
        "landmarks": len(in_map),
        **{name: value if has_truth else None for name, value in figures.items()},
    }


def _place_figures(
    prefix: str, landmarks: LandmarkMap | None, true: LandmarkMap | None, origin: Origins
) -> Figures:
    kinds = ("map_rmse_m", "map_aligned_rmse_m", "map_all_rmse_m", "landmark_nees")
    names = [prefix + kind for kind in kinds]
    if landmarks is None or true is None:
        return dict.fromkeys(names)
    found = attributed(landmarks, origin)
    errors = place_errors(landmarks, true, found)
    values = (
        rmse(errors[found.is_first]),
        rmse(aligned_place_errors(landmarks, true, found)),
        rmse(errors),
        nees(errors, unpack(landmarks.covariances[found.rows])),
    )
    return dict(zip(names, values, strict=True))


def _provenance_figures(provenance: Provenance | None) -> Figures:
    if provenance is None:
        return dict.fromkeys(("version", "scenario", "machine"))
    return {
        "version": provenance.version,
        "scenario": provenance.scenario,
        "machine": dict(provenance.machine),
    }
