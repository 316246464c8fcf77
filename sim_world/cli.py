"""The command `sim_world`: one function per verb."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
import yaml

from msg_defs import cli, settings
from msg_defs.errors import InputError
from sim_world import descriptors as database
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import Simulation

app = typer.Typer(
    help="The simulated world: a building with visual landmarks, and a team of robots in it.",
    no_args_is_help=True,
    add_completion=False,
)


@app.command(no_args_is_help=True)
def descriptors(
    images: Annotated[
        list[Path], typer.Argument(metavar="IMAGES", help="Images, or folders of images.")
    ],
    out: Annotated[Path, typer.Option(help="File to write; it must not exist yet.")],
) -> None:
    """Build a database of SIFT descriptors from images.

    Landmarks take their descriptors from it when the scenario names the file as
    descriptor_database. Near-identical descriptors are stored once.
    """
    if out.exists():
        raise InputError(f"{out} exists; remove it or choose another name")
    found = database.build(database.find_images(images))
    database.save(found, out)
    print(f"{len(found)} descriptors in {out}")


@app.command()
def team(
    scenario: Annotated[
        str, typer.Option(help="Scenario: a YAML file, or paper or calibrated.")
    ] = "calibrated",
    robots: Annotated[int | None, typer.Option(min=1, max=32, help="Number of robots.")] = None,
) -> None:
    """Print the scenario with the team's names and true start poses in it, for every node.

    sim_world team --robots 2 > team.yaml
    sim_world robots --ros-args -p scenario:=team.yaml
    multi_robot_slam fusion --ros-args -p scenario:=team.yaml
    """
    path = settings.find_scenario(scenario)
    world = settings.from_file(Scenario, path, SECTION)
    if robots is not None:
        world = replace(world, robots=robots)
    starts = Simulation(world, seed=0).start_poses
    estimate = (yaml.safe_load(path.read_text()) or {}).get("multi_robot_slam") or {}
    estimate |= {
        "robots": list(starts),
        "start_poses": [pose.tolist() for pose in starts.values()],
        "mount": settings.to_plain(world.camera.mount),
    }
    sections = {SECTION: settings.to_plain(world), "multi_robot_slam": estimate}
    print(yaml.safe_dump(sections, sort_keys=False), end="")


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def robots(context: typer.Context) -> None:
    """Publish the robots' odometry and observations on ROS topics (needs ROS 2).

    Parameters are given as for any node, for example:
    sim_world robots --ros-args -p scenario:=FILE -p robots:=2 -p seed:=1
    """
    try:
        from sim_world.robots import main as publish
    except ModuleNotFoundError as error:
        raise InputError(
            f"no module '{error.name}': source ROS 2, or pip install 'multi_robot_slam[ros]'"
        ) from None
    sys.exit(publish(context.args))


def main() -> None:
    """Entry point of the command `sim_world`."""
    cli.run(app)


if __name__ == "__main__":
    main()
