"""How fast SAC with hindsight goals learns, against Stable-Baselines3 and SBX, in one run.

    python benchmarks/sac.py                  # prints a table of rates and their ratios
    pip install sbx-rl                        # before it, for SBX, which brings JAX

One update is sampling with goals relabelled in hindsight, both critics, the actor and the target,
on episodes of Stack's shapes. Ours is plain SAC as in ``--preset paper``: no layer norm, no
cloning. It is timed with its hidden layers in bf16, as it runs where the processor multiplies that
natively, and in fp32. Our settings let oneDNN multiply fp32 instead of MKL, which is half as fast
on an AMD processor. Stable-Baselines3 is timed as it comes and with that setting. On a processor
without AMX the products stay fp32 by it: their error is printed. Each runs in a process of its own,
as it would at work, and all take short turns one after the other, so that whatever else the machine
does meets them alike; the rates are over the sums of the turns. Processor time, with ``--threads
1``, can be compared on a busy machine too. The limit is the arithmetic of one update at the rate at
which oneDNN multiplies matrices of that size, in bf16 and in fp32, on as many threads.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from multiprocessing.connection import Connection
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
from pretrain.device import set_up
from pretrain.layout import Layout
from pretrain.learner import Learner, Sample
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
    turns: int = 10
    turn_updates: int = 30


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
        self,
        options: Options,
        layers: tuple[int, ...],
        hidden: Callable[[Tensor], torch.dtype] = networks.hidden_dtype,
    ) -> None:
        networks.hidden_dtype = hidden
        rng = np.random.default_rng(0)
        layout = Layout(S, G, A)
        self._data = Trajectories(layout, 10**9, 4, purposeful=False)
        for _ in range(options.episodes):
            seen, achieved, action = episode(rng)
            self._data.extend(seen, achieved, action, achieved, np.array([0, len(seen)]))
        sac = SacConfig(layers=layers, layer_norm=False, clip_targets=False, cloning=0.0)
        config = AgentConfig("stack", features="plain", generator="hybrid", sac=sac)
        agent = Agent(config, layout, self._data.moments(), torch.zeros(BANK, G))
        set_up("cpu", max(1, options.threads // 2))
        self._learner = Learner(agent, 3e-4, 3e-4, options.threads)
        self._mix = GoalMix(waypoint=0.0, future=0.8, displaced=0.0, pursued=0.2, horizon=None)
        self._batch_size, self._rng = options.batch_size, rng

    def update(self, count: int) -> float:
        """Take so many updates, and return the seconds that sampling took."""
        self._sampling = 0.0
        for _ in self._learner.updates(self._samples(count), 0.0):
            pass
        return self._sampling

    def _samples(self, count: int) -> Iterator[Sample]:
        for _ in range(count):
            start = time.perf_counter()
            batch = self._data.transitions(self._batch_size, self._mix, self._rng)
            self._sampling += time.perf_counter() - start
            yield Sample(batch, None)


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
        torch.set_num_threads(options.threads)
        torch.backends.mkldnn.matmul.fp32_precision = products
        self._batch_size = options.batch_size
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

    def update(self, count: int) -> float:
        """Take so many updates; what sampling takes of them is not known."""
        self._model.train(count, self._batch_size)
        return 0.0


def products(layers: tuple[int, ...]) -> int:
    """Return the multiplications of one update for one transition."""
    first, body = layers[0], sum(a * b for a, b in zip(layers, layers[1:], strict=False))
    actor = (S + G) * first + body + layers[-1] * 2 * A
    critic = (S + G + A) * first + body + layers[-1]
    # Forward: the actor twice, the critics thrice. Backward: weights and inputs of both, but for
    # the inputs of first layers; and through the critics to the action.
    forward = 2 * actor + 6 * critic
    backward = 2 * actor - (S + G) * first + 2 * (2 * critic - (S + G + A) * first) + 2 * critic
    return forward + backward


def limit(options: Options, layers: tuple[int, ...], dtype: torch.dtype) -> tuple[float, float]:
    """Return updates/s if an update were nothing but its products, and their relative error.

    Each thread multiplies matrices of its own, which is faster than all of them together.
    """
    rows, width = options.batch_size, layers[0]
    torch.backends.mkldnn.matmul.fp32_precision = ONEDNN
    left, right = torch.randn(rows, width).to(dtype), torch.randn(width, width).to(dtype)

    def fastest() -> float:
        return min(timed(lambda: [left @ right for _ in range(50)]) for _ in range(20)) / 50

    with ThreadPoolExecutor(options.threads, "core", torch.set_num_threads, (1,)) as pool:
        times = [pool.submit(fastest) for _ in range(options.threads)]
        rate = sum(rows * width * width / each.result() for each in times)
    exact = left.double() @ right.double()
    error = float(((left @ right).double() - exact).norm() / exact.norm())
    return rate / (rows * products(layers)), error


def timed(work: Callable[[], object]) -> float:
    """Return the seconds that the work takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


