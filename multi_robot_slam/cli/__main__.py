"""`python -m multi_robot_slam.cli`: the command without its script."""

from multi_robot_slam.cli.main import main

if __name__ == "__main__":
    main()
