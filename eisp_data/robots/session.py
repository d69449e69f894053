"""Episodes on a robot: each tick is seen, decided, sent and recorded; each ends standing still."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.look import FRESH_S, Look
from eisp_data.robots.loop import Ticks
from eisp_data.robots.motion import CartesianServo
from eisp_data.robots.mover import Mover
from eisp_data.robots.record_controllers import Controller, Decision
from eisp_data.robots.robot import JointCommand, Robot
from eisp_data.robots.session_log import SessionLog
from eisp_data.robots.session_status import StopSignal
from eisp_data.robots.session_view import Eyes, Seen
from eisp_data.storage.mcap.build import GOAL, REACHED, STATE, WORLD
from eisp_data.tasks.base import GRIPPER_DIM, is_success

_MET_TICKS = 12
"""An episode is a success once its goal has been seen to be met for half a second."""
_UNSEEN_TICKS = 150
"""What is out of sight has to have met it for so long: somebody may have taken it away."""
_STAND_TICKS = 8
"""What is wrong with the first images is said before the arm moves."""

Watch = Callable[[int, Seen, Decision], None]


def ignore(step: int, seen: Seen, decision: Decision) -> None:
    """Watch nothing."""


@dataclass(frozen=True)
class Ended:
    """How an episode went, as far as the robot itself can tell."""

    outcome: str
    """One of ``messages.OUTCOMES``, or empty if it was broken off."""
    ticks: int
    distance_m: float
    """See ``mean_distance_m``, at the end; NaN where there is no goal."""
    subgoals: int

    def __str__(self) -> str:
        text = f"{self.outcome or 'broken off'} after {self.ticks} ticks"
        if np.isfinite(self.distance_m):
            text += f", {self.distance_m:.3f} m to the goal"
        return text + (f", {self.subgoals} subgoals" if self.subgoals else "")


class Session:
    """Runs episodes on a connected robot.

    Attributes:
        ticks: the control loop's clock.
        doing: what is going on right now, for people.
        say: called with each line that people should see.
    """

    def __init__(
        self,
        robot: Robot,
        log: SessionLog,
        servo: CartesianServo,
        stop: StopSignal,
    ) -> None:
        """Take a connected robot with a safety filter."""
        self._robot, self._log, self._stop = robot, log, stop
        self._mover = Mover(robot, servo)
        self._since_s = 0.0
        self.ticks = Ticks(robot, robot.control_hz)
        self.doing = "standing"
        self.say: Callable[[str], None] = lambda line: None
        self._goal = np.empty(0)
        self._subgoal: np.ndarray | None = None
        self._look: Look | None = None
        self._look_due = False
        self._subgoals, self._by_human, self._at_ns = 0, False, 0

    def run_episode(
        self,
        controller: Controller,
        eyes: Eyes,
        goal: np.ndarray,
        most_ticks: int,
        seed: int,
        watch: Watch,
    ) -> Ended:
        """Run one episode, and leave the robot standing, whatever happens.

        Args:
            controller: decides.
            eyes: keep track of the table; new ones wherever somebody has set it.
            goal: (G,) m; empty where there is none.
            most_ticks: the episode ends after so many.
            seed: of the controller.
            watch: called after each tick with its number, what was seen and what was decided.

        Raises:
            RobotError: the robot or a camera does not answer, or something cannot be seen.
        """
        self._eyes, self._goal, self._subgoal = eyes, goal, None
        self._look, self._look_due = None, False
        self._mover.start()
        self._subgoals, self._by_human = 0, False
        # The table may have been set anew: an image from before shows another one.
        self._since_s = self._robot.now_s()
        ended: Ended | None = None
        try:
            ended = self._run(controller, most_ticks, seed, watch)
        finally:
            self._robot.stop()
            if ended is None or not ended.outcome:
                self._log.event("episode_end", self._at_ns)
            else:
                self._log.event("episode_end", self._at_ns, outcome=ended.outcome)
            self.doing = "standing"
        return ended

    def _run(self, controller: Controller, most_ticks: int, seed: int, watch: Watch) -> Ended:
        ticks = self.ticks.run(self._poll)
        if self._eyes.missing() and not self._look_first(ticks):
            return Ended("", 0, float("nan"), 0)
        met = met_in_sight = 0
        for step, at_ns in enumerate(ticks):
            self._at_ns = at_ns
            seen = self._eyes.see(at_ns / 1e9, self._log.reading)
            if step == 0:
                self._begin(controller, seen, seed, at_ns)
            self._record(seen, at_ns)
            met = met + 1 if self._is_met(seen) else 0
            # What comes into sight again where it was believed may be on its way elsewhere.
            met_in_sight = met_in_sight + 1 if met and seen.age_s < FRESH_S else 0
            sure = met_in_sight >= _MET_TICKS or met >= _UNSEEN_TICKS
            ending = self._ending(step, most_ticks, sure)
            if ending is not None:
                return self._ended(ending, step, seen)
            decision = self._decide(controller, seen)
            if decision.outcome:
                return self._ended(decision.outcome, step, seen)
            self._note(decision, seen, step, at_ns)
            command = self._mover.send(decision.action, self._log.reading)
            self._record_sent(decision, command, at_ns)
            watch(step, seen, decision)
        raise AssertionError("ticks never end")

    def _look_first(self, ticks: Iterator[int]) -> bool:
        """Get out of the camera's way until all is seen; False if somebody wants an end to it.

        Raises:
            RobotError: something is not to be seen from there either.
        """
        look: Look | None = None
        for number, at_ns in enumerate(ticks):
            self._at_ns = at_ns
            reading, missing = self._log.reading, self._eyes.missing()
            if self._stop.given:
                return False
            self.doing = f"looking for {', '.join(missing)}" if missing else "looking"
            if number < _STAND_TICKS:
                continue
            here = self._mover.servo.tool_in_task(reading.joint_position)
            look = look or Look(here, opens=False, holds=False)
            in_sight = not missing and self._eyes.see(at_ns / 1e9, reading).age_s < FRESH_S
            action = look.step(here, reading.gripper_opening_m, in_sight)
            if action is None:
                break
            self._log.sent(self._mover.send(action, reading), at_ns)
        if missing:
            raise RobotError(f"the camera does not see {', '.join(missing)}")
        return True

    def _decide(self, controller: Controller, seen: Seen) -> Decision:
        """Return what the controller decides, or how the look that it asked for goes on."""
        if self._look is None:
            decision = controller.act(seen)
            if not decision.looking:
                return decision
            holds = any(thing.held for thing in seen.estimates.objects.values())
            self._look = Look(seen.gripper_m, opens=True, holds=holds)
        opening_m = seen.estimates.tool.opening_m
        action = self._look.step(seen.gripper_m, opening_m, seen.age_s < FRESH_S)
        if action is not None:
            return Decision(action, looking=True)
        self._look = None
        return self._decide(controller, seen)

    def _poll(self, part: int) -> None:
        # Right after a command there is most time until the next one. A tick that took too long for
        # that puts it off: to the next poll in time, at worst to the one before the next tick.
        looks, self._look_due = self._look_due, part == 0
        self._log.sense(looks)
        frames = self._log.frames.items() if looks else ()
        fresh = {name: frame for name, frame in frames if frame.captured_s >= self._since_s}
        # Without images, too: when the fingers let go the joints tell, at their own rate.
        self._eyes.look(fresh, self._log.reading)

    def _begin(self, controller: Controller, seen: Seen, seed: int, at_ns: int) -> None:
        self._log.event("episode_start", at_ns, policy=controller.name, seed=seed)
        if len(self._goal):
            self._log.vector("/desired_goal", self._goal, at_ns, role=GOAL)
        controller.begin(seen, self._goal, seed)

    def _ending(self, step: int, most_ticks: int, met: bool) -> str | None:
        """Return how the episode ends now, None if it goes on."""
        if self._stop.given:
            return ""
        if met:
            self._log.event("success", self._at_ns)
            return "success"
        return "timeout" if step == most_ticks else None

    def _is_met(self, seen: Seen) -> bool:
        if not len(self._goal):
            return False
        return seen.settled and bool(is_success(seen.achieved_goal, self._goal))

    def _ended(self, outcome: str, step: int, seen: Seen) -> Ended:
        return Ended(outcome, step, self._distance_m(seen), self._subgoals)

    def _distance_m(self, seen: Seen) -> float:
        return mean_distance_m(seen.achieved_goal, self._goal) if len(self._goal) else float("nan")

    def _note(self, decision: Decision, seen: Seen, step: int, at_ns: int) -> None:
        """Record what begins or ends with this decision, and say what is going on."""
        subgoal, before = decision.subgoal, self._subgoal
        if subgoal is not None and (before is None or not np.array_equal(subgoal, before)):
            self._subgoal, self._subgoals = subgoal.copy(), self._subgoals + 1
            way = mean_distance_m(seen.achieved_goal, subgoal)
            self._log.event("subgoal", at_ns, number=self._subgoals, distance_m=f"{way:.4f}")
            self.say(
                f"{step / self._robot.control_hz:6.1f} s: subgoal {self._subgoals}, {way:.3f} m "
                f"away; the goal is {self._distance_m(seen):.3f} m away"
            )
        if decision.by_human != self._by_human:
            self._by_human = decision.by_human
            self._log.event(f"intervention_{'start' if self._by_human else 'end'}", at_ns)
        what = "by hand" if decision.by_human else "looking" if decision.looking else "acting"
        self.doing = f"{what}, {step / self._robot.control_hz:.1f} s"
        if len(self._goal):
            self.doing += f", {self._distance_m(seen):.3f} m to the goal"
        if self._subgoals:
            self.doing += f", subgoal {self._subgoals}"

    def _record(self, seen: Seen, at_ns: int) -> None:
        log, observation = self._log, seen.observation
        log.vector("/observation/state", observation[:GRIPPER_DIM], at_ns, role=STATE)
        if len(observation) > GRIPPER_DIM:
            log.vector("/observation/world", observation[GRIPPER_DIM:], at_ns, role=WORLD)
        log.vector("/achieved_goal", seen.achieved_goal, at_ns, role=REACHED)
        if seen.estimates.objects:
            log.objects(seen.estimates, at_ns)

    def _record_sent(self, decision: Decision, command: JointCommand, at_ns: int) -> None:
        log = self._log
        log.vector("/looking", [float(decision.looking)], at_ns, role="extra.looking")
        if self._subgoal is not None:
            log.vector("/subgoal", self._subgoal, at_ns, role="extra.subgoal")
        log.sent(command, at_ns)
        log.vector("/action", decision.action, at_ns, role="action")


def mean_distance_m(achieved_goal: np.ndarray, desired_goal: np.ndarray) -> float:
    """Return the mean over the objects of the distance to where they belong (the paper's appendix).

    Args:
        achieved_goal: (G,) m.
        desired_goal: (G,) m.
    """
    way = (achieved_goal - desired_goal).reshape(-1, 3)
    return float(np.linalg.norm(way, axis=1).mean())
