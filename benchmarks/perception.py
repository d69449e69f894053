"""How right and how fast perception is in the twin, against the referee's truth.

    python benchmarks/perception.py           # prints a table for each of three settings

- random scenes: every task's start, its blocks turned at random, as the first images show it;
- scripted motion: the oracle's script does the whole task, with the truth of every tick;
- occlusion: the same, but after each grasp no image arrives for 2.5 s, while the block is carried.

Errors are those of object positions. The rate is that of the process's own time on one core, for
an image with all that follows from it; making the image is not in it, for a camera does that.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

import cv2
import numpy as np
import tyro

from eisp_data.policies.registry import SCRIPTS
from eisp_data.policies.script import Noise, ScriptedPolicy
from eisp_data.robots.loop import POLLS
from eisp_data.robots.motion import CartesianServo
from eisp_data.robots.mover import Mover
from eisp_data.robots.robot import CameraFrame
from eisp_data.robots.safe_robot import SafeRobot
from eisp_data.robots.tracker import Tracker
from eisp_data.robots.twin.camera import CAMERA
from eisp_data.robots.twin.robot import TwinRobot
from eisp_data.tasks.registry import TASKS

_WARM_UP_S = 0.3
_HIDDEN_S = 2.0


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    tasks: tuple[str, ...] = tuple(TASKS)
    scenes: int = 10
    """Random scenes of each task."""
    episodes: int = 2
    """Scripted episodes of each task, in each of the two settings that have them."""
    speed: float = 0.4
    """Share of the speed that the policies were trained with; 1 is 1 m/s."""
    most_steps: int = 500
    occlusion_s: float = 2.5
    """Without images after each grasp."""
    seed: int = 0


@dataclasses.dataclass
class Sample:
    """One object at one tick."""

    error_m: float
    age_s: float
    held: bool


class Watcher:
    """A twin, its tracker, and what they disagree about."""

    def __init__(self, task: str, seed: int) -> None:
        self.robot = TwinRobot(task, seed=seed)
        self.robot.connect()
        self.restart()

    def restart(self) -> None:
        """Forget what was seen."""
        self.tracker = Tracker(self.robot.task, self.robot.calibration, CAMERA, self.robot.arm)

    def follow(self) -> None:
        """Take in what the joints say, as a session does between two ticks."""
        self.tracker.update(self.robot.observe())

    def look(self, busy_s: list[float], hide: bool = False) -> list[Sample]:
        """Take in what is there now; return how right it is, an item for each object."""
        reading = self.robot.observe()
        frame: CameraFrame | None = None if hide else self.robot.frames().get(CAMERA)
        start = time.process_time()
        estimates = self.tracker.update(reading, frame)
        if frame is not None:
            busy_s.append(time.process_time() - start)
        return [
            Sample(
                error_m=float(
                    np.linalg.norm(
                        thing.transform_object_to_task[:3, 3]
                        - self.robot.referee.object_pose(name)[:3, 3]
                    )
                ),
                age_s=thing.age_s,
                held=thing.held,
            )
            for name, thing in estimates.objects.items()
        ]


def random_scenes(task: str, options: Options, busy_s: list[float]) -> Iterator[Sample]:
    """Yield the objects of random scenes, each after a few images."""
    rng = np.random.default_rng(options.seed)
    watcher = Watcher(task, options.seed)
    robot, referee = watcher.robot, watcher.robot.referee
    for scene in range(options.scenes):
        referee.reset(options.seed + scene)
        for block in range(robot.task.blocks):
            place = referee.object_pose(f"block{block}")[:3, 3].copy()
            referee.move_block(block, place, rng.uniform(-np.pi, np.pi))
        watcher.restart()
        robot.wait_until(robot.now_s() + _WARM_UP_S)
        for _ in range(3):
            robot.wait_until(robot.now_s() + 1 / robot.control_hz)
            samples = watcher.look(busy_s)
        yield from samples
    robot.disconnect()


def scripted(
    task: str, seed: int, options: Options, busy_s: list[float], occlude: bool
) -> Iterator[Sample]:
    """Yield the objects at every tick of an episode of the oracle's script."""
    watcher = Watcher(task, seed)
    robot, referee = watcher.robot, watcher.robot.referee
    goal = referee.reset(seed)
    servo = CartesianServo(
        robot.arm,
        robot.control_hz,
        robot.calibration.transform_task_to_base,
        options.speed,
        robot.task.fingers_closed,
    )
    safe = SafeRobot(robot)
    safe.connect()
    mover = Mover(safe, servo)
    mover.start()
    robot.wait_until(_WARM_UP_S)
    policy = ScriptedPolicy(robot.task, SCRIPTS[task], Noise(), 1)
    policy.begin(0, referee.state()[None], goal, seed)
    dark_until_s, was_held = 0.0, False
    for _ in range(options.most_steps):
        now = robot.now_s()
        samples = watcher.look(busy_s, hide=now < dark_until_s)
        held = any(sample.held for sample in samples)
        if occlude and held and not was_held:
            dark_until_s = now + options.occlusion_s
        was_held = held
        yield from samples
        if policy.finished[0]:
            break
        mover.send(policy.act(referee.state()[None])[0], safe.observe())
        for part in range(1, POLLS):
            robot.wait_until(now + part / POLLS / robot.control_hz)
            watcher.follow()
        robot.wait_until(now + 1 / robot.control_hz)
    print(
        f"  {task}, seed {seed}: {'solved' if referee.success(goal) else 'not solved'}", flush=True
    )
    robot.disconnect()


def report(name: str, samples: list[Sample]) -> None:
    """Print a row of the table."""
    error = 1000 * np.array([sample.error_m for sample in samples])
    if not len(error):
        print(f"{name:34}{0:8}")
        return
    median, most = np.median(error), error.max()
    share = np.percentile(error, 95)
    print(f"{name:34}{len(error):8}{median:10.2f}{share:10.2f}{most:10.1f}", flush=True)


def main(options: Options) -> None:
    """Measure and print."""
    cv2.setNumThreads(1)
    busy_s: list[float] = []
    print(f"{'position error, mm':34}{'samples':>8}{'median':>10}{'95%':>10}{'most':>10}")
    everything: list[Sample] = []
    for task in options.tasks:
        samples = list(random_scenes(task, options, busy_s))
        report(f"{task}, random scenes", samples)
        everything += samples
    report("all, random scenes", everything)
    for occlude, name in ((False, "scripted motion"), (True, "occlusion")):
        everything = []
        for task in options.tasks:
            samples = []
            for episode in range(options.episodes):
                samples += scripted(task, options.seed + episode, options, busy_s, occlude)
            report(f"{task}, {name}", samples)
            everything += samples
        report(f"all, {name}", everything)
        report("  of them not seen for over 0.1 s", [s for s in everything if s.age_s > 0.1])
        unseen = [s for s in everything if s.age_s >= _HIDDEN_S]
        report("  of them not seen for 2 s", unseen)
        report("  of these in the gripper", [s for s in unseen if s.held])
    busy = 1000 * np.array(busy_s)
    middle, slow = np.percentile(busy, [50, 95])
    print(
        f"one image takes {middle:.1f} ms of one core (median), {slow:.1f} ms (95%): "
        f"{1000 / busy.mean():.0f} images/s"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
