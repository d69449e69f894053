"""How fast SAC with hindsight goals learns, against Stable-Baselines3 and SBX, in one run.

    python benchmarks/sac.py                  # prints a table of rates and their ratios

One update is sampling with goals relabelled in hindsight, both critics, the actor and the target,
on episodes of Stack's shapes. Ours is plain SAC as in ``--preset paper``: no layer norm, no
cloning. It is timed with its hidden layers in bf16, as it runs where the processor multiplies that
natively, and in fp32. Our settings let oneDNN multiply fp32 instead of MKL, which is half as fast
on an AMD processor. Stable-Baselines3 is timed as it comes and with that setting. On a processor
without AMX the products stay fp32 by it: their error is printed. All take short turns one after the
other, so that whatever else the machine does meets them alike; the rates are over the sums of the
turns. Processor time, with ``--threads 1``, can be compared on a busy machine too. The limit is the
arithmetic of one update at the rate at which oneDNN multiplies matrices of that size, fp32, on the
same threads.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from importlib.util import find_spec
from unittest import mock

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium import spaces
from torch import Tensor

from eisp_data.tasks.base import compute_reward
from eisp_data.tasks.registry import get_task
from pretrain import networks
from pretrain.agent import BANK, Agent
from pretrain.config import AgentConfig, GoalMix, SacConfig
from pretrain.layout import Layout
from pretrain.learner import Learner
from pretrain.replay import Trajectories

TASK = get_task("stack")
EPISODE_STEPS = TASK.paper.episode_steps
ONEDNN, MKL = "bf16", "ieee"
"""Who multiplies fp32, named by the setting that decides it, see ``pretrain.device``."""
S, G, A = TASK.paper.observation_dim, TASK.paper.goal_dim, TASK.paper.action_dim


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    batch_size: int = 1024
    threads: int = 2
    episodes: int = 100
    """In the replay."""
    turns: int = 6
    turn_updates: int = 10


def episode(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations (T + 1, S), achieved goals (T + 1, G) and actions (T + 1, A)."""
    rows = EPISODE_STEPS + 1
    achieved = rng.normal(0, 0.1, (1, G)) + rng.normal(0, 0.005, (rows, G)).cumsum(0)
    arrays = rng.normal(0, 1, (rows, S)), achieved, rng.uniform(-1, 1, (rows, A))
    return tuple(array.astype(np.float32) for array in arrays)  # type: ignore[return-value]


