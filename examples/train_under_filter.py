"""PPO from TorchRL's own pieces learns to hold the pendulum at an angle, with the safety filter in the loop and without.

    python examples/train_under_filter.py                     # three seeds each, about a quarter of an hour on one core
    python examples/train_under_filter.py seeds=0 batches=4   # a first look

The learner sees the true state and knows nothing of the agent; the filter sees pictures alone. U are angles beyond 90 degrees and speeds
beyond 1.5 rad/s, the goal is to hold 46 degrees. It prints a table, and writes `under_filter.png` and `under_filter.json` into
`out_dir` (default: runs/under_filter).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

import torchrl_sspl as sspl

GOAL, TORQUE, ENVS, STEPS = 0.8, 10.0, 32, 100


class HoldAngle(sspl.envs.PendulumEnv):
    """Reward in (0, 1]: near the goal, and still."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        angle, speed = out["state"].split(1, dim=-1)
        return out.set("reward", torch.exp(-((angle - GOAL) ** 2) / 0.3 - 0.1 * speed**2))


def features(state: Tensor) -> Tensor:
    """What the learner sees of an angle and a speed."""
    angle, speed = state.split(1, dim=-1)
    return torch.cat([angle.sin(), angle.cos(), speed], -1)


def network(outputs: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs), *last)


def train(seed: int, *, filtered: bool, batches: int) -> list[dict[str, float]]:
    """What every batch of episodes showed: return, and the share that entered U."""
    torch.manual_seed(seed)
    protect = sspl.SafetyFilter(sspl.load("pendulum"))
    env = HoldAngle(batch_size=[ENVS], horizon=STEPS, seed=seed)
    env.initial_set = env.safe_set
    memory = [protect.make_tensordict_primer()] if filtered else []
    env = TransformedEnv(env, Compose(InitTracker(), *memory, StepCounter(), RewardSum()))

    see = TensorDictModule(features, ["state"], ["features"])
    actor = ProbabilisticActor(
        TensorDictModule(network(2, NormalParamExtractor()), ["features"], ["loc", "scale"]),
        in_keys=["loc", "scale"], out_keys=["wanted"], distribution_class=TanhNormal, return_log_prob=True,
        distribution_kwargs={"low": -TORQUE, "high": TORQUE},
    )  # fmt: skip
    learner = TensorDictSequential(see, actor)
    critic = ValueOperator(nn.Sequential(network(1)), ["features"])
    # PPO learns from what it wanted; what is done is what the filter makes of it.
    act = TensorDictModule(lambda wanted: wanted.clone(), ["wanted"], ["action"])
    policy = TensorDictSequential(learner, act, *([protect] if filtered else []))

    loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3)
    loss.set_keys(action="wanted", sample_log_prob="wanted_log_prob")
    advantage = GAE(gamma=0.98, lmbda=0.95, value_network=TensorDictSequential(see, critic))
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3)
    size = ENVS * STEPS
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(size), sampler=SamplerWithoutReplacement(), batch_size=400)
    collector = Collector(env, policy, frames_per_batch=size, total_frames=size * batches)
    history = []
    for data in tqdm(collector, total=batches, desc=f"seed {seed}, {'filter' if filtered else 'no filter'}", leave=False):
        unsafe = (data["next", "region"][..., 0] == sspl.sets.UNSAFE).any(1)
        row = {"return": float(data["next", "episode_reward"][:, -1].mean()), "entered": float(unsafe.float().sum())}
        if filtered:
            row["interventions"] = float(data["intervened"].float().mean())
        history.append(row)
        kept = data.select(
            "state", "features", "wanted", "wanted_log_prob", "loc", "scale",
            ("next", "state"), ("next", "reward"), ("next", "done"), ("next", "terminated"),
        )  # fmt: skip
        for _ in range(8):
            advantage(kept)
            buffer.extend(kept.reshape(-1))
            for _ in range(size // 400):
                found = loss(buffer.sample())
                optimiser.zero_grad()
                sum(v for k, v in found.items() if k.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
    collector.shutdown()
    return history


def figure(runs: dict[str, list[list[dict[str, float]]]], path: Path) -> None:
    """Return and entries into U while learning, every seed a line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for colour, (name, histories) in zip(("tab:blue", "tab:red"), runs.items(), strict=True):
        for k, history in enumerate(histories):
            entered = torch.tensor([row["entered"] for row in history]).cumsum(0)
            axes[0].plot([row["return"] for row in history], color=colour, label=name if k == 0 else None)
            axes[1].plot(entered, color=colour, label=name if k == 0 else None)
    axes[0].set(xlabel=f"batch of {ENVS} episodes", ylabel=f"return (at most {STEPS})")
    axes[1].set(xlabel=f"batch of {ENVS} episodes", ylabel="episodes that entered U, in all")
    axes[0].legend()
    fig.savefig(path, dpi=110)


def main(seeds: tuple[int, ...] = (0, 1, 2), batches: int = 40, out_dir: str = "runs/under_filter") -> None:
    """Train, print and draw."""
    runs = {
        "with the filter": [train(s, filtered=True, batches=batches) for s in seeds],
        "without": [train(s, filtered=False, batches=batches) for s in seeds],
    }
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "under_filter.json").write_text(json.dumps(runs, indent=1))
    figure(runs, folder / "under_filter.png")
    print("| PPO | return at the end, by seed | episodes into U while learning |\n|---|---|---|")
    for name, histories in runs.items():
        last = max(1, batches // 10)
        ends = [sum(row["return"] for row in h[-last:]) / last for h in histories]
        entered = [int(sum(row["entered"] for row in h)) for h in histories]
        total = ENVS * batches
        print(f"| {name} | {' / '.join(f'{e:.1f}' for e in ends)} | {' / '.join(f'{e:,}' for e in entered)} of {total:,} each |")


if __name__ == "__main__":
    given = dict(argument.split("=", 1) for argument in sys.argv[1:])
    settings: dict[str, Any] = {k: v for k, v in given.items() if k == "out_dir"}
    settings |= {"seeds": tuple(int(s) for s in given["seeds"].split(","))} if "seeds" in given else {}
    settings |= {"batches": int(given["batches"])} if "batches" in given else {}
    main(**settings)
