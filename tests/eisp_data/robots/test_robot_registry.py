"""The robots by name, and what each of them promises."""

import sys
from importlib import import_module
from importlib.util import find_spec

import pytest

from eisp_data.errors import ConfigError
from eisp_data.robots import models
from eisp_data.robots.registry import ROBOTS, make_robot
from eisp_data.robots.robot import Robot
from eisp_data.robots.robot_config import RobotConfig, choose_camera, make_configured

UR3 = pytest.param(
    "ur3",
    marks=pytest.mark.skipif(not find_spec("rtde_control"), reason="no wheel of ur-rtde here"),
)


@pytest.mark.parametrize("name", [UR3, *(name for name in ROBOTS if name != "ur3")])
def test_every_factory_makes_a_robot(name):
    module, _, factory = ROBOTS[name].factory.partition(":")
    assert issubclass(getattr(import_module(module), factory), Robot)


@pytest.mark.parametrize("name", [UR3, "tiago"])
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


@pytest.mark.parametrize(("side", "arm"), [(None, "tiago_left"), ("right", "tiago_right")])
def test_the_command_line_chooses_the_arm_of_a_tiago(side, arm):
    config = RobotConfig(robot="tiago", host="127.0.0.1", side=side)
    assert make_configured(config, {}).arm == arm


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"robot": "ur3", "host": "127.0.0.1", "side": "right"},
            "only tiago has two arms, not ur3",
        ),
        ({"robot": "tiago"}, "--robot tiago: missing --host"),
        ({"robot": "r2d2"}, "unknown robot 'r2d2'; choose one of twin, ur3, tiago"),
    ],
)
def test_a_robot_that_the_command_line_cannot_mean_is_one_line(options, said):
    with pytest.raises(ConfigError, match=said):
        make_configured(RobotConfig(**options), {})


def test_a_camera_is_the_only_one_or_the_one_that_was_chosen():
    robot = make_robot("tiago", host="127.0.0.1")
    assert choose_camera(RobotConfig(), robot) is None
    robot.cameras = dict.fromkeys(("top", "wrist"))
    assert choose_camera(RobotConfig(camera="wrist"), robot) == "wrist"
    with pytest.raises(ConfigError, match="missing --camera: choose one of top, wrist"):
        choose_camera(RobotConfig(), robot)
    with pytest.raises(ConfigError, match="--camera side: choose one of top, wrist"):
        choose_camera(RobotConfig(camera="side"), robot)
