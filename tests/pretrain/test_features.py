"""What the networks see: the same where nothing that matters differs."""

import math

import pytest
import torch
from learning_samples import scene

from eisp_data.tasks.registry import TASKS
from pretrain.agent import empty_moments
from pretrain.features import ObjectFeatures, PlainFeatures, object_tokens
from pretrain.layout import Layout

LAYOUTS = {name: Layout.of(task) for name, task in TASKS.items()}
OF_A_KIND = [name for name, layout in LAYOUTS.items() if layout.kinds == 1]
MIXED = [name for name, layout in LAYOUTS.items() if layout.kinds > 1]
TOKEN = 20


def renamed(layout: Layout, order: list[int], observation, goal):
    """Return the scene with object ``order[i]`` called object i."""
    seen, wanted = observation.clone(), goal.clone()
    for place, source in zip(layout.objects, (layout.objects[i] for i in order), strict=True):
        seen[:, place.observation : place.observation + 15] = observation[
            :, source.observation : source.observation + 15
        ]
        wanted[:, place.goal : place.goal + 3] = goal[:, source.goal : source.goal + 3]
    return seen, wanted


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_layout_covers_the_goal_and_leaves_the_robot_its_part(name):
    layout = LAYOUTS[name]
    assert sorted(item.goal for item in layout.objects) == list(range(0, layout.goal_dim, 3))
    assert min(item.observation for item in layout.objects) == layout.robot_dim
    assert max(item.observation for item in layout.objects) + 15 <= layout.observation_dim


@pytest.mark.parametrize("name", OF_A_KIND)
def test_objects_of_a_kind_may_change_names(name):
    layout = LAYOUTS[name]
    observation, goal = scene(name, 64)
    features = ObjectFeatures(layout, empty_moments(layout))
    expected = features(observation, goal)
    assert expected.shape == (64, features.size)
    for shift in range(1, len(layout.objects)):
        order = [(i + shift) % len(layout.objects) for i in range(len(layout.objects))]
        torch.testing.assert_close(features(*renamed(layout, order, observation, goal)), expected)


@pytest.mark.parametrize("name", MIXED)
def test_objects_of_different_kinds_keep_their_places(name):
    layout = LAYOUTS[name]
    observation, goal = scene(name, 64)
    features = ObjectFeatures(layout, empty_moments(layout))(observation, goal)
    count = len(layout.objects)
    tokens = features[:, layout.robot_dim : layout.robot_dim + TOKEN * count]
    torch.testing.assert_close(tokens, object_tokens(layout, observation, goal).flatten(1))
    way = object_tokens(layout, observation, goal)[..., 6:9].norm(dim=-1)
    assert (features[:, -count:].argmax(1) == way.argmax(1)).all()
    assert (features[:, -count:].sum(1) == 1).all()


@pytest.mark.parametrize("name", OF_A_KIND)
def test_the_object_with_the_longest_way_comes_first_and_then_its_neighbours(name):
    layout = LAYOUTS[name]
    observation, goal = scene(name, 64)
    tokens = object_tokens(layout, observation, goal)
    features = ObjectFeatures(layout, empty_moments(layout))(observation, goal)
    count = len(layout.objects)
    seen = features[:, layout.robot_dim : layout.robot_dim + TOKEN * count].view(64, count, TOKEN)
    longest = tokens[..., 6:9].norm(dim=-1).argmax(1)
    torch.testing.assert_close(seen[:, 0], tokens[torch.arange(64), longest])
    apart = (seen[..., :3] - seen[:, :1, :3]).norm(dim=-1)
    assert (apart.diff(dim=1) >= 0).all()


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_cube_looks_the_same_after_a_quarter_turn_but_not_after_half_of_one(name):
    layout = LAYOUTS[name]
    observation, goal = scene(name, 16)
    features = ObjectFeatures(layout, empty_moments(layout))
    expected = features(observation, goal)
    for item in layout.objects:
        turned = observation.clone()
        turned[:, item.observation + 8] += math.pi / 2
        torch.testing.assert_close(features(turned, goal), expected, atol=1e-4, rtol=0)
        turned[:, item.observation + 8] += math.pi / 4
        assert (features(turned, goal) - expected).abs().amax() > 0.5


@pytest.mark.parametrize("name", LAYOUTS)
def test_features_stay_small_whatever_is_seen(name):
    layout = LAYOUTS[name]
    observation, goal = scene(name, 16)
    far = ObjectFeatures(layout, empty_moments(layout))(observation, goal + 1e4)
    assert far.isfinite().all()
    tokens = far[:, layout.robot_dim : layout.robot_dim + TOKEN * len(layout.objects)]
    assert tokens.abs().amax() <= 10


def test_plain_features_are_standardised():
    layout = Layout(3, 2, 1)
    moments = empty_moments(layout)
    moments["observation_mean"] = torch.tensor([1.0, 2.0, 3.0])
    moments["observation_std"] = torch.tensor([1.0, 2.0, 4.0])
    moments["goal_mean"] = torch.tensor([-1.0, 0.0])
    moments["goal_std"] = torch.tensor([0.5, 0.1])
    features = PlainFeatures(layout, moments)
    found = features(torch.tensor([[2.0, 6.0, 3.0]]), torch.tensor([[0.0, 9.0]]))
    torch.testing.assert_close(found, torch.tensor([[1.0, 2.0, 0.0, 2.0, 10.0]]))
    assert features.size == 5


@pytest.mark.parametrize("name", MIXED)
def test_an_image_adds_its_latent_and_of_a_goal_only_the_places_count(name):
    plain, layout = LAYOUTS[name], LAYOUTS[name].seen(108)
    moments = empty_moments(layout)
    moments["observation_mean"] += 1.0
    observation, goal = scene(name, 16)
    latent = torch.rand(16, 108)
    end = layout.observation_dim - 108
    seen = torch.cat([observation[:, :end], latent], 1)
    features = ObjectFeatures(layout, moments)
    found = features(seen, torch.cat([goal, torch.rand(16, 108)], 1))
    assert found.shape == (16, features.size)
    expected = ObjectFeatures(plain, empty_moments(plain))(observation, goal)
    assert torch.equal(found[:, :-108], expected)
    assert torch.equal(found[:, -108:], latent - 1.0)
