"""Runs side by side: the same figures as in their files, and what differs between them."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.runs import comparison
from multi_robot_slam.runs.evaluation import evaluate
from test.helpers import fake_run, moved


def written(folder, error_m, bag="bag", **of_filter):
    """The folder of a run whose path is so far off."""
    run = fake_run()
    robots = {n: replace(r, path=moved(r.truth, (error_m, 0, 0))) for n, r in run.robots.items()}
    config = replace(run.config, filter=replace(run.config.filter, **of_filter))
    run = replace(run, robots=robots, config=config, bag=Path("recordings", bag))
    runs.write(run, evaluate(run), folder)
    return folder


def shown(compared) -> str:
    console = Console(width=120)
    with console.capture() as capture:
        console.print(comparison.table(compared))
    return capture.get()


@pytest.fixture
def folders(tmp_path):
    return [written(tmp_path / f"run_{n}", error) for n, error in enumerate((1.0, 1.5, 1.0))]


def test_every_figure_of_every_run_is_there(folders, tmp_path):
    compared = comparison.compare(folders)
    comparison.write(compared, tmp_path / "all.csv")
    rows = list(csv.DictReader((tmp_path / "all.csv").read_text().splitlines()))
    for folder in folders:
        own = runs.flat(runs.figures_in(folder))
        assert {(row["robot"], row["figure"]): row[str(folder)] for row in rows} == {
            key: "" if value is None else str(value) for key, value in own.items()
        }


def test_differences_from_the_first_are_marked_and_equal_figures_are_not(folders):
    lines = shown(comparison.compare(folders)).splitlines()
    path = next(line for line in lines if " after the run " in line)
    assert "1.500 (+50.0%)" in path
    assert path.count("1.000") == 2
    assert path.count("(") == 1
    same = [line for line in lines if " odometry " in line]
    assert len(same) > 2
    assert all("(" not in line for line in same)


@pytest.mark.parametrize(
    ("name", "first", "value", "text"),
    [
        ("path_rmse_m", 2.0, 1.0, "green"),
        ("path_rmse_m", 1.0, 2.0, "red"),
        ("association_recall", 0.5, 0.6, "green"),
        ("duplicates", 5, 9, "red"),
        ("pose_nees", 2.0, 5.0, ""),
    ],
)
def test_colour_says_what_is_better(name, first, value, text):
    cell = comparison.marked(name, first, value)
    assert [str(span.style) for span in cell.spans if span.style] == [text] * bool(text)


def test_nothing_is_marked_beside_what_is_not_known():
    assert comparison.marked("path_rmse_m", None, 1.0).plain == "1.000"
    assert comparison.marked("path_rmse_m", 1.0, None).plain == "-"
    assert comparison.marked("duplicates", 0, 3).plain == "3 (+3)"
    assert comparison.marked("pose_nees", 3.0, 3e9).plain == "3e+09 (x 1e+09)"


def test_other_recordings_and_settings_are_told(tmp_path):
    one = written(tmp_path / "one", 1.0, particles=100)
    same = written(tmp_path / "same", 2.0, particles=100)
    other = written(tmp_path / "other", 1.0, bag="another", particles=200)
    assert comparison.notes(comparison.compare([one, same])) == []
    bags, particles = comparison.notes(comparison.compare([one, other]))
    assert bags == "of different recordings: recordings/bag | recordings/another"
    assert particles == "filter.particles: 100 | 200"


def test_other_machines_are_told(tmp_path):
    folders = []
    for cores in (2, 2, 64):
        made = runs.Provenance("1", None, {"processor": "a chip", "cores": cores})
        run = replace(fake_run(), provenance=made)
        folders.append(tmp_path / f"run_{len(folders)}")
        runs.write(run, evaluate(run), folders[-1])
    assert comparison.notes(comparison.compare(folders[:2])) == []
    (told,) = comparison.notes(comparison.compare(folders[1:]))
    assert told == "on different machines: a chip, 2 | a chip, 64"


def test_robot_that_only_one_run_has_is_shown_for_that_one(folders, tmp_path):
    run = fake_run(robots=1)
    runs.write(run, evaluate(run), tmp_path / "alone")
    compared = comparison.compare([tmp_path / "alone", folders[0]])
    assert compared.figures["robot_2", "path_rmse_m"] == (None, pytest.approx(1.0))
    assert "robot_2" in shown(compared)


def test_what_cannot_be_compared_is_refused(folders, tmp_path):
    with pytest.raises(InputError, match="two folders or more"):
        comparison.compare(folders[:1])
    with pytest.raises(InputError, match=r"cannot read .*nowhere/"):
        comparison.compare([folders[0], tmp_path / "nowhere"])
    (folders[1] / "config.yaml").unlink()
    with pytest.raises(InputError, match=r"cannot read .*config.yaml"):
        comparison.compare(folders)
    with pytest.raises(InputError, match="cannot write"):
        comparison.write(comparison.compare(folders[::2]), tmp_path / "nowhere" / "all.csv")
