"""Where a node's traffic goes."""

from pathlib import Path

import pytest

from msg_defs.errors import InputError
from msg_defs.ros import environment

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


def test_discovery_stays_on_this_machine_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.delenv(RANGE)
    environment.prepare()
    assert "other machines are not heard" in environment.reach()
    assert Path(environment.DEFAULTS["FASTRTPS_DEFAULT_PROFILES_FILE"]).is_file()
    monkeypatch.setenv(RANGE, "SUBNET")
    environment.prepare()
    assert "other machines are heard" in environment.reach()


@pytest.mark.parametrize("domain_id", ["999", "233", "-1", "one", "1.5"])
def test_a_domain_that_ros_does_not_have_is_refused(monkeypatch, domain_id):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain_id)
    with pytest.raises(InputError, match=f"ROS_DOMAIN_ID = '{domain_id}'; use a whole number"):
        environment.prepare()


@pytest.mark.parametrize("domain_id", ["", "0", "7", "232"])
def test_a_domain_that_ros_has_is_used_and_told(monkeypatch, domain_id):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain_id)
    environment.prepare()
    assert environment.reach().startswith(f"ROS_DOMAIN_ID {domain_id or 0};")
