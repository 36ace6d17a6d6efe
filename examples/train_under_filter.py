"""PPO from TorchRL's own pieces learns a task with the safety filter in the loop and without.

    python examples/train_under_filter.py                     # hold the pendulum at 46 degrees
    python examples/train_under_filter.py env=car             # drive to a goal behind the obstacle
    python examples/train_under_filter.py seeds=0 batches=4   # a first look
    python examples/train_under_filter.py episodes=1000       # then run what the first seed learnt, 1,000 episodes each

Three seeds each take about ten minutes on one core, the last of these a few more. The learner sees the true state and knows nothing of
the agent; the filter sees pictures alone. An episode ends where it enters U, so that the learner without a filter is told what to avoid.
It prints tables, and writes `under_filter.png` and `under_filter.json` (for the car `under_filter_car.png` and `.json`) into `out_dir`
(default: runs/under_filter).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, ExcludeTransform, InitTracker, RewardSum, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

import torchrl_sspl as sspl
from torchrl_sspl.envs.dubins import YAW_LAG

STEPS, EPOCHS, MINIBATCH, RATE = 2000, 16, 200, 1e-3  # steps of a batch, in all systems


class Task(Transform):
    """Reward and end of an episode; below, what the two systems differ in."""

    agent: ClassVar[str]
    envs: ClassVar[int]  # side by side
    longest: ClassVar[int]  # episode, in steps
    most: ClassVar[str]  # of the return
    level: ClassVar[float]  # of the filter

    def env(self, seed: int) -> sspl.envs.SafetyEnv:
        """Systems side by side, which start where the agent's set is."""
        raise NotImplementedError

    def features(self, state: Tensor) -> Tensor:
        """What the learner sees of a state."""
        raise NotImplementedError

    def at_goal(self, state: Tensor) -> Tensor:
        """Whether it is there, ``(*batch, 1)``."""
        raise NotImplementedError

    def reward(self, before: Tensor, now: Tensor, lost: Tensor) -> Tensor:
        """For one step; lost: it entered U or left X."""
        raise NotImplementedError

    def over(self, state: Tensor) -> Tensor:
        """Whether all is done."""
        return torch.zeros_like(state[..., :1], dtype=torch.bool)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, now = tensordict["state"], next_tensordict["state"]
        lost = next_tensordict["terminated"] | (next_tensordict["region"] == sspl.sets.UNSAFE)
        next_tensordict["reward"] = self.reward(before, now, lost)
        next_tensordict["terminated"] = lost | self.over(now)
        next_tensordict["done"] = next_tensordict["terminated"] | next_tensordict["truncated"]
        return next_tensordict


class HoldAngle(Task):
    """46 degrees, which is away from where the agent would go; U are angles beyond 90 degrees and speeds beyond 1.5 rad/s."""

    agent, envs, longest, most, goal = "pendulum", 20, 100, "at most 100", 0.8
    level = -0.08  # at rest B is -.11 there

    def env(self, seed: int) -> sspl.envs.SafetyEnv:
        env = sspl.envs.PixelPendulumEnv(batch_size=[self.envs], seed=seed)
        env.initial_set = env.safe_set
        return env

    def features(self, state: Tensor) -> Tensor:
        angle, speed = state.split(1, dim=-1)
        return torch.cat([angle.sin(), angle.cos(), speed], -1)

    def at_goal(self, state: Tensor) -> Tensor:
        return (state[..., :1] - self.goal).abs() < 0.1

    def reward(self, before: Tensor, now: Tensor, lost: Tensor) -> Tensor:
        angle, speed = now.split(1, dim=-1)
        return torch.exp(-((angle - self.goal) ** 2) / 0.3 - 0.1 * speed**2)


