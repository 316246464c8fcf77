"""What cameras saw, kept on disk: making clouds of images takes longer than filtering them."""

import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.datasets.levelling import Cloud


def kept(path: Path, make: Callable[[], Iterable[Cloud]]) -> list[Cloud]:
    """The clouds in the file at `path`, made and written there first where there is none."""
    if not path.exists():
        _save(path, list(make()))
    try:
        with np.load(path) as file:
            edges = np.cumsum(file["counts"])[:-1]
            parts = [np.split(file[name], edges) for name in Cloud._fields]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read ({error}); remove it") from None
    return [Cloud(*cloud) for cloud in zip(*parts, strict=True)]


def _save(path: Path, clouds: list[Cloud]) -> None:
    """Write the file, which is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(".new")
    parts = {"counts": np.array([len(cloud.positions) for cloud in clouds])}
    parts |= {n: np.concatenate([getattr(cloud, n) for cloud in clouds]) for n in Cloud._fields}
    with new.open("wb") as file:
        np.savez(file, allow_pickle=False, **parts)
    new.replace(path)
