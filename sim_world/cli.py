"""The command `sim_world`: one function per verb."""

from pathlib import Path
from typing import Annotated

import typer

from msg_defs import cli
from msg_defs.errors import InputError
from sim_world import descriptors as database
from sim_world.team import team_scenario

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
    print(team_scenario(scenario, robots), end="")


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)
def robots(context: typer.Context) -> None:
    """Publish the robots' odometry and observations on ROS topics (needs ROS 2).

    Parameters are given as for any node, for example:
    sim_world robots --ros-args -p scenario:=FILE -p robots:=2 -p seed:=1
    """
    cli.start_node("sim_world.robots", context.args)


def main() -> None:
    """Entry point of the command `sim_world`."""
    cli.run(app)


if __name__ == "__main__":
    main()