class ReachGoal(Task):
    """From the left of the obstacle to its right, on a car that turns as late as the walking robot does."""

    agent, envs, longest, most, goal, near = "quadruped", 40, 70, "about 5 at best", (1.5, 0.0), 0.4
    level = -0.12

    def env(self, seed: int) -> sspl.envs.SafetyEnv:
        start = sspl.sets.Box([-1.9, -0.7, -0.5, -2.0], [-1.6, 0.7, 0.5, 2.0])
        return sspl.envs.DubinsEnv(batch_size=[self.envs], yaw_lag=YAW_LAG, initial_set=start, seed=seed)

    def features(self, state: Tensor) -> Tensor:
        x, y, heading, turning = state.split(1, dim=-1)
        return torch.cat([x, y, heading.cos(), heading.sin(), turning], -1)

    def distance(self, state: Tensor) -> Tensor:
        """To the goal in m."""
        return (state[..., :2] - torch.tensor(self.goal)).norm(dim=-1, keepdim=True)

    def at_goal(self, state: Tensor) -> Tensor:
        return self.distance(state) < self.near

    over = at_goal

    def reward(self, before: Tensor, now: Tensor, lost: Tensor) -> Tensor:
        # Metres nearer; to leave the arena costs as much as to enter U, so that it is never the way out.
        return self.distance(before) - self.distance(now) + 2.0 * self.at_goal(now) - 2.0 * lost


TASKS = {"pendulum": HoldAngle, "car": ReachGoal}
WITH = {True: "with the filter", False: "without"}
Rows = list[dict[str, float]]


def network(outputs: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.LazyLinear(64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs), *last)


def collect(task: Task, learner: TensorDictModuleBase, seed: int, *, filtered: bool, steps: int, **options: Any) -> Collector:
    """Episodes under a learner: PPO learns from what it wanted; what is done is what the filter makes of it."""
    env = task.env(seed)
    if filtered:
        protect = sspl.SafetyFilter(sspl.load(task.agent), level=task.level)
        looks, last = protect.make_tensordict_primer(), [protect]  # the filter has a memory
    else:  # nobody looks, nothing is drawn
        env.draw = lambda state: torch.zeros(len(state), 3, env.image_size, env.image_size, dtype=torch.uint8)
        looks, last = ExcludeTransform("pixels"), []
    env = TransformedEnv(env, Compose(InitTracker(), task, looks, StepCounter(task.longest), RewardSum()))
    act = TensorDictModule(lambda wanted: wanted.clone(), ["wanted"], ["action"])
    return Collector(env, TensorDictSequential(learner, act, *last), frames_per_batch=STEPS, total_frames=steps, **options)


def told(task: Task, last: TensorDictBase) -> dict[str, float]:
    """Of the last steps of episodes: how many there are, their return in all, how many entered U, how many are at the goal."""
    return {
        "episodes": len(last),
        "return": float(last["episode_reward"].sum()),
        "entered": int((last["region"] == sspl.sets.UNSAFE).sum()),
        "arrived": int(task.at_goal(last["state"]).sum()),
    }


