"""The rollout with subgoals: when they are renewed, and what they give way to."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from learning_samples import linear_agent

from finetune.rollout import SubgoalPolicy
from pretrain.config import SubgoalConfig
from pretrain.proposers.proposer import SubgoalProposer

SETTINGS = SubgoalConfig(candidates=1, every_steps=5, reached_m=0.02, final_m=0.05)
FAR = np.full((2, 2), 5.0, np.float32)


class Counting(SubgoalProposer):
    """Proposes (1, 0), then (2, 0) and so on, whatever it is asked."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = 0

    def propose(self, observation, goal, count):
        self.asked += 1
        candidates = torch.tensor([float(self.asked), 0.0]).expand(len(goal), count, 2)
        return candidates.clone(), torch.zeros(len(goal), count)

    def loss(self, observation, goal, subgoal):
        raise NotImplementedError


def counting_policy(worlds: int = 2, **changes: object) -> SubgoalPolicy:
    agent = linear_agent(subgoals=replace(SETTINGS, **changes))  # type: ignore[arg-type]
    agent.proposer = Counting()
    return SubgoalPolicy(agent, worlds)


def step(policy: SubgoalPolicy, achieved=None, desired=FAR, noise: float = 0.0) -> np.ndarray:
    achieved = np.zeros((2, 2), np.float32) if achieved is None else achieved
    return policy.act(achieved, achieved, desired, noise)


