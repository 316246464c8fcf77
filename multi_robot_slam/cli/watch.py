"""`watch`: a fusion that runs, or a run that is over, as a page in the browser."""

import signal
import time
from pathlib import Path
from typing import Annotated

import typer

from msg_defs import cli
from msg_defs.errors import InputError
from multi_robot_slam.cli.options import Namespace
from multi_robot_slam.cli.terminal import console, messages, warn
from multi_robot_slam.watch.address import Serving, free, require_viser

ROS_ARGS = "--ros-args"


def watch(
    context: typer.Context,
    bag: Annotated[
        Path | None,
        typer.Argument(
            metavar="[BAG]",
            help="Play what was published in this run: its folder, or a bag with the fusion's "
            "topics. Without it: a fusion that runs.",
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            help="Address to serve the page at. 0.0.0.0: whoever can reach this machine sees it."
        ),
    ] = Serving.host,
    port: Annotated[
        int,
        typer.Option(min=1, max=65535, help="Port; where that is in use, the next that is free."),
    ] = Serving.port,
    namespace: Namespace = None,
) -> None:
    """Show a fusion that runs, or a run that is over, as a page in the browser.

    The map as it grows, in three dimensions; robots, where their cameras look, paths, covariances,
    particles, what each last saw; how the fusion is, and what the monitor says of each robot. The
    page needs no network, and no ROS to play a BAG, with a slider, speed and pause.

    A fusion that runs is found by itself, on the same ROS_DOMAIN_ID, whatever its robots are called
    and whenever it begins; nothing is changed by watching. One in a namespace:
    multi_robot_slam watch --ros-args -r __ns:=/fleet
    """
    serving, words = Serving(host, port), [*([str(bag)] if bag else []), *context.args]
    if bag is not None and not words[0].startswith("-"):
        _refuse(words[1:])
        _play(bag, namespace, serving)
        return
    _refuse(words if words[:1] != [ROS_ARGS] else [])
    given = [word for name, value in vars(serving).items() for word in ("-p", f"{name}:={value}")]
    cli.start_node("multi_robot_slam.nodes.watch", [ROS_ARGS, *given, "--", *words])


def _refuse(words: list[str]) -> None:
    """`InputError` where there are words that nobody takes."""
    if words:
        raise InputError(
            f"unexpected argument '{words[0]}'; multi_robot_slam watch --help lists all"
        )


def _play(bag: Path, namespace: str | None, serving: Serving) -> None:
    require_viser()
    from multi_robot_slam.watch.page import Page
    from multi_robot_slam.watch.playing import Player
    from multi_robot_slam.watch.recording import Recording

    with messages.status(f"Reading {bag}"):
        recording = Recording(bag, namespace)
    for warning in recording.warnings:
        warn(warning)
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stops.append(number))
    page = Page(free(serving))
    if page.address.warning:
        warn(page.address.warning)
    console.print(f"{page.address} plays {bag} until Ctrl-C", markup=False, soft_wrap=True)
    player = Player(page, recording)
    while not stops:
        time.sleep(player.work())
    page.close()
