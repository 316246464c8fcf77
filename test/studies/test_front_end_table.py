"""The table of the front end's figures."""

import pytest

from msg_defs.errors import InputError
from multi_robot_slam.cli.study import front_end
from multi_robot_slam.studies import front_end_table


def test_rendered_images_are_timed(monkeypatch):
    monkeypatch.setattr(front_end_table, "PAIRS", 2)
    found = front_end_table.of_rendered("noise")
    assert set(found) == {"rendering [ms]", "front end [ms]"}
    assert min(found.values()) > 0


def test_a_figure_is_a_row():
    table = front_end_table.markdown({"drift [%]": 1.23456, "steps lost": 0})
    assert table.splitlines()[2:] == ["| drift [%] | 1.235 |", "| steps lost | 0 |"]


@pytest.mark.parametrize(
    ("source", "folder", "setup", "told"),
    [
        ("tum", None, "rendered", "no images 'tum'"),
        ("euroc", None, "rendered", "name the folder"),
        ("rendered", "here", "rendered", "name the folder"),
        ("rendered", None, "landmark level", "no set-up 'landmark level'"),
    ],
)
def test_what_there_is_not_is_told(source, folder, setup, told):
    with pytest.raises(InputError, match=told):
        front_end(source, folder, setup=setup)
