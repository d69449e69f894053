"""A camera that OpenCV opens, here a file in place of a device."""

import time

import cv2
import numpy as np
import pytest

from eisp_data.errors import RobotError
from eisp_data.robots.camera import OpenCvCamera


@pytest.fixture
def film(tmp_path):
    path = str(tmp_path / "film.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 30, (64, 48))
    for _ in range(20):
        frame = np.zeros((48, 64, 3), np.uint8)
        frame[..., 2] = 220
        writer.write(frame)
    writer.release()
    return path


def test_frames_are_rgb_counted_and_stamped(film):
    camera = OpenCvCamera(film, 64, 48)
    before = time.monotonic()
    camera.open()
    frame = camera.frame()
    camera.close()
    assert frame.image.shape == (48, 64, 3)
    red, green, blue = frame.image.reshape(-1, 3).mean(axis=0)
    assert red > 180 and green < 40 and blue < 40
    assert before <= frame.captured_s <= time.monotonic()


def test_a_camera_that_falls_silent_is_unplugged(film):
    camera = OpenCvCamera(film, 64, 48)
    camera.open()
    until = time.monotonic() + 20.0
    with pytest.raises(RobotError, match="is unplugged"):
        while time.monotonic() < until:
            frame = camera.frame()
            time.sleep(0.05)
    assert frame.sequence == 19, "each of the 20 was counted"
    camera.close()
    camera.close()


def test_another_size_than_was_asked_for_is_one_line(film):
    with pytest.raises(RobotError, match="gives 64x48 pixels; asked for were 640x480"):
        OpenCvCamera(film).open()
