"""SSPLLoss in TorchRL's own Trainer, or with --loop in a loop of your own; then the library's phases, and its measures."""

import sys
from functools import partial

import torch
from torchrl.collectors import Collector
from torchrl.trainers import LRSchedulerHook, ReplayBufferTrainer, Trainer

from torchrl_sspl import Agent, evaluate
from torchrl_sspl.configs import compose
from torchrl_sspl.data import Augmentation, RandomActions, TransitionStore
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.evaluation.certify import premise
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy, SaLaD, make_rollout_policy
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.trainers import CheckRound, Phases, Source, Workspace, starts_of, synthesis_phases

SHOWN = ("unsafe_called_safe", "safe_called_unsafe", "volume_over_kernel", "false_safe", "safe_rollouts_touch_unsafe",
         "safe_rollouts_leave", "unsafe_rollouts_return")  # fmt: skip


def main(*overrides: str, batches: int = 19, updates: int = 400, loop: bool = False, phases: bool = True, seed: int = 0):
    config = compose(["env=pendulum", *overrides])  # for the settings of phases and evaluation
    torch.manual_seed(seed)
    make_env = partial(PendulumEnv, image_size=config.env["image_size"])
    env = make_env(batch_size=[64], seed=seed)
    env.initial_set = starts_of(env, config.collector.starts)
    dynamics, policy = LatentDynamics(3, 1, (96, 96), env.max_action), Policy(3, 1, (48, 48), env.max_action)
    salad = SaLaD(FrameEncoder(3), dynamics, SandwichBarrier(3, (96, 96, 96), lipschitz_bound=2.0))
    loss = SSPLLoss(*salad, policy, worst_coeff=0.0, saturation_limit=0.905)  # preset "sound"
    synthesis = loss.synthesis_coeff.clone()
    loss.synthesis_coeff.zero_()  # the world model first; with phases, barrier and policy wait for the frozen latents
    first = batches // 2 + 1  # so many batches of random actions before the first update
    total = (batches - first + 1) * updates
    optimizer = torch.optim.Adam(loss.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=total, pct_start=0.1)
    store = TransitionStore(1280 * batches)
    buffer = store.replay_buffer(192, safe=1 / 6, unsafe=1 / 6)
    frames = {"frames_per_batch": 1280, "total_frames": 1280 * batches, "init_random_frames": 1280 * first}
    acting = RandomActions(env, seed) if phases else make_rollout_policy(salad, policy)
    collector = Collector(env, acting, auto_register_policy_transforms=False, max_frames_per_traj=4, **frames)
    taken = {"starts": config.collector.starts, "steps": config.synthesis.episode_steps, "seed": seed}
    source = Source(make_env, salad.encoder, store=store, changes=Augmentation(**vars(config.augmentation), seed=seed), **taken)
    work = Workspace(*salad, policy, config=config.synthesis, source=source, seed=seed)
    rounds = Phases(synthesis_phases(config.synthesis, check=CheckRound) if phases else [], work, progress=True)

    def begin():  # before the updates of a batch: after half of them, SSPLLoss alone turns to barrier and policy
        if not phases and schedule.last_epoch >= total // 2:
            loss.synthesis_coeff.copy_(synthesis)

    if loop:
        for index, data in enumerate(collector, start=1):
            buffer.extend(data.reshape(-1))
            begin()
            for _ in range(updates if index >= first else 0):
                optimizer.zero_grad()
                sum(value for key, value in loss(buffer.sample()).items() if key.startswith("loss_")).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 5.0)
                optimizer.step()
                schedule.step()
        rounds.run()
    else:
        steps = {"total_frames": 1280 * batches, "frame_skip": 1, "optim_steps_per_batch": updates, "clip_norm": 5.0}
        trainer = Trainer(collector=collector, loss_module=loss, optimizer=optimizer, progress_bar=False, **steps)
        ReplayBufferTrainer(buffer, flatten_tensordicts=True).register(trainer)
        LRSchedulerHook(schedule, interval="optim").register(trainer)
        trainer.register_op("pre_optim_steps", begin)
        rounds.register(trainer)  # they run when all transitions are collected
        trainer.train()
    agent = Agent.from_loss(loss, level=work.level, **(work.acts() if phases else {}))  # behind the observer of the phases
    agent.tolerated_error = premise(agent) if phases else 0.0  # its memory's corrections are held by it
    measured = evaluate(agent, env, config.evaluation, progress=True)
    return {name: measured[name] for name in SHOWN}


if __name__ == "__main__":
    flags = {"loop": "--loop" in sys.argv, "phases": "--no-phases" not in sys.argv}
    print(main(*(word for word in sys.argv[1:] if not word.startswith("--")), **flags))
