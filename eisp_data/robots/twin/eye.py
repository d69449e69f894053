"""When the twin's images are taken: as they are asked for, or in a thread that keeps the rate."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

from eisp_data.robots.robot import CameraFrame
from eisp_data.robots.twin.camera import TwinCamera
from eisp_data.robots.twin.world import Snapshot, World


class LazyEye:
    """Takes an image when it is asked for: what nobody looks at costs nothing."""

    def __init__(self, open_camera: Callable[[], TwinCamera], world: World, latency_s: float):
        self._open, self._world, self._latency_s = open_camera, world, latency_s
        self._camera: TwinCamera | None = None
        self._frame: CameraFrame | None = None

    def newest(self, now_s: float) -> CameraFrame | None:
        """Return the newest image that can be had by now."""
        arrived: Snapshot | None = None
        snapshots = self._world.snapshots
        while snapshots and snapshots[0].captured_s + self._latency_s <= now_s:
            arrived = snapshots.popleft()
        if arrived is not None:
            if self._camera is None:
                self._camera = self._open()
            self._frame = _take(self._camera, arrived)
        return self._frame

    def close(self) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


class ThreadEye:
    """Takes every image in a thread of its own, as soon as the light falls on the sensor."""

    def __init__(
        self,
        open_camera: Callable[[], TwinCamera],
        snapshots: Callable[[float], list[Snapshot]],
        wait: Callable[[float], None],
        period_s: float,
        latency_s: float,
    ) -> None:
        """Start; raises what ``open_camera`` raises.

        Args:
            open_camera: called in the thread.
            snapshots: called in the thread; brings the world to that time and returns what the
                camera took until then.
            wait: waits until that time.
            period_s: from one image to the next.
            latency_s: from when the light falls on the sensor until the image can be had.
        """
        self._open, self._snapshots, self._wait = open_camera, snapshots, wait
        self._period_s, self._latency_s = period_s, latency_s
        self._frames: deque[CameraFrame] = deque(maxlen=8 + math.ceil(latency_s / period_s))
        self._newest: CameraFrame | None = None
        self._running, self._ready = True, threading.Event()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="twin-camera", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def newest(self, now_s: float) -> CameraFrame | None:
        """Return the newest image that can be had by now.

        Raises:
            Exception: what stopped the camera.
        """
        if self._failure is not None:
            raise self._failure
        while self._frames and self._frames[0].captured_s + self._latency_s <= now_s:
            self._newest = self._frames.popleft()
        return self._newest

    def close(self) -> None:
        """End the thread, which frees the camera."""
        self._running = False
        self._thread.join()

    def _run(self) -> None:
        try:
            camera = self._open()
        except Exception as error:
            self._failure = error
            self._ready.set()
            return
        self._ready.set()
        shot = 0
        try:
            while self._running:
                self._wait(shot * self._period_s)
                taken = self._snapshots(shot * self._period_s)
                if taken:
                    # Of those that came while the last one was being drawn only the newest: the
                    # gap in the sequence tells.
                    self._frames.append(_take(camera, taken[-1]))
                    shot = taken[-1].sequence
                shot += 1
        except Exception as error:
            self._failure = error
        finally:
            camera.close()


def _take(camera: TwinCamera, moment: Snapshot) -> CameraFrame:
    return CameraFrame(camera.take(moment.qpos), moment.captured_s, moment.sequence)
