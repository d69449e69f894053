"""Inverse kinematics: how many random reachable poses are solved, how exactly and how fast.

A pose is reachable because some posture within the joint limits has it; the solver sees the pose
alone. The peer is the damped least-squares loop of Pinocchio's own tutorial, from the arm's home.
Times are of the processor, so that what else it is doing counts less.

    python benchmarks/ik.py [--poses 10000]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import pinocchio as pin

from eisp_data.errors import RobotError
from eisp_data.robots.arms import ARMS, arm_model
from eisp_data.robots.kinematics import Kinematics

EXACT_M, EXACT_RAD = 1e-4, 1e-3
PEER_SHARE = 20
"""The peer gets every 20th pose: it takes long."""


def tutorial(kinematics: Kinematics, wanted: np.ndarray) -> np.ndarray:
    """Return what Pinocchio's tutorial loop ends at: fixed damping and step, no joint limits."""
    model = arm_model(kinematics.arm)
    position = kinematics.home.copy()
    target = pin.SE3(wanted)
    for _ in range(1000):
        error = pin.log6(pin.SE3(kinematics.forward(position)).actInv(target)).vector
        if np.linalg.norm(error) < 1e-4:
            break
        rotation = kinematics.forward(position)[:3, :3].T
        jacobian = kinematics.jacobian(position)
        jacobian = np.concatenate([rotation @ jacobian[:3], rotation @ jacobian[3:]])
        inverse = np.linalg.solve(jacobian @ jacobian.T + 1e-12 * np.eye(6), error)
        position = pin.integrate(model, position, 0.1 * jacobian.T @ inverse)
    return position


def is_solved(kinematics: Kinematics, found: np.ndarray, wanted: np.ndarray) -> bool:
    """Whether that posture has the wanted pose and is within the limits."""
    reached = kinematics.forward(found)
    apart = np.linalg.norm(reached[:3, 3] - wanted[:3, 3])
    turned = np.linalg.norm(pin.log3(reached[:3, :3].T @ wanted[:3, :3]))
    within = (found >= kinematics.low).all() and (found <= kinematics.high).all()
    return bool(apart <= EXACT_M and turned <= EXACT_RAD and within)


def measure(arm: str, poses: int) -> None:
    """Print one arm's lines."""
    kinematics = Kinematics(arm)
    postures = kinematics.random_postures(np.random.default_rng(1), poses)
    wanted = [kinematics.forward(row) for row in postures]
    start = time.thread_time()
    kinematics.inverse(wanted[0])
    table_s = time.thread_time() - start
    solved, seconds = 0, np.empty(poses)
    for i, pose in enumerate(wanted):
        start = time.thread_time()
        try:
            found = kinematics.inverse(pose)
        except RobotError:
            found = np.full(postures.shape[1], np.nan)
        seconds[i] = time.thread_time() - start
        solved += bool(np.isfinite(found).all()) and is_solved(kinematics, found, pose)
    median, high99 = np.median(seconds) * 1e3, np.percentile(seconds, 99) * 1e3
    print(
        f"{arm:12s} solved {solved / poses:8.3%} of {poses}, median {median:.3f} ms,"
        f" 99% {high99:.2f} ms, most {seconds.max() * 1e3:.1f} ms; table {table_s:.2f} s"
    )
    some = wanted[::PEER_SHARE]
    start = time.thread_time()
    peer = sum(is_solved(kinematics, tutorial(kinematics, pose), pose) for pose in some)
    each = (time.thread_time() - start) / len(some) * 1e3
    print(
        f"{'':12s} the tutorial's loop: {peer / len(some):8.3%} of {len(some)}, {each:.1f} ms each"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=10_000)
    options = parser.parse_args()
    for name in ARMS:
        measure(name, options.poses)
