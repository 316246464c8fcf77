"""A field of landmarks, and robots that drive round in it and look: poses and landmarks known."""

import numpy as np

from multi_robot_slam.filter.existence import Placed
from multi_robot_slam.models.frames import Record
from multi_robot_slam.models.ranging import Ranging

EYE = np.array([0.1, 0.05, 1.0])
HALF_VIEW_RAD, FARTHEST_M = np.radians(35), 9.0


def field(count=250, seed=0):
    """(N, 3) places of landmarks."""
    return np.random.default_rng(seed).uniform([-10, -10, 0], [10, 10, 2], (count, 3))


def circle(laps=2.0, step_m=0.5, radius=3.0, turned=0.0):
    """(F, 3) poses along a circle, which look along it or `turned` [rad] from it."""
    angles = np.arange(0, 2 * np.pi * laps, step_m / radius)
    yaws = (angles + np.pi / 2 + turned + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), yaws])


def rays_to(pose, places):
    """(N, 3) from the camera to the `places` (N, 3), in `base_link` axes."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return (places - [pose[0], pose[1], 0]) @ turn.T - EYE


def in_view(pose, places):
    """(N,) bool."""
    rays = rays_to(pose, places)
    bearings = np.abs(np.arctan2(rays[:, 1], rays[:, 0]))
    return (bearings < HALF_VIEW_RAD) & (np.linalg.norm(rays, axis=1) < FARTHEST_M)


class Watcher:
    """Makes records of what robots see; a landmark's id is given when it is seen first."""

    def __init__(self):
        self.records, self.poses, self.identities = [], [], []
        self.ids, self._next_id = {}, 0

    def look(self, pose, names, places, robot=0):
        """One frame that observes `names` at `places` (B, 3); one name, one landmark."""
        rays = rays_to(pose, places)
        new_ids = self._next_id + np.arange(len(names))
        self._next_id += len(names)
        own = [self.ids.setdefault(n, int(i)) for n, i in zip(names, new_ids, strict=True)]
        matches = np.array(own, np.int32).reshape(-1, 1)
        self.records.append(
            Record(
                robot=robot,
                stamp_ns=len(self.records),
                step=len(self.records),
                motion=np.zeros(3),
                positions=rays + EYE,
                covariances=np.zeros((len(names), 6)),
                poses=np.asarray(pose, float)[:, None],
                matches=matches,
                new_ids=new_ids.astype(np.int32),
                parents=np.zeros(1, np.int32),
                ranging=Ranging(rays, 0.01 * rays),
            )
        )
        self.poses.append(pose)
        self.identities.append(matches[:, 0])

    def tour(self, poses, places, finds, robot=0):
        """Frames from `poses`: each sees those in view that `finds(f)` (N,) says."""
        for f, pose in enumerate(poses):
            rows = np.flatnonzero(in_view(pose, places) & finds(f))
            self.look(pose, rows.tolist(), places[rows], robot)

    def placed(self, places, sigma=0.01):
        """Where the landmarks seen so far are, by their names: rows of `places` or a dictionary."""
        names = sorted(self.ids, key=self.ids.__getitem__)
        where = np.array([places[name] for name in names], float).reshape(-1, 3)
        ids = np.array([self.ids[name] for name in names], np.int64)
        return names, Placed(ids, where, np.full(len(ids), sigma))