LEARNERS: dict[str, Callable[[Options, tuple[int, ...]], Ours | Peer]] = {
    "ours": Ours,
    "ours, fp32": lambda options, layers: Ours(options, layers, lambda inputs: inputs.dtype),
    "stable-baselines3": lambda options, layers: Peer(options, layers, "stable-baselines3"),
    "the same, oneDNN": lambda options, layers: Peer(options, layers, "stable-baselines3", ONEDNN),
    "sbx": lambda options, layers: Peer(options, layers, "sbx"),
}


@dataclasses.dataclass
class Spent:
    """Seconds of one learner."""

    wall: float = 0.0
    processor: float = 0.0
    sampling: float = 0.0


def serve(name: str, options: Options, layers: tuple[int, ...], pipe: Connection) -> None:
    """Take as many updates as the pipe asks for, and say what they took, until it asks for none."""
    learner = LEARNERS[name](options, layers)
    while count := pipe.recv():
        start, used = time.perf_counter(), time.process_time()
        sampling = learner.update(count)
        wall, processor = time.perf_counter() - start, time.process_time() - used
        pipe.send(Spent(wall, processor, sampling))


def compare(options: Options, layers: tuple[int, ...]) -> None:
    """Print the rates of one network size."""
    context = multiprocessing.get_context("spawn")
    pipes, processes = {}, []
    for name in LEARNERS:
        if name == "sbx" and not find_spec("sbx"):
            continue
        pipes[name], theirs = context.Pipe()
        arguments = (name, options, layers, theirs)
        processes.append(context.Process(target=serve, args=arguments, daemon=True))
        with mock.patch.dict(os.environ):
            if not name.startswith("ours"):
                os.environ.pop("OMP_WAIT_POLICY")  # ours, from pretrain/__init__.py
            processes[-1].start()
        pipes[name].send(options.turn_updates)
        pipes[name].recv()
    spent = {name: Spent() for name in pipes}
    for _ in range(options.turns):
        for name, pipe in pipes.items():
            pipe.send(options.turn_updates)
            turn, total = pipe.recv(), spent[name]
            total.wall += turn.wall
            total.processor += turn.processor
            total.sampling += turn.sampling
    for pipe, process in zip(pipes.values(), processes, strict=True):
        pipe.send(0)
        process.join()
    updates = options.turns * options.turn_updates
    print(f"{layers[0]} x {len(layers)}, batch {options.batch_size}, {options.threads} threads")
    ours, fp32 = spent["ours"], spent["ours, fp32"]
    for name, total in spent.items():
        rate, processor = updates / total.wall, 1e3 * total.processor / updates
        faster, faster_fp32 = total.wall / ours.wall, total.wall / fp32.wall
        print(
            f"  {name:20s} {rate:6.1f} updates/s; ours {faster:4.2f} times as fast,"
            f" fp32 {faster_fp32:4.2f}; {processor:5.1f} ms of processor time"
        )
    for dtype, name in ((torch.bfloat16, "bf16"), (torch.float32, "fp32")):
        bound, error = limit(options, layers, dtype)
        limited = f"products alone, {name}"
        print(f"  {limited:20s} {bound:6.1f} updates/s; relative error {error:.0e}")
    print(f"  sampling: {ours.sampling / ours.wall:.1%} of our update")


def main() -> None:
    """Run the comparison at both sizes."""
    options = tyro.cli(Options, description=__doc__)
    for layers in ((256, 256), (512, 512, 512, 512)):
        compare(options, layers)


if __name__ == "__main__":
    main()
