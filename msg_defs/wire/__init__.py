"""Types <-> CDR bytes of standard ROS messages: the only place that knows field layouts.

Nodes publish these bytes and subscribe raw, bags hold them, so live and recorded data go through
the same code, and none of it imports ROS. Each `encode_x` makes the bytes of one message; each
`decode_x` checks what comes in and raises `InputError` where it is damaged or means nothing.

Frames are those of `msg_defs.types`. Clouds of observations are in the camera's optical frame of
REP-103 (x right, y down, z forward); here, and nowhere else, their y changes sign.
"""

from msg_defs.wire.clouds import (
    decode_map,
    decode_observation_truth,
    decode_observations,
    decode_pieces,
    decode_sightings,
    encode_map,
    encode_observation_truth,
    encode_observations,
    encode_pieces,
    encode_sightings,
)
from msg_defs.wire.estimates import (
    Estimates,
    decode_estimate,
    decode_estimates,
    encode_estimate,
    encode_mean,
)
from msg_defs.wire.images import (
    ENCODINGS,
    decode_camera_info,
    decode_compressed,
    decode_image,
    encode_camera_info,
    encode_compressed,
    encode_image,
    encode_packed,
    packed_image,
)
from msg_defs.wire.messages import is_known, message_class, message_schema, peek_stamp
from msg_defs.wire.pictures import decode_walls, encode_markers, encode_walls
from msg_defs.wire.poses import (
    Transform,
    decode_particles,
    decode_path,
    decode_pose,
    decode_poses,
    encode_particles,
    encode_path,
    encode_pose,
    encode_transform,
    encode_transforms,
)
from msg_defs.wire.records import (
    ERROR,
    LEVELS,
    OK,
    STALE,
    WARN,
    Status,
    decode_diagnostics,
    decode_step,
    decode_text,
    encode_diagnostics,
    encode_step,
    encode_text,
    tied_values,
    verdict_values,
)
from msg_defs.wire.replayed import encode_clock, renamed

__all__ = [
    "ENCODINGS",
    "ERROR",
    "LEVELS",
    "OK",
    "STALE",
    "WARN",
    "Estimates",
    "Status",
    "Transform",
    "decode_camera_info",
    "decode_compressed",
    "decode_diagnostics",
    "decode_estimate",
    "decode_estimates",
    "decode_image",
    "decode_map",
    "decode_observation_truth",
    "decode_observations",
    "decode_particles",
    "decode_path",
    "decode_pieces",
    "decode_pose",
    "decode_poses",
    "decode_sightings",
    "decode_step",
    "decode_text",
    "decode_walls",
    "encode_camera_info",
    "encode_clock",
    "encode_compressed",
    "encode_diagnostics",
    "encode_estimate",
    "encode_image",
    "encode_map",
    "encode_markers",
    "encode_mean",
    "encode_observation_truth",
    "encode_observations",
    "encode_packed",
    "encode_particles",
    "encode_path",
    "encode_pieces",
    "encode_pose",
    "encode_sightings",
    "encode_step",
    "encode_text",
    "encode_transform",
    "encode_transforms",
    "encode_walls",
    "is_known",
    "message_class",
    "message_schema",
    "packed_image",
    "peek_stamp",
    "renamed",
    "tied_values",
    "verdict_values",
]
