"""Where a node's traffic goes: what the user said in environment variables, or our own choice."""

import os
from pathlib import Path

from msg_defs.errors import InputError

DEFAULTS = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_name("fastdds.xml")),
}
"""What the process runs under where the user has not said otherwise."""

LARGEST_DOMAIN_ID = 232
"""The ports of a larger one would lie beyond 65535."""


def prepare() -> None:
    """Set what the user has not; `InputError` where ROS would fail on what the user has."""
    for name, value in DEFAULTS.items():
        os.environ.setdefault(name, value)
    domain_id = os.environ.get("ROS_DOMAIN_ID", "")
    if domain_id and not (domain_id.isdecimal() and int(domain_id) <= LARGEST_DOMAIN_ID):
        raise InputError(
            f"ROS_DOMAIN_ID = {domain_id!r}; use a whole number from 0 to {LARGEST_DOMAIN_ID}"
        )


def reach() -> str:
    """In one line: the domain, and whether nodes on other machines are heard."""
    domain = f"ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID') or 0}"
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    said = f"ROS_AUTOMATIC_DISCOVERY_RANGE={reach}"
    peers = os.environ.get("ROS_STATIC_PEERS", "")
    if reach == "OFF":
        return f"{domain}; no other process is heard ({said})"
    if reach == "LOCALHOST" and not peers:
        return f"{domain}; other machines are not heard ({said}; SUBNET hears them)"
    return f"{domain}; other machines are heard ({said}{', ROS_STATIC_PEERS' if peers else ''})"
