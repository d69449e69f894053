"""The physics is honest: deterministic, solid, and held together by friction alone."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from eisp_data.errors import DataError
from eisp_data.policies.registry import SCRIPTS
from eisp_data.policies.script import Noise, ScriptedPolicy
from eisp_data.sim.scene import SUBSTEPS
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS, get_task

FINGERTIP_M = 0.014
"""The fingertips end this far below the gripper's position."""
ASIDE = np.array([[0.30, 0.10, 0.025], [0.40, 0.10, 0.025], [0.22, 0.12, 0.025]])


def worlds_at(state: np.ndarray, threads: int = 1) -> Worlds:
    worlds = Worlds(get_task("stack"), len(state), threads)
    worlds.restore(state, np.zeros((len(state), 9), np.float32))
    return worlds


def push_with_full_force(state: np.ndarray, target: list[float], steps: int) -> np.ndarray:
    """Return the states (steps, P) while the servos are told to go where they cannot."""
    physics = get_task("stack").physics(threads=1)
    path = []
    for _ in range(steps):
        state = physics.step(state, np.tile(target, (1, SUBSTEPS, 1)))
        path.append(state[0])
    return np.array(path)


def deepest_contact(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray) -> float:
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    return float(data.contact.dist.min(initial=0.0))


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, np.ndarray]:
    """An episode of the oracle of Stack: states (T + 1, P) and actions (T, 4)."""
    task = get_task("stack")
    worlds = Worlds(task, 1, threads=1)
    worlds.reset([7])
    policy = ScriptedPolicy(task, SCRIPTS["stack"], Noise(), 1)
    policy.begin(0, worlds.state, worlds.desired_goal[0], 7)
    states, actions = [worlds.state[0]], []
    for _ in range(60):
        actions.append(policy.act(worlds.state)[0])
        worlds.step(actions[-1][None])
        states.append(worlds.state[0])
    return np.array(states), np.array(actions)


@pytest.mark.parametrize("threads", [1, 2])
def test_every_recorded_state_replays_bit_by_bit_in_a_batch_of_another_size(recorded, threads):
    states, actions = recorded
    worlds = worlds_at(states[:-1], threads)
    worlds.step(actions)
    np.testing.assert_array_equal(worlds.state, states[1:])


@pytest.mark.parametrize("name", TASKS)
def test_a_world_does_not_depend_on_the_worlds_and_threads_beside_it(name):
    task = get_task(name)
    together, alone = Worlds(task, 5, threads=2), Worlds(task, 1, threads=1)
    together.reset(range(5))
    alone.reset([3])
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 5, 4)).astype(np.float32)
    for action in actions:
        together.step(action)
        alone.step(action[3:4])
    np.testing.assert_array_equal(together.state[3], alone.state[0])


