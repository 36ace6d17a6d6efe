"""SSPLLoss in TorchRL's own Trainer, or with --loop in a loop of your own."""

import sys

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate
from torchrl.trainers import ReplayBufferTrainer, TargetNetUpdaterHook, Trainer

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.modules import Policy, SaLaD, make_rollout_policy
from torchrl_sspl.objectives import SSPLLoss


def total(terms):
    return sum(value for key, value in terms.items() if key.startswith("loss_"))


def main(batches: int = 12, updates: int = 32, seed: int = 0, loop: bool = False) -> dict[str, float]:
    torch.manual_seed(seed)
    env = PendulumEnv(batch_size=[64], image_size=32, horizon=5, seed=seed)
    env.initial_set = env.safe_set | env.state_space  # half of the episodes start in S
    salad = SaLaD.from_sizes(latent_dim=3, action_dim=1, action_scale=env.max_action)
    policy = Policy(latent_dim=3, action_dim=1, action_scale=env.max_action)
    loss = SSPLLoss(*salad, policy, successor="target")  # preset "sound", delayed barrier for successors
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    updater = SoftUpdate(loss, tau=0.05)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8192), batch_size=64)
    frames = {"frames_per_batch": 640, "total_frames": 640 * batches, "init_random_frames": 1280}
    collector = Collector(env, make_rollout_policy(salad, policy), auto_register_policy_transforms=False, **frames)
    history = []  # mean loss per collected batch
    if loop:
        for data in collector:
            buffer.extend(data.reshape(-1))
            history.append(0.0)
            for _ in range(updates):
                optimizer.zero_grad()
                value = total(loss(buffer.sample()))
                value.backward()
                optimizer.step()
                updater.step()
                history[-1] += value.item() / updates
    else:
        steps = {"total_frames": 640 * batches, "frame_skip": 1, "optim_steps_per_batch": updates}
        trainer = Trainer(collector=collector, loss_module=loss, optimizer=optimizer, progress_bar=False, **steps)
        ReplayBufferTrainer(buffer, flatten_tensordicts=True).register(trainer)
        trainer.register_op("post_optim", TargetNetUpdaterHook(updater))  # every update, not every batch
        trainer.register_op("post_optim_complete_log", lambda _, terms: history.append(total(terms).item()))
        trainer.train()
    with torch.no_grad():  # fresh states of S and U
        pixels = [env.observe(region.sample(2000)) for region in (env.safe_set, env.unsafe_set)]
        safe, unsafe = (salad.barrier.module(salad.encoder.module(seen)) for seen in pixels)
    errors = {"safe_error": (safe > 0).float().mean().item(), "unsafe_error": (unsafe <= 0).float().mean().item()}
    return {"first_loss": history[0], "last_loss": sum(history[-3:]) / len(history[-3:])} | errors


if __name__ == "__main__":
    print(main(loop="--loop" in sys.argv))
