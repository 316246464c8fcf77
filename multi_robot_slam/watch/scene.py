"""The scene in three dimensions; of each draw only what is news goes to the browser."""

from itertools import cycle
from typing import Any

import numpy as np
from viser import ViserServer

from msg_defs.types import LandmarkMap, Walls
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.watch import shapes
from multi_robot_slam.watch.watched import Robot, Watched

Colour = tuple[int, int, int]

LAYERS = {
    "landmarks": "landmarks",
    "uncertainty": "their uncertainty",
    "robots": "robots",
    "paths": "paths",
    "particles": "particles",
    "sight": "lines of sight",
    "walls": "walls",
}
"""What can be shown and hidden, and what it is called."""

NEUTRAL: Colour = (90, 99, 110)
"""What belongs to no robot alone."""
MOST_LANDMARKS, MOST_ELLIPSOIDS = 6000, 1000
"""Drawn; of more, those observed most often."""
LIFT_M = 0.02
"""How far paths and discs are above the ground, where they would flicker with its grid."""
FIELD_OF_VIEW = 0.9, 4 / 3
"""Vertical [rad], and width over height, of a camera whose calibration is not published."""
FRUSTUM_M = 0.5


def colour_of(place: int) -> Colour:
    """Red, green, blue of the robot at this place in the team."""
    text = ROBOT_COLOURS[place % len(ROBOT_COLOURS)]
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


