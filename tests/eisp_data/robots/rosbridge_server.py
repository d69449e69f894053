"""A stand-in for a TIAGo++ behind rosbridge, on loopback: the real messages, a simple robot."""

from __future__ import annotations

import base64
import json
import threading
import time

import cv2
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

HZ = 50.0


class RosbridgeServer:
    """Serves ``/joint_states`` and a camera, and moves the joints along trajectories.

    Attributes:
        host: ``address:port``.
        joints: name to rad (m for fingers).
        advertised: topics and types that were announced.
        received: the trajectories that arrived, by topic.
    """

    def __init__(self, joints: dict[str, float]) -> None:
        self.joints = dict(joints)
        self.advertised: dict[str, str] = {}
        self.received: dict[str, list[dict]] = {}
        self.camera_is_plugged = True
        self._links: list[ServerConnection] = []
        self._server = serve(self._serve, "127.0.0.1", 0)
        self.host = f"127.0.0.1:{self._server.socket.getsockname()[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Cut every connection."""
        self._server.shutdown()
        for link in self._links:
            link.socket.close()

    def _serve(self, link: ServerConnection) -> None:
        self._links.append(link)
        topics: set[str] = set()
        threading.Thread(target=self._publish, args=(link, topics), daemon=True).start()
        for text in link:
            message = json.loads(text)
            if message["op"] == "subscribe":
                topics.add(message["topic"])
            elif message["op"] == "advertise":
                self.advertised[message["topic"]] = message["type"]
            elif message["op"] == "publish":
                self._take(link, message)

    def _take(self, link, message) -> None:
        topic, trajectory = message["topic"], message["msg"]
        if topic not in self.advertised:
            error = {"op": "status", "level": "error", "msg": f"{topic} is not advertised"}
            link.send(json.dumps(error))
            return
        self.received.setdefault(topic, []).append(trajectory)
        for point in trajectory.get("points", []):
            self.joints |= zip(trajectory["joint_names"], point["positions"], strict=True)

    def _publish(self, link, topics) -> None:
        number = 0
        try:
            while True:
                for topic, message in self._messages(number).items():
                    if topic in topics:
                        text = {"op": "publish", "topic": topic, "msg": message}
                        link.send(json.dumps(text))
                number += 1
                time.sleep(1 / HZ)
        except (ConnectionClosed, OSError):
            return

    def _messages(self, number: int) -> dict[str, dict]:
        seconds = 1.7e9 + time.monotonic()
        stamp = {"secs": int(seconds), "nsecs": int(seconds % 1 * 1e9)}
        header = {"seq": number, "stamp": stamp, "frame_id": ""}
        count = len(self.joints)
        messages = {
            "/joint_states": {
                "header": header,
                "name": list(self.joints),
                "position": list(self.joints.values()),
                "velocity": [0.0] * count,
                "effort": [0.5] * count,
            },
            "/top/camera_info": {
                "header": header,
                "width": 64,
                "height": 48,
                "K": [60.0, 0, 32, 0, 60, 24, 0, 0, 1],
                "D": [0.1, 0, 0, 0, 0],
            },
        }
        if self.camera_is_plugged:
            image = np.zeros((48, 64, 3), np.uint8)
            image[:, :, 2] = 200
            data = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
            messages["/top/image_raw/compressed"] = {
                "header": header,
                "format": "png",
                "data": data,
            }
        return messages