def towards(policy: SubgoalPolicy, achieved: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the low-level policy's actions where all is as achieved."""
    return policy._agent.sac.act(torch.from_numpy(achieved), torch.from_numpy(goal)).numpy()


def test_a_subgoal_lasts_for_t_steps():
    policy = counting_policy()
    seen = []
    for _ in range(12):
        step(policy)
        seen.append(policy.subgoal[0, 0])
    assert seen == [1] * 5 + [2] * 5 + [3] * 2


def test_a_subgoal_that_is_reached_gives_way_at_once_and_only_in_its_world():
    policy = counting_policy()
    for _ in range(3):
        step(policy)
    there = np.array([[1.015, 0.0], [0.97, 0.0]], np.float32)
    step(policy, there)
    assert policy.subgoal[:, 0].tolist() == [2, 1]
    for _ in range(2):
        step(policy)
    assert policy.subgoal[:, 0].tolist() == [2, 3]


def test_a_reset_renews_the_subgoals_of_the_worlds_it_names():
    policy = counting_policy()
    step(policy)
    policy.reset(np.array([1]))
    step(policy)
    assert policy.subgoal[:, 0].tolist() == [1, 2]


def test_a_subgoal_near_the_final_goal_gives_way_to_it():
    policy = counting_policy()
    desired = np.array([[1.04, 0.0], [1.06, 0.0]], np.float32)
    step(policy, desired=desired)
    np.testing.assert_array_equal(policy.subgoal[0], desired[0])
    np.testing.assert_array_equal(policy.subgoal[1], [1.0, 0.0])


def test_where_the_final_goal_is_met_nothing_else_is_proposed():
    policy = counting_policy()
    here = np.array([[0.04, 0.0], [0.06, 0.0]], np.float32)
    goal = np.zeros((2, 2), np.float32)
    step(policy, here, goal)
    assert policy.subgoal[:, 0].tolist() == [0.0, 1.0]


def test_without_subgoals_the_final_goal_is_followed_alone():
    policy = counting_policy(source="none")
    desired = np.array([[3.0, 1.0], [4.0, 2.0]], np.float32)
    for _ in range(7):
        step(policy, desired=desired)
        np.testing.assert_array_equal(policy.subgoal, desired)
    assert policy._agent.proposer.asked == 0


def test_random_subgoals_are_goals_that_the_dataset_achieved():
    policy = counting_policy(worlds=50, source="random", candidates=4)
    nowhere, far = np.zeros((50, 2), np.float32), np.full((50, 2), 9.0, np.float32)
    policy.act(nowhere, nowhere, far)
    bank = policy._agent.bank.numpy()
    assert (policy.subgoal[:, None] == bank).all(-1).any(1).all()
    assert len(np.unique(policy.subgoal, axis=0)) > 40
    assert policy._agent.proposer.asked == 0


def test_the_candidates_asked_for_are_k():
    policy = counting_policy(candidates=7)
    seen = []
    propose = policy._agent.proposer.propose
    policy._agent.proposer.propose = lambda *args: seen.append(args[2]) or propose(*args)
    step(policy)
    assert seen == [7]


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_actions_are_float32_within_bounds_and_head_for_the_subgoal(noise):
    policy = counting_policy()
    # The linear actor's mean is the subgoal's x.
    policy._agent.sac.actor.body[-1].weight.data[0, 2] = 1.0
    policy._agent.sac.actor.body[-1].bias.data[1] = -5.0
    action = step(policy, noise=noise)
    assert action.shape == (2, 1) and action.dtype == np.float32
    np.testing.assert_allclose(action, np.tanh(1.0), atol=0.05 if noise else 1e-6)
    assert (np.abs(action) <= 1).all()


def test_a_policy_at_a_standstill_samples_its_actions_until_something_moves():
    policy = counting_policy()
    still, moving = np.zeros(2, np.float32), np.array([0.5, 0.0], np.float32)
    means = [step(policy) for _ in range(5)]
    assert all((action == means[0]).all() for action in means)
    # World 1 has come half a metre nearer when its subgoal is renewed, world 0 has not.
    sampled = np.stack([step(policy, np.stack([still, moving])) for _ in range(5)])
    assert (sampled[:, 1] == means[0][1]).all() and sampled[:, 0].std() > 0.01
    moved = np.stack([step(policy, np.stack([moving, moving + 1.0])) for _ in range(3)])
    assert (moved == moved[0]).all()


class Insisting(Counting):
    """Proposes (1, 0), and with far less weight (3, 0)."""

    def propose(self, observation, goal, count):
        candidates = torch.tensor([[1.0, 0.0], [3.0, 0.0]]).expand(len(goal), 2, 2)
        return candidates.clone(), torch.tensor([0.0, -5.0]).expand(len(goal), 2)


def test_a_subgoal_that_fails_twice_is_left_until_one_is_reached():
    policy = counting_policy(selector="likely")
    policy._agent.proposer = Insisting()
    there = np.array([[3.0, 0.0], [0.0, 0.0]], np.float32)
    seen = []
    for at in (None, None, None, there, there):
        for _ in range(5):
            step(policy, at)
        seen.append(policy.subgoal[:, 0].tolist())
    # World 0 is at (3, 0) from the fourth on, and may try (1, 0) anew.
    assert seen == [[1, 1], [1, 1], [3, 3], [1, 3], [1, 1]]


def test_where_the_final_goal_is_met_nobody_is_stuck_however_still():
    policy = counting_policy()
    # Within final_m of the goal, and not within reached_m of the subgoal.
    near = np.array([[0.04, 0.0], [0.06, 0.0]], np.float32)
    actions = np.stack([step(policy, near, np.zeros((2, 2), np.float32)) for _ in range(10)])
    assert (actions[:, 0] == actions[0, 0]).all()
    assert actions[5:, 1].std() > 0.01


def test_where_the_final_goal_stays_met_it_is_kept_as_it_is_and_then_nothing_is_done():
    policy = counting_policy()
    actor = policy._agent.sac.actor.body[-1]
    actor.bias.data[:] = 1.0
    actor.weight.data[:] = 3.0
    goal = np.zeros((2, 2), np.float32)
    places = np.array([[0.02, 0.0], [0.07, 0.0]], np.float32)
    actions = np.stack([step(policy, places, goal) for _ in range(40)])
    assert (actions[:30, 0] != 0).all() and (actions[30:, 0] == 0).all()
    assert (actions[:, 1] != 0).all()
    assert not policy.subgoal[0].any(), "the goal stays what it is heading for"
    assert (actions[15, 0] == towards(policy, places, places)[0]).all()
    # It begins anew as soon as the goal is no longer met.
    step(policy, places + 0.04, goal)
    assert policy.met.tolist() == [0, 0] and policy.subgoal[0, 0] >= 1.0


def test_a_goal_that_is_met_only_just_is_still_corrected():
    policy = counting_policy()
    policy._agent.sac.actor.body[-1].weight.data[:] = 1.0
    goal = np.zeros((2, 2), np.float32)
    places = np.array([[0.04, 0.0], [0.02, 0.0]], np.float32)
    for _ in range(20):
        action = step(policy, places, goal)
    to_goal, to_stay = towards(policy, places, goal), towards(policy, places, places)
    assert (to_goal != to_stay).any(1).all()
    assert (action[0] == to_goal[0]).all() and (action[1] == to_stay[1]).all()


def test_a_policy_that_finds_all_as_it_should_be_for_long_is_idle():
    policy = counting_policy()
    for _ in range(8):
        step(policy, np.array([[1.0, 0.0], [-3.0, 0.0]], np.float32))
        policy._agent.proposer.asked = 0
    # World 0 is where it is to go, at every step anew; world 1 never.
    assert policy.idle.tolist() == [8, 3]


def test_a_policy_may_be_told_to_go_on_when_the_goal_is_met():
    policy = counting_policy(rest_when_met=False)
    policy._agent.sac.actor.body[-1].bias.data[:] = 1.0
    nowhere = np.zeros((2, 2), np.float32)
    assert all((step(policy, nowhere, nowhere) != 0).all() for _ in range(40))


def test_after_a_reset_nobody_is_stuck():
    policy = counting_policy()
    for _ in range(10):
        step(policy)
    policy.reset(np.arange(2))
    first = step(policy)
    assert (first == step(policy)).all()


def test_a_policy_may_be_told_to_stay_without_noise():
    policy = counting_policy(sample_when_stuck=False)
    actions = [step(policy) for _ in range(12)]
    assert all((action == actions[0]).all() for action in actions)