class Scene:
    """Draws what is watched; `scale` is how many times larger uncertainty is drawn."""

    def __init__(self, server: ViserServer) -> None:
        self._scene = server.scene
        self._scene.set_up_direction("+z")
        self._scene.add_grid(
            "/grid", infinite_grid=True, cell_size=1.0, section_size=5.0, plane_opacity=0.0,
            cell_color=(225, 228, 232), section_color=(200, 205, 210), fade_distance=120.0,
        )  # fmt: skip
        self._layers = {name: self._group(f"/{name}") for name in LAYERS}
        self._drawn: dict[str, tuple[object, ...]] = {}
        self._nodes: dict[str, Any] = {}
        self.scale = 1

    def show(self, layer: str, is_shown: bool) -> None:
        """Show or hide a layer."""
        self._layers[layer].visible = is_shown

    def clear(self) -> None:
        """Remove everything: another team is watched."""
        for node in self._nodes.values():
            node.remove()
        self._nodes.clear()
        self._drawn.clear()

    def draw(self, watched: Watched) -> None:
        """Bring the browser up to date."""
        if self._is_news("walls", watched.walls):
            self._draw_walls(watched.walls)
        if self._is_news("landmarks", watched.landmarks, self.scale):
            self._draw_landmarks(watched.landmarks)
        for place, (name, robot) in enumerate(watched.robots.items()):
            self._draw_robot(name, robot, watched, place)

    def _is_news(self, what: str, *parts: object) -> bool:
        before = self._drawn.get(what, (None,) * len(parts))
        self._drawn[what] = parts
        return any(a is not b for a, b in zip(before, parts, strict=True))

    def _group(self, name: str) -> Any:
        return self._scene.add_frame(name, show_axes=False)

    def _remove(self, *names: str) -> None:
        for name in names:
            if node := self._nodes.pop(name, None):
                node.remove()

    def _draw_walls(self, walls: Walls | None) -> None:
        self._remove("/walls/faces", "/walls/edges")
        if walls is None or not len(walls.segments):
            return
        corners, faces = shapes.wall_faces(walls)
        self._nodes["/walls/faces"] = self._scene.add_mesh_simple(
            "/walls/faces", corners, faces, color=NEUTRAL, opacity=0.1, side="double",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._lines("/walls/edges", shapes.outline(corners), (150, 156, 164), 1.0)

    def _draw_landmarks(self, landmarks: LandmarkMap | None) -> None:
        names = "/landmarks/points", "/uncertainty/ellipsoids"
        if landmarks is None or not len(landmarks.ids):
            self._remove(*names)
            return
        often = np.argsort(-landmarks.observations.astype(np.int64), kind="stable")
        rows = often[:MOST_LANDMARKS]
        places, colours = landmarks.positions[rows], _landmark_colours(landmarks.robots[rows])
        self._nodes[names[0]] = self._scene.add_point_cloud(
            names[0], places, colours, point_size=0.07, point_shape="circle", precision="float32",
            point_shading="flat",
        )  # fmt: skip
        rows, places, colours = (some[:MOST_ELLIPSOIDS] for some in (rows, places, colours))
        turns, axes = shapes.ellipsoids(unpack(landmarks.covariances[rows]))
        self._nodes[names[1]] = self._scene.add_batched_meshes_simple(
            names[1], *shapes.sphere(), turns, places, batched_scales=self.scale * axes,
            batched_colors=colours, opacity=0.3, cast_shadow=False, receive_shadow=False,
            lod="off",
        )  # fmt: skip

    def _draw_robot(self, name: str, robot: Robot, watched: Watched, place: int) -> None:
        colour = colour_of(place)
        if self._is_news(f"path {name}", robot.path):
            poses = np.empty((0, 3)) if robot.path is None else robot.path.poses
            self._lines(f"/paths/{name}", shapes.joined(_on_ground(poses)), colour, 3.0)
        if self._is_news(f"trail {name}", robot.trail):
            end = [] if robot.path is None else [*robot.path.poses[-1:]]
            poses = np.array([*end, *(pose.pose for pose in robot.trail)]).reshape(-1, 3)
            self._lines(f"/paths/{name} since", shapes.joined(_on_ground(poses)), colour, 3.0)
        if self._is_news(f"particles {name}", robot.particles):
            self._points(f"/particles/{name}", robot.particles, colour)
        if self._is_news(f"body {name}", robot.estimate, self.scale):
            self._draw_body(name, robot, watched, place)
        if self._is_news(f"sight {name}", robot.estimate, robot.frame, watched.landmarks):
            self._lines(f"/sight/{name}", _lines_of_sight(robot, watched, place), colour, 1.0)
        if self._is_news(f"picture {name}", robot.picture) and robot.picture is not None:
            self._frustum(name, robot, colour).image = coloured(robot.picture.pixels)

    def _draw_body(self, name: str, robot: Robot, watched: Watched, place: int) -> None:
        body, camera, disc = f"/robots/{name}", f"/robots/{name} camera", f"/uncertainty/{name}"
        label = f"/robots/{name}/label"
        if robot.estimate is None:
            self._remove(label, body, camera, disc)
            return
        colour, pose = colour_of(place), robot.estimate.pose
        if body not in self._nodes:
            self._nodes[body] = self._scene.add_mesh_simple(
                body, *shapes.arrow_head(0.7), color=colour, flat_shading=True, side="double"
            )
            self._nodes[label] = self._scene.add_label(
                label, name, position=(0.0, 0.0, 0.5), anchor="bottom-center"
            )
            self._nodes[disc] = self._scene.add_mesh_simple(
                disc, *shapes.disc(), color=colour, opacity=0.35, side="double",
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._nodes[body].position = (pose[0], pose[1], 0.0)
        self._nodes[body].wxyz = shapes.about_z(pose[2])
        turns, axes = shapes.ellipsoids(robot.estimate.covariance[None, :2, :2])
        self._nodes[disc].position = (pose[0], pose[1], LIFT_M)
        self._nodes[disc].wxyz = turns[0]
        self._nodes[disc].scale = (*(self.scale * axes[0]).tolist(), 1.0)
        frustum = self._frustum(name, robot, colour)
        frustum.wxyz, frustum.position = shapes.camera(pose, watched.config.mount_of(place))

    def _frustum(self, name: str, robot: Robot, colour: Colour) -> Any:
        """Where the robot's camera looks."""
        key = f"/robots/{name} camera"
        if key not in self._nodes:
            self._nodes[key] = self._scene.add_camera_frustum(
                key, *FIELD_OF_VIEW, scale=FRUSTUM_M, color=colour, thickness=1.5,
                thickness_units="screen", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        frustum, info = self._nodes[key], robot.calibration
        if info is not None:
            frustum.fov = 2 * float(np.arctan2(info.height_px / 2, info.projection[1, 1]))
            frustum.aspect = info.width_px / info.height_px
        return frustum

    def _lines(self, name: str, lines: np.ndarray, colour: Colour, width_px: float) -> None:
        """Lines (n, 2, 3) in one colour."""
        if not len(lines):
            self._remove(name)
        elif name in self._nodes:
            self._nodes[name].points = lines.astype(np.float32)
        else:
            self._nodes[name] = self._scene.add_line_segments(
                name, lines.astype(np.float32), colour, thickness=width_px, thickness_units="screen"
            )

    def _points(self, name: str, poses: np.ndarray | None, colour: Colour) -> None:
        if poses is None or not len(poses):
            self._remove(name)
        elif name in self._nodes:
            self._nodes[name].points = _on_ground(poses)
        else:
            self._nodes[name] = self._scene.add_point_cloud(
                name, _on_ground(poses), colour, point_size=0.04, point_shape="circle",
                precision="float32", point_shading="flat",
            )  # fmt: skip


def coloured(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 red, green, blue of a picture, grey or blue, green, red, as decoded."""
    values = (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels
    return np.repeat(values[..., None], 3, 2) if values.ndim == 2 else values[..., 2::-1].copy()


def _landmark_colours(robots: np.ndarray) -> np.ndarray:
    """(n, 3) uint8: the colour of the one robot that observed it; neutral where several have."""
    seen = (robots[:, None] >> np.arange(32, dtype=np.uint32)) & 1
    table = np.array([colour for colour, _ in zip(cycle(map(colour_of, range(6))), range(32))])
    own = table[seen.argmax(axis=1)]
    return np.where((seen.sum(axis=1) == 1)[:, None], own, NEUTRAL).astype(np.uint8)


def _on_ground(poses: np.ndarray) -> np.ndarray:
    """(n, 3) places in space of planar `poses` (n, 3)."""
    return np.column_stack([poses[:, :2], np.full(len(poses), LIFT_M)]).astype(np.float32)


def _lines_of_sight(robot: Robot, watched: Watched, place: int) -> np.ndarray:
    """(n, 2, 3) from the camera to what the last keyframe saw, and to the robots it saw."""
    nothing = np.empty((0, 2, 3))
    if robot.estimate is None or robot.frame is None:
        return nothing
    pose, team = robot.estimate.pose, [*watched.robots.values()]
    _, eye = shapes.camera(pose, watched.config.mount_of(place))
    ends = [nothing[:, 0]]
    if watched.landmarks is not None:
        ends.append(
            watched.landmarks.positions[np.isin(watched.landmarks.ids, robot.frame.landmarks)]
        )
    met = robot.frame.others[~robot.frame.is_other_rejected].tolist()
    found = [team[other].estimate for other in met if other < len(team)]
    ends += [_on_ground(one.pose[None]) for one in found if one is not None]
    seen = np.concatenate(ends)
    return np.stack([np.broadcast_to(eye, seen.shape), seen], axis=1)
