"""Which cameras can be rendered."""

from msg_defs.errors import InputError
from msg_defs.types import StereoCamera


def require_level(camera: StereoCamera, height_m: float) -> None:
    """`InputError` unless the camera's columns show walls of this height upright, from within."""
    mount = camera.mount
    for name, value in (("roll_rad", mount.roll_rad), ("pitch_rad", mount.pitch_rad)):
        if value:
            raise InputError(
                f"camera.mount.{name} = {value}: rendered cameras are level; give 0, or "
                "images.enabled: false"
            )
    if not 0 < mount.up_m < height_m:
        raise InputError(
            f"camera.mount.up_m = {mount.up_m}: rendered cameras are between floor and ceiling; "
            f"give 0 < value < {height_m}, or images.enabled: false"
        )