class Ours:
    """The learner of this project.

    Args:
        options: sizes.
        layers: hidden sizes.
        hidden: chooses the type of the hidden layers from what goes into them.
    """

    def __init__(
        self, options: Options, layers: tuple[int, ...], hidden: Callable[[Tensor], torch.dtype]
    ) -> None:
        self._hidden = hidden
        rng = np.random.default_rng(0)
        layout = Layout(S, G, A)
        self._data = Trajectories(layout, 10**9, 4, purposeful=False)
        for _ in range(options.episodes):
            seen, achieved, action = episode(rng)
            self._data.extend(seen, achieved, action, achieved, np.array([0, len(seen)]))
        sac = SacConfig(layers=layers, layer_norm=False, clip_targets=False, cloning=0.0)
        config = AgentConfig("stack", features="plain", generator="hybrid", sac=sac)
        agent = Agent(config, layout, self._data.moments(), torch.zeros(BANK, G))
        torch.set_num_threads(max(1, options.threads // 2))
        self._learner = Learner(agent, 3e-4, 3e-4, options.threads)
        self._mix = GoalMix(waypoint=0.0, future=0.8, displaced=0.0, pursued=0.2, horizon=300)
        self._options, self._rng = options, rng
        self.sampling_s = 0.0

    def update(self, count: int) -> None:
        """Take so many updates."""
        torch.set_num_threads(max(1, self._options.threads // 2))
        torch.backends.mkldnn.matmul.fp32_precision = ONEDNN
        with mock.patch.object(networks, "hidden_dtype", self._hidden):
            for _ in range(count):
                start = time.perf_counter()
                batch = self._data.transitions(self._options.batch_size, self._mix, self._rng)
                self.sampling_s += time.perf_counter() - start
                self._learner.update(batch, 0.0, None)


class StackShapes(gymnasium.Env):
    """An environment of Stack's shapes without physics, for replays that ask it for rewards."""

    def __init__(self) -> None:
        def box(size: int) -> spaces.Box:
            return spaces.Box(-np.inf, np.inf, (size,), np.float32)

        self.observation_space = spaces.Dict(
            {"observation": box(S), "achieved_goal": box(G), "desired_goal": box(G)}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (A,), np.float32)

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _: object) -> np.ndarray:
        """Return Eq. (1)."""
        return compute_reward(achieved, desired)


class Peer:
    """SAC of Stable-Baselines3 or of SBX, with SB3's hindsight replay.

    Args:
        options: sizes.
        layers: hidden sizes.
        package: "stable-baselines3" or "sbx".
        products: MKL, as they come, or ONEDNN; SBX has its own.
    """

    def __init__(
        self, options: Options, layers: tuple[int, ...], package: str, products: str = MKL
    ) -> None:
        from stable_baselines3 import HerReplayBuffer
        from stable_baselines3.common.logger import Logger

        if package == "sbx":
            from sbx import SAC
        else:
            from stable_baselines3 import SAC
        self._options, self._products = options, products
        self._model = SAC(
            "MultiInputPolicy",
            StackShapes(),
            ent_coef=0.01,
            buffer_size=options.episodes * EPISODE_STEPS,
            replay_buffer_class=HerReplayBuffer,
            policy_kwargs={"net_arch": list(layers)},
            **({"device": "cpu"} if package != "sbx" else {}),
        )
        self._model.set_logger(Logger(None, []))
        rng = np.random.default_rng(0)
        for _ in range(options.episodes):
            self._fill(*episode(rng))

    def _fill(self, seen: np.ndarray, achieved: np.ndarray, action: np.ndarray) -> None:
        def dictionary(row: int) -> dict[str, np.ndarray]:
            parts = seen[row], achieved[row], achieved[-1]
            keys = "observation", "achieved_goal", "desired_goal"
            return {key: part[None] for key, part in zip(keys, parts, strict=True)}

        assert self._model.replay_buffer is not None
        for row in range(EPISODE_STEPS):
            done = np.array([row == EPISODE_STEPS - 1])
            self._model.replay_buffer.add(
                dictionary(row), dictionary(row + 1), action[row : row + 1],
                -np.ones(1), done, [{"TimeLimit.truncated": True}],
            )  # fmt: skip

    def update(self, count: int) -> None:
        """Take so many updates."""
        torch.set_num_threads(self._options.threads)
        torch.backends.mkldnn.matmul.fp32_precision = self._products
        self._model.train(count, self._options.batch_size)


def limit(options: Options, layers: tuple[int, ...]) -> tuple[float, float]:
    """Return updates/s if an update were nothing but its products, and their relative error."""
    first, body = layers[0], sum(a * b for a, b in zip(layers, layers[1:], strict=False))
    actor = (S + G) * first + body + layers[-1] * 2 * A
    critic = (S + G + A) * first + body + layers[-1]
    # Forward: the actor twice, the critics thrice. Backward: weights and inputs of both, but for
    # the inputs of first layers; and through the critics to the action.
    forward = 2 * actor + 6 * critic
    backward = 2 * actor - (S + G) * first + 2 * (2 * critic - (S + G + A) * first) + 2 * critic
    torch.set_num_threads(options.threads)
    torch.backends.mkldnn.matmul.fp32_precision = ONEDNN
    left, right = torch.randn(options.batch_size, first), torch.randn(first, first)
    seconds = timed(lambda: [left @ right for _ in range(50)]) / 50
    rate = left.numel() * first / seconds
    exact = left.double() @ right.double()
    error = float((left @ right - exact).norm() / exact.norm())
    return rate / (options.batch_size * (forward + backward)), error


def timed(work: Callable[[], object]) -> float:
    """Return the seconds that the work takes the second time."""
    work()
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def compare(options: Options, layers: tuple[int, ...]) -> None:
    """Print the rates of one network size."""
    ours = Ours(options, layers, networks.hidden_dtype)
    learners: dict[str, Ours | Peer] = {
        "ours": ours,
        "ours, fp32": Ours(options, layers, lambda inputs: inputs.dtype),
    }
    learners["stable-baselines3"] = Peer(options, layers, "stable-baselines3")
    learners["the same, oneDNN"] = Peer(options, layers, "stable-baselines3", ONEDNN)
    if find_spec("sbx"):
        learners["sbx"] = Peer(options, layers, "sbx")
    for learner in learners.values():
        learner.update(options.turn_updates)
    ours.sampling_s = 0.0
    spent, processor = dict.fromkeys(learners, 0.0), dict.fromkeys(learners, 0.0)
    for _ in range(options.turns):
        for name, learner in learners.items():
            start, used = time.perf_counter(), time.process_time()
            learner.update(options.turn_updates)
            spent[name] += time.perf_counter() - start
            processor[name] += time.process_time() - used
    updates = options.turns * options.turn_updates
    bound, error = limit(options, layers)
    print(f"{layers[0]} x {len(layers)}, batch {options.batch_size}, {options.threads} threads")
    for name, seconds in spent.items():
        rate = updates / seconds
        bf16, fp32 = seconds / spent["ours"], seconds / spent["ours, fp32"]
        print(
            f"  {name:18s} {rate:6.1f} updates/s; ours {bf16:4.2f} times as fast, fp32 {fp32:4.2f};"
            f" {1e3 * processor[name] / updates:5.1f} ms of processor time"
        )
    print(
        f"  {'arithmetic limit':18s} {bound:6.1f} updates/s, fp32; error of a product {error:.0e}"
    )
    print(f"  sampling: {ours.sampling_s / spent['ours']:.1%} of our update")


def main() -> None:
    """Run the comparison at both sizes."""
    options = tyro.cli(Options, description=__doc__)
    for layers in ((256, 256), (512, 512, 512, 512)):
        compare(options, layers)


if __name__ == "__main__":
    main()
