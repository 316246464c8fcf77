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
)
app.callback()(cli.options)

ScenarioName = Annotated[
    str,
    typer.Option(
        help="Scenario: a YAML file, or paper, calibrated or cameras.", autocompletion=cli.scenarios
    ),
]
Robots = Annotated[int | None, typer.Option(min=1, max=32, help="Number of robots.")]
Images = Annotated[
    bool,
    typer.Option(
        "--images",
        help="Robots publish pictures of their stereo cameras instead of landmarks, as with "
        "images.enabled in the scenario.",
    ),
]


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
    scenario: ScenarioName = "calibrated", robots: Robots = None, images: Images = False
) -> None:
    """Print the scenario with the team's names and true start poses in it, for every node.

    sim_world team --robots 2 > team.yaml
    sim_world robots --ros-args -p scenario:=team.yaml
    multi_robot_slam fusion --ros-args -p scenario:=team.yaml
    """
    print(team_scenario(scenario, robots, images=images), end="")


@app.command(no_args_is_help=True)
def generate(
    out: Annotated[Path, typer.Option(help="Bag to write; it must not exist yet.")],
    scenario: ScenarioName = "calibrated",
    robots: Robots = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the robots' noise, and of the filter in the bag.")
    ] = 0,
    rate: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=100,
            help="Frames of each robot in a second [Hz], instead of the scenario's. A lap takes as "
            "long as before: a higher rate gives smaller movements.",
        ),
    ] = None,
    laps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Rounds of the tour that the team makes. One takes T/K times period_s of the "
            "scenario: 75 s for three robots by default.",
        ),
    ] = None,
    images: Images = False,
) -> None:
    """Simulate a team straight into a bag, without ROS: `multi_robot_slam run BAG` needs no more.

    It holds what a recorder would: odometry and observations, the truth about them, walls and true
    landmarks, and the configurations of world and fusion. With --images pictures, without loss,
    take the place of observations and landmarks.
    """
    from multi_robot_slam.cli import simulated

    world, config = simulated.configure(scenario, robots, seed, rate, laps, images)
    simulated.write_bag(world, config, out)
    print(f"Now: multi_robot_slam run {out}")


@app.command(context_settings=cli.PASS_ON, add_help_option=False)
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
