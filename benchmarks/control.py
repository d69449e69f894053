"""How well the control loop keeps its deadlines: 25 Hz, one 640x480 camera at 30 images a second.

The camera is a thread that takes an image 30 times a second, as a driver does; each is compressed
and recorded with joints at 100 Hz and what a policy saw and did. A tick also takes 5 ms of
arithmetic, in the place of policy, inverse kinematics and safety. Run it on a busy machine and on
an idle one; it says which it was.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from eisp_data.robots.arms import joint_limits
from eisp_data.robots.cell import HOME_RAD
from eisp_data.robots.loop import Ticks, priority
from eisp_data.robots.robot import CameraFrame, CameraIntrinsics, JointCommand, Reading, Robot
from eisp_data.robots.session_log import SessionLog

SECONDS, WORK_S, CAMERA_HZ = 30.0, 0.005, 30.0
HEIGHT, WIDTH = 480, 640


class Bench(Robot):
    """Joints that are where they were told to be, on the wall's time, and a camera thread."""

    name, arm, control_hz = "bench", "ur3", 25.0

    def __init__(self) -> None:
        self.limits = joint_limits("ur3")
        self.joint_names = tuple(f"joint_{i}" for i in range(6))
        self.cameras = {"top": CameraIntrinsics(WIDTH, HEIGHT, np.eye(3))}
        self._joints = np.array(HOME_RAD)
        self._frame: CameraFrame | None = None
        self._running = threading.Event()
        rng = np.random.default_rng(0)
        # Smooth with some grain, which is what a table costs to compress.
        scene = np.linspace(0, 200, WIDTH)[None, :, None] + np.zeros((HEIGHT, 1, 3))
        noise = rng.normal(0, 4, (8, HEIGHT, WIDTH, 3))
        self._images = np.clip(scene + noise, 0, 255).astype(np.uint8)

    def connect(self) -> None:
        """Start the camera."""
        self._running.set()
        self._thread = threading.Thread(target=self._film, daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Read the wall's clock."""
        return time.monotonic()

    def wait_until(self, robot_s: float) -> None:
        """Sleep."""
        time.sleep(max(0.0, robot_s - time.monotonic()))

    def observe(self) -> Reading:
        """Return the joints."""
        return Reading(self._joints, np.zeros(6), 0.08, self.now_s())

    def frames(self) -> dict[str, CameraFrame]:
        """Return the newest image."""
        return {"top": self._frame} if self._frame is not None else {}

    def command(self, command: JointCommand) -> JointCommand:
        """Be there."""
        self._joints = command.joint_position
        return command

    def stop(self) -> None:
        """Stand."""

    def disconnect(self) -> None:
        """Stop the camera."""
        self._running.clear()
        self._thread.join()

    def _film(self) -> None:
        start, number = time.monotonic(), 0
        while self._running.is_set():
            time.sleep(max(0.0, start + number / CAMERA_HZ - time.monotonic()))
            image = self._images[number % len(self._images)].copy()
            self._frame = CameraFrame(image, time.monotonic(), number)
            number += 1


def measure(first: bool) -> None:
    """Print how well deadlines were kept, running before ordinary processes or as one of them."""
    with contextlib.ExitStack() as stack:
        granted = stack.enter_context(priority()) if first else False
        robot = stack.enter_context(Bench())
        path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "session.mcap"
        log, ticks = SessionLog(robot, path, {"task": "stack"}), Ticks(robot, robot.control_hz)
        until = time.monotonic() + SECONDS
        used = time.process_time()
        for at_ns in ticks.run(lambda part: log.sense(part == 1)):
            work = time.perf_counter() + WORK_S
            while time.perf_counter() < work:
                pass
            log.sent(robot.command(JointCommand(np.array(HOME_RAD), 0.08)), at_ns)
            log.vector("/observation", np.zeros(55), at_ns)
            if time.monotonic() > until:
                break
        stats = log.close()
        share = (time.process_time() - used) / SECONDS
    print("real-time priority" if granted else "ordinary priority")
    print(f"  {ticks.timing()}")
    print(
        f"  {stats.written['/camera/top/image']} images recorded, {log.lost_frames['top']} lost, "
        f"{sum(stats.dropped.values())} messages dropped, {share:.0%} of a core used"
    )


if __name__ == "__main__":
    measure(first=True)
    measure(first=False)