def test_what_is_not_finite_and_what_breaks_down_is_told_not_gone_on_from(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # for MuJoCo's own log
    task = get_task("stack")
    worlds = Worlds(task, 3, threads=1)
    worlds.reset([0, 1, 2])
    before = worlds.state.copy()
    action = np.zeros((3, 4), np.float32)
    action[1, 2] = np.nan
    with pytest.raises(DataError, match="world 1: its control is not finite"):
        worlds.step(action)
    np.testing.assert_array_equal(worlds.state, before)
    task.qpos(worlds.state)[2, 6] = 1e12
    with pytest.raises(DataError, match="world 2: its physics has broken down"):
        worlds.step(np.zeros((3, 4), np.float32))


def test_a_snapshot_stays_as_it_was_and_can_be_gone_on_from_twice():
    worlds = Worlds(get_task("stack"), 2, threads=1)
    worlds.reset([0, 1])
    kept, ends = worlds.snapshot(), []
    for _ in range(2):
        worlds.step(np.full((2, 4), 0.5, np.float32))
        worlds.reset([9], np.array([0]))
        ends.append(worlds.state)
        worlds.restore_snapshot(kept)
        np.testing.assert_array_equal(worlds.steps, [0, 0])
    np.testing.assert_array_equal(*ends)


def test_a_tower_rests_for_a_hundred_steps_without_drift():
    task = get_task("stack")
    tower = np.array([[0.30, 0.0, z] for z in (0.025, 0.075, 0.125)])
    worlds = worlds_at(task.state_of(np.array([0.36, 0.10, 0.25]), tower)[None])
    for _ in range(100):
        worlds.step(np.array([[0.0, 0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(task.block_positions(worlds.state)[0], tower, atol=5e-4)
    assert task.settled(worlds.state).all()


def test_a_grasp_holds_by_friction_while_carried_and_shaken_and_ends_when_the_fingers_open():
    task = get_task("stack")
    assert task.model.neq == 1, "besides the one that couples the fingers, no equality constraint"
    under = np.vstack([[0.30, 0.0, 0.025], ASIDE[1:]])
    worlds = worlds_at(task.state_of(np.array([0.30, 0.0, 0.03]), under)[None])
    for action in [[0, 0, 0, -1]] * 5 + [[0, 0, 1, -1]] * 6:
        worlds.step(np.array([action], float))

    def offset() -> np.ndarray:
        return task.block_positions(worlds.state)[0, 0] - task.qpos(worlds.state)[0, :3]

    held = offset()
    for direction in np.random.default_rng(0).choice([-0.7, 0.7], (40, 3)):
        # To and fro, for it must not be shaken against the table or the other blocks.
        worlds.step(np.append(direction, -1.0)[None])
        worlds.step(np.append(-direction, -1.0)[None])
    assert np.linalg.norm(offset() - held) < 0.02
    assert not task.hands_off(worlds.state).any()
    for _ in range(20):
        worlds.step(np.array([[0.0, 0.0, 0.0, 1.0]]))
    assert task.block_positions(worlds.state)[0, 0, 2] == pytest.approx(0.025, abs=1e-3)


def test_a_block_that_slides_stays_on_the_table_and_stops_by_coulombs_law():
    task = get_task("stack")
    blocks = np.array([[0.20, 0.0, 0.025], *ASIDE[:2]])
    state = task.state_of(np.array([0.30, -0.10, 0.25]), blocks)[None]
    task.qvel(state)[0, 5] = 1.0
    worlds = worlds_at(state)
    for _ in range(25):
        worlds.step(np.array([[0.0, 0.0, 0.0, 1.0]]))
        assert task.block_positions(worlds.state)[0, 0, 2] < 0.027
    way = task.block_positions(worlds.state)[0, 0, 0] - 0.20
    assert way == pytest.approx(1.0 / (2 * 0.7 * 9.81), rel=0.05)


def test_no_action_takes_the_fingers_to_the_table():
    task = get_task("stack")
    worlds = worlds_at(task.state_of(np.array([0.30, -0.05, 0.10]), ASIDE)[None])
    for _ in range(100):
        worlds.step(np.array([[0.0, 0.0, -1.0, 1.0]]))
        assert task.qpos(worlds.state)[0, 2] - FINGERTIP_M > 0.004


def test_the_servos_full_force_does_not_press_the_fingers_into_the_table():
    start = get_task("stack").state_of(np.array([0.30, -0.05, 0.03]), ASIDE)[None]
    path = push_with_full_force(start, [0.30, -0.05, -0.5, 0.0, 0.0], 100)
    height = get_task("stack").qpos(path)[:, 2] - FINGERTIP_M
    assert height[-1] < 0.001, "it does reach the table"
    assert height.min() > -0.001


def test_the_servos_full_force_does_not_press_the_fingers_into_a_block():
    task = get_task("stack")
    start = task.state_of(ASIDE[0] + [0.0, 0.0, 0.025 + FINGERTIP_M + 0.001], ASIDE)[None]
    task.qpos(start)[0, 3:5] = 0.0
    path = push_with_full_force(start, [*ASIDE[0, :2], -0.5, 0.0, 0.0], 100)
    height = task.qpos(path)[:, 2] - FINGERTIP_M
    above = height - (task.block_positions(path)[:, 0, 2] + 0.025)
    assert above[-1] < 0.001, "it does reach the block"
    assert above.min() > -0.001


@pytest.mark.parametrize("name", TASKS)
def test_nothing_tunnels_under_the_roughest_actions(name):
    task = get_task(name)
    worlds = Worlds(task, 8, threads=2)
    worlds.reset(range(8))
    data, rng = mujoco.MjData(task.model), np.random.default_rng(0)
    for step in range(120):
        if step % 6 == 0:
            action = np.clip(rng.uniform(-1.5, 1.5, (8, 4)), -1, 1)
        # Half of the worlds ram one block after the other.
        block = task.block_positions(worlds.state)[:, step // 30 % task.blocks]
        towards = np.clip((block - task.qpos(worlds.state)[:, :3]) / 0.04, -1, 1)
        action[::2, :3] = towards[::2]
        worlds.step(action)
        blocks = task.block_positions(worlds.state)
        over_table = (np.abs(blocks[..., :2] - [0.35, 0.0]) < [0.30, 0.36]).all(axis=-1)
        assert (blocks[over_table][:, 2] > 0.02).all()
        assert min(deepest_contact(task.model, data, s) for s in worlds.state) > -0.010


def test_a_thrown_block_does_not_pass_through_the_block_before_it():
    task = get_task("stack")
    blocks = np.array([[0.20, 0.0, 0.025], [0.30, 0.0, 0.025], [0.36, 0.0, 0.025]])
    state = task.state_of(np.array([0.30, 0.15, 0.25]), blocks)[None]
    task.qvel(state)[0, 5] = 3.0  # the first block's velocity along x, m/s
    worlds = worlds_at(state)
    for _ in range(25):
        worlds.step(np.array([[0.0, 0.0, 0.0, 1.0]]))
        x = task.block_positions(worlds.state)[0, :, 0]
        assert (np.diff(x) > 0.025).all()
    assert x[1] > 0.301, "it was hit"
