"""The truth about the twin, for evaluation only: perception and policies must not look here."""

from __future__ import annotations

import threading

import mujoco
import numpy as np

from eisp_data.robots import cell
from eisp_data.robots.twin.camera import MountedCamera
from eisp_data.robots.twin.model import FINGERS, TOOL
from eisp_data.robots.twin.world import World
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.base import Task, is_success


class Referee:
    """Sees all, sets the table, and is the external hand that moves a block.

    Attributes:
        camera: where the camera really is, and its lens.
        unplugged_camera, unplugged_arm: set them to see what happens.
    """

    def __init__(
        self, task: Task, world: World, camera: MountedCamera, lock: threading.RLock
    ) -> None:
        self.camera = camera
        self.unplugged_camera = self.unplugged_arm = False
        self._task, self._world, self._lock = task, world, lock

    def reset(self, seed: int) -> np.ndarray:
        """Set the table as the task's start of that seed has it, and the arm at home.

        Returns:
            (G,) float32, the desired goal, in the task's frame.
        """
        state, goal = self._task.reset(np.random.default_rng(seed))
        with self._lock:
            world = self._world
            self._set_objects(state)
            world.snapshots.clear()
            world.go_home(0.0 if self._task.fingers_closed else None)
        return goal

    def state(self) -> np.ndarray:
        """Return the task's state (P,), as its own scene would have it."""
        with self._lock:
            data, task = self._current(), self._task
            state = np.zeros(1 + task.model.nq + task.model.nv)
            state[0] = data.time
            qpos, qvel = task.qpos(state), task.qvel(state)
            site = data.site(TOOL)
            qpos[:3] = site.xpos
            velocity = np.empty(6)
            mujoco.mj_objectVelocity(
                self._world.model, data, mujoco.mjtObj.mjOBJ_SITE, site.id, velocity, 0
            )
            qvel[:3] = velocity[3:]
            for index, name in enumerate(FINGERS):
                qpos[3 + index] = data.joint(name).qpos[0]
                qvel[3 + index] = data.joint(name).qvel[0]
            for own, its in self._object_joints():
                qpos[own[0]] = data.joint(its).qpos
                qvel[own[1]] = data.joint(its).qvel
            return state

    def achieved_goal(self) -> np.ndarray:
        """Return the (G,) float32 positions of the goal's objects."""
        return self._task.achieved_goal(self.state()[None])[0]

    def success(self, desired_goal: np.ndarray) -> bool:
        """Return whether the paper's Eq. (1) holds now."""
        return bool(is_success(self.achieved_goal(), desired_goal))

    def settled(self) -> bool:
        """Return whether all is at rest and let go of."""
        return bool(self._task.settled(self.state()[None])[0])

    def object_pose(self, name: str) -> np.ndarray:
        """Return the (4, 4) transform of a marked object to the task's frame."""
        with self._lock:
            if name == "table":
                return np.eye(4)
            data = self._current()
            place = data.site(TOOL) if name == "gripper" else data.body(name)
            rotation = place.xmat.reshape(3, 3)
            return cell.transform(rotation, place.xpos)

    def move_block(self, block: int, position: np.ndarray, yaw: float = 0.0) -> None:
        """Put a block at rest at (3,) m in the task's frame, as an external hand would."""
        with self._lock:
            joint = self._world.data.joint(f"block{block}")
            joint.qpos[:3] = position
            joint.qpos[3:] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
            joint.qvel[:] = 0.0
            mujoco.mj_forward(self._world.model, self._world.data)

    def clear_table(self) -> None:
        """Put the blocks out of the way, at the far end of the table."""
        for block in range(self._task.blocks):
            self.move_block(block, np.array([0.62, -0.3 + 0.15 * block, BLOCK_SIZE_M / 2]))

    def _current(self) -> mujoco.MjData:
        """Return the data, its poses brought up to the joints: a step leaves them one behind."""
        model, data = self._world.model, self._world.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        return data

    def _set_objects(self, state: np.ndarray) -> None:
        qpos, data = self._task.qpos(state), self._world.data
        for own, its in self._object_joints():
            data.joint(its).qpos[:] = qpos[own[0]]
            data.joint(its).qvel[:] = 0.0

    def _object_joints(self) -> list[tuple[tuple[slice, slice], str]]:
        """Return where the task's qpos and qvel have each joint of an object, and its name."""
        model = self._task.model
        found = []
        for index in range(5, model.njnt):
            free = model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE
            place, speed = model.jnt_qposadr[index], model.jnt_dofadr[index]
            where = (
                slice(place, place + (7 if free else 1)),
                slice(speed, speed + (6 if free else 1)),
            )
            found.append((where, model.joint(index).name))
        return found
