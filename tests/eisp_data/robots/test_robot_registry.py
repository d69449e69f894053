"""The robots by name, and what each of them promises."""

import sys
from importlib import import_module

import pytest

from eisp_data.errors import ConfigError
from eisp_data.robots import models
from eisp_data.robots.registry import ROBOTS, make_robot
from eisp_data.robots.robot import Robot


@pytest.mark.parametrize("name", ROBOTS)
def test_every_factory_makes_a_robot(name):
    module, _, factory = ROBOTS[name].factory.partition(":")
    assert issubclass(getattr(import_module(module), factory), Robot)


@pytest.mark.parametrize("name", ["ur3", "tiago"])
def test_a_robot_that_was_never_connected_can_be_stopped_and_disconnected(name):
    robot = make_robot(name, host="127.0.0.1")
    assert len(robot.joint_names) == len(robot.limits.velocity)
    robot.stop()
    robot.disconnect()
    robot.disconnect()


def test_an_unknown_robot_is_told_the_choices():
    with pytest.raises(ConfigError, match="unknown robot 'ur5'; choose one of twin, ur3, tiago"):
        make_robot("ur5")


def test_a_missing_extra_names_itself(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("websockets")]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("tiago", "rosbridge"):
        monkeypatch.delitem(sys.modules, f"eisp_data.robots.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(ConfigError, match=r"robot 'tiago' needs .*: pip install 'eisp\[tiago\]'"):
        make_robot("tiago", host="127.0.0.1")


def test_missing_models_name_their_extra(monkeypatch):
    monkeypatch.setattr(models, "_PACKAGE", "no-such-package")
    with pytest.raises(ConfigError, match=r"pip install 'eisp\[robot\]'"):
        models.models_folder()
