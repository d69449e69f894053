"""A camera that OpenCV can open: a device by number or path, a stream by address, a video file."""

from __future__ import annotations

import threading
import time

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.robot import CameraFrame, CameraIntrinsics

_SILENCE_S = 1.0
"""A camera that gives no image for this long is unplugged."""


class OpenCvCamera:
    """Reads in its own thread, so that the newest frame is always at hand."""

    def __init__(self, source: str, width: int = 640, height: int = 480) -> None:
        """Prepare; ``open`` starts it.

        Args:
            source: a number, a path or an address, as ``cv2.VideoCapture`` takes them.
            width: of the image that is asked for, pixels.
            height: likewise.
        """
        self.source = source
        # No driver knows a lens: this is a usual one, until a calibration says better.
        matrix = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], float)
        self.intrinsics = CameraIntrinsics(width, height, matrix)
        self._frame: CameraFrame | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Start reading.

        Raises:
            RobotError: it cannot be opened, gives no image, or one of another size.
        """
        import cv2

        source = int(self.source) if self.source.isdigit() else self.source
        capture = cv2.VideoCapture(source)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.intrinsics.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.intrinsics.height)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        read, image = capture.read()
        if not read:
            capture.release()
            raise RobotError(f"camera {self.source!r} gives no image")
        if image.shape[:2] != (self.intrinsics.height, self.intrinsics.width):
            capture.release()
            raise RobotError(
                f"camera {self.source!r} gives {image.shape[1]}x{image.shape[0]} pixels;"
                f" asked for were {self.intrinsics.width}x{self.intrinsics.height}"
            )
        self._closing.clear()
        self._keep(image, 0)
        self._thread = threading.Thread(target=self._read, args=(capture,), daemon=True)
        self._thread.start()

    def frame(self) -> CameraFrame:
        """Return the newest frame; RobotError if the last one is long ago."""
        frame = self._frame
        if frame is None or time.monotonic() - frame.captured_s > _SILENCE_S:
            raise RobotError(f"camera {self.source!r} is unplugged")
        return frame

    def close(self) -> None:
        """Stop reading; safe to call twice, or unopened."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(timeout=2 * _SILENCE_S)
        self._frame = self._thread = None

    def _read(self, capture) -> None:
        number = 1
        while not self._closing.is_set():
            read, image = capture.read()
            if not read:
                break
            self._keep(image, number)
            number += 1
        capture.release()

    def _keep(self, image: np.ndarray, number: int) -> None:
        # OpenCV's stamps differ from backend to backend; the arrival is late by the transfer only.
        rgb = np.ascontiguousarray(image[:, :, ::-1])
        self._frame = CameraFrame(rgb, captured_s=time.monotonic(), sequence=number)
