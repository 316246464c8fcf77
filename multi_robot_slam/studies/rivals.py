"""The filter against Algorithm 1 written plainly: same world, same draws, same matches."""

import copy
import importlib.util
from collections.abc import Iterable
from pathlib import Path
from time import process_time
from types import ModuleType
from typing import NamedTuple

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.filter import rbpf
from multi_robot_slam.models import stereo
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.studies import textbook
from multi_robot_slam.studies.session import SPEED, Session, require

LITERAL = Path(__file__).parents[2] / "test" / "literal_algorithm1.py"
"""The tests' oracle, which is not installed."""

FAST_STEPS = 5
"""Steps of the filter for one of its rival's."""


class Comparison(NamedTuple):
    """Seconds of the rival and of the filter in each round, and the share of equal matches."""

    rival: list[float]
    fast: list[float]
    same: float


def check_literal() -> None:
    """`InputError` where the tests' oracle is missing."""
    if not LITERAL.is_file():
        raise InputError(f"no {LITERAL} to compare with; run bench from a source checkout")


def against_literal(session: Session, seeds: Iterable[int]) -> Comparison:
    """Whole steps against the literal Algorithm 1, both from the same particles each round."""
    literal = _load_literal()
    settings = session.settings
    model = literal.Model(
        settings.gate,
        settings.descriptor_gate,
        (0.0, 0.0, 0.0),
        tuple(vars(settings.motion).values())[:4],
    )
    rival, fast, same = [], [], []
    for seed in seeds:
        S = _literal_copies(literal, session.state)
        frames = session.world.drive(SPEED)
        rng = np.random.default_rng(seed)
        start = process_time()
        choices = []
        for frame in frames:
            # The literal filter looks from the camera, here one in `base_link`.
            axes = stereo.CAMERA_TO_BODY
            z = (frame.positions @ axes, frame.descriptors.astype(float))
            R = axes.T @ unpack(frame.covariances) @ axes
            normals = rng.standard_normal((3, len(S)))
            choices.append(
                literal.fast_slam_mr(S, frame.robot, z, R, frame.motion, normals, model, None)
            )
        literal.importance_resampling(S, rng.random())
        rival.append(process_time() - start)
        fast.append(_time_on_copies(session, frames, seed))
        _, info = session.process(frames, np.random.default_rng(seed))
        for choice, seen in zip(choices, info.frames, strict=True):
            ids = [[seen.new_ids[c[2]] if type(c) is tuple else c for c, _, _ in p] for p in choice]
            same.append(np.mean(np.transpose(ids) == seen.matches))
    return Comparison(rival, fast, require(np.mean(same), "matches like the literal algorithm's"))


def against_textbook(session: Session, particles: int, seeds: Iterable[int]) -> Comparison:
    """Predict, associate, update and weigh against `textbook`: seconds per particle-observation.

    The textbook runs with copies of the first few particles, the filter with all.
    """
    rival, fast, same = [], [], []
    for seed in seeds:
        times = [session.step() for _ in range(FAST_STEPS - 1)]
        few, ids = _textbook_copies(session.state, particles)
        frames = session.world.drive(SPEED)
        observations = sum(len(frame.positions) for frame in frames)
        rng = np.random.default_rng(seed)
        normals = [rng.standard_normal((3, session.settings.particles)) for _ in frames]
        start = process_time()
        choices = [
            textbook.update_particles(few, frame, session.settings, draws[:, :particles])
            for frame, draws in zip(frames, normals, strict=True)
        ]
        rival.append((process_time() - start) / (particles * observations))
        clock, info = session.process(frames, np.random.default_rng(seed))
        proposals = [clock.proposal - clock.gather for clock in [*times, clock]]
        fast.append(float(np.median(proposals)) / (session.settings.particles * observations))
        for choice, seen in zip(choices, info.frames, strict=True):
            for m, indices in enumerate(choice):
                for index, new, match in zip(
                    indices, seen.new_ids, seen.matches[:, m], strict=True
                ):
                    ids[m] += [new] * (index == len(ids[m]))
                    same.append(ids[m][index] == match)
    return Comparison(rival, fast, require(np.mean(same), "matches like the textbook's"))


def _time_on_copies(session: Session, frames: list[RobotFrame], seed: int) -> float:
    times = []
    for _ in range(FAST_STEPS):
        state, rng = copy.deepcopy(session.state), np.random.default_rng(seed)
        start = process_time()
        rbpf.step(state, frames, session.settings, rng)
        times.append(process_time() - start)
    return float(np.median(times))


def _particle(
    state: rbpf.State, m: int
) -> tuple[list[np.ndarray], list[tuple[int, tuple[np.ndarray, np.ndarray, np.ndarray]]]]:
    """Poses and landmarks of particle m: (K, 3), and pairs of id and (mean, Sigma, d)."""
    columns, values = state.landmarks.of_particle(m)
    sigmas = unpack(values[:, 3:])
    descriptors = state.landmarks.descriptors[columns].astype(float)
    filters = zip(values[:, :3].astype(float), sigmas, descriptors, strict=True)
    ids = state.landmarks.ids[columns].tolist()
    return list(state.poses[:, :, m]), list(zip(ids, filters, strict=True))


def _literal_copies(literal: ModuleType, state: rbpf.State) -> list:
    copies = []
    for m in range(state.poses.shape[2]):
        poses, landmarks = _particle(state, m)
        own = [literal.Landmark(*parts, number) for number, parts in landmarks]
        copies.append(literal.Particle(poses, own))
    return copies


def _textbook_copies(state: rbpf.State, count: int) -> tuple[list, list[list[int]]]:
    copies, ids = [], []
    for m in range(count):
        poses, landmarks = _particle(state, m)
        copies.append(
            textbook.Particle(poses, [textbook.Landmark(*parts) for _, parts in landmarks])
        )
        ids.append([number for number, _ in landmarks])
    return copies, ids


def _load_literal() -> ModuleType:
    check_literal()
    spec = importlib.util.spec_from_file_location(LITERAL.stem, LITERAL)
    if spec is None or spec.loader is None:
        raise ImportError(f"cannot load {LITERAL}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
