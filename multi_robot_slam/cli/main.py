"""The command `multi_robot_slam`: its verbs, in the order of its help."""

import typer

from msg_defs import cli
from multi_robot_slam.cli import convert, judge, landmarks, maps, nodes, run, study, watch

app = typer.Typer(
    help="Multi-robot visual SLAM: one landmark map and all robots' paths.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)
verbs = (run.demo, run.run, landmarks.landmarks, judge.evaluate, judge.report, judge.compare)
for verb in (*verbs, judge.export):
    app.command()(verb)
app.add_typer(maps.app, name="map")
app.add_typer(convert.app, name="convert")
app.command(context_settings=cli.PASS_ON)(watch.watch)
for node in (nodes.camera, nodes.fusion, nodes.record, nodes.replay):
    app.command(context_settings=cli.PASS_ON, add_help_option=False)(node)
app.add_typer(study.app, name="study")
# Programs that follow the speed over versions call `bench --json`.
app.command(hidden=True)(study.bench)
app.callback()(cli.options)


def main() -> None:
    """Entry point of the command `multi_robot_slam`."""
    cli.run(app)


if __name__ == "__main__":
    main()