def train(task: Task, seed: int, *, filtered: bool, batches: int) -> tuple[Rows, TensorDictModuleBase]:
    """What was told of every batch, and the learner."""
    torch.manual_seed(seed)
    see = TensorDictModule(task.features, ["state"], ["features"])
    limit = sspl.load(task.agent).policy.action_scale.item()
    actor = ProbabilisticActor(
        TensorDictModule(network(2, NormalParamExtractor()), ["features"], ["loc", "scale"]),
        in_keys=["loc", "scale"], out_keys=["wanted"], distribution_class=TanhNormal, return_log_prob=True,
        distribution_kwargs={"low": -limit, "high": limit},
    )  # fmt: skip
    learner, critic = TensorDictSequential(see, actor), ValueOperator(network(1), ["features"])
    critic(learner(task.env(seed).reset()))  # so that the first layers know their sizes
    loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3)
    loss.set_keys(action="wanted", sample_log_prob="wanted_log_prob")
    advantage = GAE(gamma=0.98, lmbda=0.95, value_network=TensorDictSequential(see, critic))
    optimiser = torch.optim.Adam(loss.parameters(), RATE)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(STEPS), sampler=SamplerWithoutReplacement(), batch_size=MINIBATCH)
    collector = collect(task, learner, seed, filtered=filtered, steps=STEPS * batches)
    history = []
    for data in tqdm(collector, total=batches, desc=f"seed {seed}, {WITH[filtered]}", leave=False):
        history.append(told(task, data["next"][data["next", "done"][..., 0]]))
        kept = data.select(
            "state", "features", "wanted", "wanted_log_prob", "loc", "scale",
            ("next", "state"), ("next", "reward"), ("next", "done"), ("next", "terminated"),
        )  # fmt: skip
        for _ in range(EPOCHS):
            advantage(kept)
            buffer.extend(kept.reshape(-1))
            for _ in range(STEPS // MINIBATCH):
                found = loss(buffer.sample())
                optimiser.zero_grad()
                sum(v for k, v in found.items() if k.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
    collector.shutdown()
    return history, learner


def run(task: Task, learner: TensorDictModuleBase, seed: int, *, filtered: bool, episodes: int) -> dict[str, float]:
    """What is told of fresh episodes under what was learnt, without exploration; of every system as many."""
    each, ended, found = -(-episodes // task.envs), torch.zeros(task.envs, 1), []
    collector = collect(task, learner, seed + 1000, filtered=filtered, steps=-1, exploration_type=ExplorationType.DETERMINISTIC)
    for data in collector:
        done = data["next", "done"][..., 0]
        number = ended + done.cumsum(1)
        found.append(data["next"].select("episode_reward", "region", "state")[done & (number <= each)])
        ended = number[:, -1:]
        if ended.min() >= each:
            break
    collector.shutdown()
    return told(task, torch.cat(found))


def figure(task: Task, runs: dict[str, list[Rows]], path: Path) -> None:
    """Return, share at the goal and entries into U while learning, every seed a line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    for colour, (name, histories) in zip(("tab:blue", "tab:red"), runs.items(), strict=True):
        for k, history in enumerate(histories):
            column = {key: torch.tensor([float(row[key]) for row in history]) for key in history[0]}
            n = column["episodes"]  # where none ended, the line has a gap
            for axis, values in zip(axes, (column["return"] / n, 100 * column["arrived"] / n, column["entered"].cumsum(0)), strict=True):
                axis.plot(range(1, len(n) + 1), values, color=colour, label=name if k == 0 else None)
    labels = (f"return ({task.most})", "episodes that end at the goal [%]", "episodes that entered U, in all")
    for axis, text in zip(axes, labels, strict=True):
        axis.set(xlabel=f"batch of {STEPS:,} steps", ylabel=text)
    axes[0].legend()
    fig.savefig(path, dpi=90)


def shares(rows: Rows) -> str:
    """Cells of a table: mean return, share at the goal, entries into U."""
    total = {key: sum(row[key] for row in rows) for key in rows[0]}
    n = max(1, int(total["episodes"]))
    return f"{total['return'] / n:.2f} | {100 * total['arrived'] / n:.1f} % | {total['entered']:,} of {n:,}"


def main(
    seeds: tuple[int, ...] = (0, 1, 2), batches: int = 30, env: str = "pendulum", episodes: int = 0, out_dir: str = "runs/under_filter"
) -> None:
    """Train, print and draw."""
    made = {filtered: [train(TASKS[env](), s, filtered=filtered, batches=batches) for s in seeds] for filtered in (True, False)}
    runs = {WITH[filtered]: [history for history, _ in seen] for filtered, seen in made.items()}
    folder, name, last = Path(out_dir), "under_filter" + ("_car" if env == "car" else ""), max(1, batches // 6)
    folder.mkdir(parents=True, exist_ok=True)
    figure(TASKS[env](), runs, folder / f"{name}.png")
    print(f"| PPO | seed | return of the last {last} batches | at the goal | into U | into U while learning |\n|---|---|---|---|---|---|")
    for label, histories in runs.items():
        for seed, history in zip(seeds, histories, strict=True):
            print(f"| {label} | {seed} | {shares(history[-last:])} | {shares(history).rsplit(' | ')[-1]} |", flush=True)
    after = {}
    if episodes:
        print(f"\n| Learnt, seed {seeds[0]} | run | return | at the goal | into U |\n|---|---|---|---|---|")
    for learnt, ((_, learner), *_) in made.items() if episodes else ():
        for filtered in (True, False):
            row = run(TASKS[env](), learner, seeds[0], filtered=filtered, episodes=episodes)
            after[f"learnt {WITH[learnt]}, run {WITH[filtered]}"] = row
            print(f"| {WITH[learnt]} | {WITH[filtered]} | {shares([row])} |", flush=True)
    (folder / f"{name}.json").write_text(json.dumps({"learning": runs, "afterwards": after}, indent=1))


if __name__ == "__main__":
    given = dict(argument.split("=", 1) for argument in sys.argv[1:])
    read = {"seeds": lambda text: tuple(int(s) for s in text.split(",")), "batches": int, "episodes": int}
    main(**{key: read.get(key, str)(value) for key, value in given.items()})
