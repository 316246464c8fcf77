"""What setup.cfg cannot say: the files that ament and `ros2 run` look for."""

from glob import glob

from setuptools import setup

setup(
    # Here, not in setup.cfg, which makes an object of it that colcon cannot read.
    python_requires=">=3.11",
    data_files=[
        # One package, two names for `ros2 run`.
        (
            "share/ament_index/resource_index/packages",
            ["resource/multi_robot_slam", "resource/sim_world"],
        ),
        ("share/multi_robot_slam", ["package.xml"]),
        ("share/sim_world", ["resource/share/sim_world/package.xml"]),
        ("share/multi_robot_slam/config", sorted(glob("config/*.*"))),
        ("share/multi_robot_slam/launch", sorted(glob("launch/*.launch.py"))),
        ("lib/sim_world", ["scripts/robots"]),
        (
            "lib/multi_robot_slam",
            [f"scripts/{name}" for name in ("camera", "fusion", "record", "replay", "watch")],
        ),
    ],
)
