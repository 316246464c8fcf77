"""Where the page is served: an address of this machine with a port that is free."""

import errno
import socket
from importlib.util import find_spec
from typing import Annotated, NamedTuple

from annotated_types import Ge, Le

from msg_defs.errors import InputError
from msg_defs.types import settings

MOST_TRIED = 100
"""Ports after the first, where that is in use."""
LARGEST_PORT = 65535
EVERYWHERE = ("0.0.0.0", "::")


@settings
class Serving:
    """Where the page is served."""

    host: Annotated[
        str,
        "address of this machine to serve the page at; 127.0.0.1: this machine alone; 0.0.0.0: "
        "whoever can reach it, without password or encryption",
    ] = "127.0.0.1"
    port: Annotated[
        int,
        Ge(1),
        Le(LARGEST_PORT),
        "port to serve it at; where that is in use, the next that is free",
    ] = 8080


class Address(NamedTuple):
    """Where a page is served."""

    host: str
    port: int

    def __str__(self) -> str:
        host = socket.gethostname() if self.host in EVERYWHERE else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def warning(self) -> str:
        """What to say of an address that others can reach; empty where they cannot."""
        if self.host == "localhost" or self.host.startswith("127.") or self.host == "::1":
            return ""
        return (
            f"whoever can reach {self} sees this page and its pictures, without password or "
            "encryption; the host 127.0.0.1 is for this machine alone"
        )


def require_viser() -> None:
    """`InputError` where what draws the page is not installed."""
    if find_spec("viser") is None:
        raise InputError("no module 'viser', which draws the page: pip install viser")


def free(serving: Serving) -> Address:
    """The host with the first free port from the one wanted on; `InputError` if there is none."""
    last = min(serving.port + MOST_TRIED, LARGEST_PORT)
    for port in range(serving.port, last + 1):
        if _is_free(serving.host, port):
            return Address(serving.host, port)
    raise InputError(f"port = {serving.port}: all up to {last} are in use; name another")


def _is_free(host: str, port: int) -> bool:
    try:
        family, *_, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            return False
        raise InputError(
            f"host = {host}: {error.strerror}; give an address of this machine, or 127.0.0.1"
        ) from None
    return True
