"""TorchRL's trainer for the total loss: what it does per step, and that it continues where it was killed."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.record.loggers.csv import CSVLogger

from torchrl_sspl.data import TransitionStore
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, OutputError
from torchrl_sspl.lipschitz import LMIBarrier, SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy, make_rollout_policy
from torchrl_sspl.objectives import LipschitzLoss, SSPLLoss
from torchrl_sspl.trainers import Phase, Phases, Workspace
from torchrl_sspl.trainers.hooks import EveryHook, MarginHook
from torchrl_sspl.trainers.stepper import SSPLStepper
from torchrl_sspl.trainers.trainer import SSPLTrainer

# TorchRL announces changes of its own trainer, collector and checkpoints.
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")

FRAMES = 64


def build(folder: Path | None = None, *, batches: int = 6, lmi: bool = False, **options: Any) -> SSPLTrainer:
    torch.manual_seed(0)
    env = PendulumEnv(batch_size=[8], image_size=16, horizon=5, seed=0)
    env.initial_set = env.safe_set | env.state_space
    encoder = FrameEncoder(2, pool_to=8, channels=(4, 8), hidden=16)
    dynamics, policy = LatentDynamics(2, 1, (16,), 10.0), Policy(2, 1, (16,), 10.0)
    barrier = LMIBarrier(2, (8,)) if lmi else SandwichBarrier(2, (8,))
    loss = SSPLLoss(encoder, dynamics, barrier, policy, preset="sound", successor="target")
    collector = Collector(
        env,
        make_rollout_policy(encoder, policy),
        frames_per_batch=FRAMES,
        total_frames=FRAMES * batches,
        init_random_frames=FRAMES,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    buffer = TransitionStore(1024).replay_buffer(32, safe=0.2, unsafe=0.2)
    if lmi:
        lipschitz = LipschitzLoss(barrier)
        options |= {
            "lipschitz_loss": lipschitz,
            "lipschitz_optimizer": torch.optim.Adam(lipschitz.parameters(), 1e-2),
        }
    if options.pop("with_margins", False):
        options["margins"] = MarginHook(loss, buffer, lipschitz_bound=2.0, samples=64, maximum=0.2)
    return SSPLTrainer(
        collector=collector,
        total_frames=FRAMES * batches,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-2),
        replay_buffer=buffer,
        optim_steps_per_batch=4,
        checkpoint_dir=folder,
        progress_bar=False,
        **options,
    )


def weights(trainer: SSPLTrainer) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in trainer.loss_module.state_dict().items()}


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


def test_training_moves_every_network_and_follows_with_the_delayed_ones() -> None:
    trainer = build()
    before = weights(trainer)
    trainer.train()
    after = weights(trainer)
    assert trainer.collected_frames == 6 * FRAMES
    assert trainer.optimization_stepper.count == 4 * 6
    for network in ("encoder", "dynamics", "barrier", "actor_network", "target_encoder", "target_barrier"):
        names = [name for name in after if name.startswith(f"{network}_params")]
        assert any(not torch.equal(before[name], after[name]) for name in names), network


@pytest.mark.parametrize("lmi", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["sandwich", "lmi"])
def test_resume_ends_with_the_weights_of_an_uninterrupted_run(tmp_path: Path, lmi: bool) -> None:
    options: dict[str, Any] = {"lmi": lmi, "with_margins": True, "warm_start_steps": 6}
    straight = build(tmp_path / "straight", **options)
    straight.train()
    first = build(tmp_path / "broken", **options)
    first.register_op(
        "post_steps", lambda: first.request_stop() if first.collected_frames == 3 * FRAMES else None
    )
    first.train()
    assert first.collected_frames == 3 * FRAMES
    second = build(tmp_path / "broken", **options)
    torch.manual_seed(99)
    assert second.resume()
    assert second.collected_frames == 3 * FRAMES
    second.train()
    assert second.collected_frames == 6 * FRAMES
    assert_same(weights(straight), weights(second))


def test_without_restored_generators_the_run_would_differ(tmp_path: Path) -> None:
    straight = build(tmp_path / "straight")
    straight.train()
    other = build(tmp_path / "other")
    torch.manual_seed(99)
    other.train()
    with pytest.raises(AssertionError):
        assert_same(weights(straight), weights(other))


SCRIPT = """
import sys, warnings
from pathlib import Path
warnings.simplefilter("ignore")
sys.path.insert(0, sys.argv[1])
import torch
torch.set_num_threads(1)
from test_trainer import build, weights
trainer = build(Path(sys.argv[2]), batches=12, with_margins=True)
trainer.resume()
print("ready", flush=True)
trainer.train()
torch.save(weights(trainer), sys.argv[3])
"""


@pytest.mark.slow
def test_killed_at_any_moment_it_continues_bit_for_bit(tmp_path: Path) -> None:
    def start(folder: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SCRIPT, str(Path(__file__).parent), str(tmp_path / folder)]
        return subprocess.Popen([*command, str(tmp_path / f"{folder}.pt")], stdout=subprocess.PIPE, text=True)

    def finish(folder: str) -> None:
        with start(folder) as process:
            process.communicate()
        assert process.returncode == 0

    finish("straight")
    moments = random.Random(0)
    for _ in range(4):
        with start("killed") as process:
            assert process.stdout is not None
            while "ready" not in process.stdout.readline():
                assert process.poll() is None
            time.sleep(moments.uniform(0.05, 0.6))
            os.kill(process.pid, signal.SIGKILL)
    finish("killed")
    assert_same(torch.load(tmp_path / "straight.pt"), torch.load(tmp_path / "killed.pt"))


@pytest.mark.parametrize("steps", [10**6, -1])
def test_warm_start_trains_the_world_model_alone(steps: int) -> None:
    trainer = build(warm_start_steps=steps)
    before = weights(trainer)
    trainer.train()
    after = weights(trainer)
    policy = [name for name in after if name.startswith("actor_network_params")]
    assert all(torch.equal(before[name], after[name]) for name in policy)
    assert not torch.equal(
        before["encoder_params.module.latent_head.0.weight"],
        after["encoder_params.module.latent_head.0.weight"],
    )


@pytest.mark.parametrize(("error", "trained"), [(1e-6, False), (2.5, True)])
def test_warm_start_goes_on_until_the_labels_are_told_apart(error: float, trained: bool) -> None:
    trainer = build(warm_start_error=error)
    before = weights(trainer)
    trainer.train()
    stepper = trainer.optimization_stepper
    assert (stepper.mislabelled < 2.0) == (not trained)
    moved = [not torch.equal(before[name], w) for name, w in weights(trainer).items() if name.startswith("actor_network_params")]
    assert any(moved) == trained
    other = SSPLStepper(torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))]), warm_start_error=error)
    state = {**stepper.state_dict(), "optimizer": other.state_dict()["optimizer"]}
    other.load_state_dict(state)
    assert other.mislabelled == stepper.mislabelled


def test_lipschitz_step_stays_in_the_cone_and_keys_are_fixed() -> None:
    trainer = build(lmi=True)
    stepper = trainer.optimization_stepper
    barrier = stepper._barrier()
    keys, step = [], stepper.step

    def watch(trainer: SSPLTrainer, batch: TensorDict) -> TensorDict:
        out = step(trainer, batch)
        keys.append(tuple(sorted(out.keys())))
        assert barrier.feasible()
        assert not any(value.requires_grad for value in out.values())
        return out

    stepper.step = watch
    trainer.train()
    assert len(keys) == 24
    assert len(set(keys)) == 1
    assert {"loss_lipschitz", "lipschitz_share", "grad_norm", "warm_start"} <= set(keys[0])


def test_margins_are_set_from_the_buffer_and_logged() -> None:
    trainer = build(with_margins=True)
    trainer.train()
    logged = trainer._log_dict
    assert 0 < float(trainer.loss_module.dynamics_margin) <= 0.2
    assert logged["dynamics_margin"][-1] == pytest.approx(float(trainer.loss_module.dynamics_margin))
    expected = min(2.0 * logged["dynamics_error_sample"][-1], 0.2)
    assert logged["dynamics_margin"][-1] == pytest.approx(expected)


def test_evaluation_is_logged_and_can_stop_the_training(tmp_path: Path) -> None:
    seen = []

    def evaluate(trainer: SSPLTrainer) -> dict[str, Any]:
        torch.rand(3)  # evaluations draw random numbers without changing the training
        seen.append(trainer.collected_frames)
        return {"volume": len(seen) / 10, "stop": "large enough" if len(seen) == 2 else None}

    trainer = build(
        evaluate=evaluate, evaluate_every=2, logger=CSVLogger("run", log_dir=str(tmp_path)), log_interval=0
    )
    trainer.train()
    assert seen == [2 * FRAMES, 4 * FRAMES]
    assert trainer._stop_reason == "large enough"
    assert list((tmp_path / "run" / "scalars").glob("volume.csv"))
    plain = build(batches=4)
    plain.train()
    assert_same(weights(plain), weights(trainer))


def test_a_training_that_was_ended_goes_through_its_phases_and_stays_ended(tmp_path: Path) -> None:
    class Mark(Phase):
        name = "mark"

        def run(self, work: Any) -> None:
            ran.append(len(seen))

    def made() -> SSPLTrainer:
        networks = LatentDynamics(2, 1, (8,)), SandwichBarrier(2, (8,)), Policy(2, 1, (8,))
        return build(tmp_path, evaluate=evaluate, phases=Phases([Mark()], Workspace(FrameEncoder(2, pool_to=8), *networks)))

    def evaluate(trainer: SSPLTrainer) -> dict[str, Any]:
        seen.append(trainer.collected_frames)
        return {"stop": "large enough" if len(seen) == 2 else None}

    ran, seen = [], []
    first = made()
    first.train()
    assert (ran, first.phases.finished) == ([2], True)
    second = made()
    assert second.resume()
    second.train()
    assert second.collected_frames == 2 * FRAMES
    assert (ran, seen, second.phases.finished) == ([2], [FRAMES, 2 * FRAMES], True)


def test_figures_go_to_the_logger(tmp_path: Path) -> None:
    class Figure:
        def savefig(self, path: Path) -> None:
            path.write_text("drawn")

    logger = CSVLogger("run", log_dir=str(tmp_path))
    build(batches=2, draw=lambda trainer: {"latent": Figure()}, draw_every=2, logger=logger).train()
    assert (tmp_path / "run" / "figures" / f"latent_{2 * FRAMES}.png").read_text() == "drawn"


def test_wrong_arguments_are_named() -> None:
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], 0.1)
    with pytest.raises(ConfigError, match="lipschitz_loss and lipschitz_optimizer together"):
        SSPLStepper(optimizer, lipschitz_optimizer=optimizer)
    with pytest.raises(ConfigError, match="warm_start_error > 0"):
        SSPLStepper(optimizer, warm_start_error=0.0)
    with pytest.raises(ConfigError, match="warm_start_steps >= 0"):
        SSPLStepper(optimizer, warm_start_steps=-2)
    with pytest.raises(ConfigError, match="every >= 1"):
        EveryHook(None, dict, every=0)
    with pytest.raises(ConfigError, match="weights of actor_network alone"):
        build(learner_backend="ray")
    trainer = build()
    with pytest.raises(ConfigError, match="checkpoint_dir"):
        trainer.resume()
    trainer.collector.shutdown()
    with pytest.raises(ConfigError, match="SSPLLoss"):
        SSPLTrainer(
            collector=None, total_frames=1, loss_module=torch.nn.Linear(1, 1), optimizer=optimizer,
            replay_buffer=None, optim_steps_per_batch=1,
        )  # fmt: skip


def test_resume_says_whether_there_was_a_checkpoint_and_refuses_a_foreign_one(tmp_path: Path) -> None:
    trainer = build(tmp_path, batches=2)
    assert not trainer.resume()
    trainer.train()
    other = build(tmp_path, batches=2, lmi=True)
    with pytest.raises(CheckpointError, match="expected a checkpoint of this trainer"):
        other.resume()
    other.collector.shutdown()


def test_the_world_model_alone_has_the_terms_of_the_whole_and_zeros() -> None:
    trainer = build(batches=2)
    trainer.train()
    batch = trainer._modules["replay_buffer"].sample(None)
    loss = trainer.loss_module
    whole, alone = loss(batch).detach(), loss.world_model(batch).detach()
    assert set(whole.keys()) == set(alone.keys())
    for name in ("loss_safe", "loss_unsafe", "loss_consistency", "safe_error"):
        assert torch.equal(whole[name], alone[name]), name
    others = set(whole.keys()) - set(loss._salad_terms(loss._read(batch)))
    assert {"loss_synthesis", "loss_growth", "violation_max"} <= others
    assert all(float(alone[name]) == 0.0 for name in others)


@pytest.mark.slow
def test_checkpoints_come_by_time(tmp_path: Path) -> None:
    trainer = build(tmp_path, checkpoint_seconds=3600.0)
    saved, save = [], trainer._save_trainer
    trainer._save_trainer = lambda: (saved.append(trainer.collected_frames), save())  # type: ignore[method-assign]
    trainer.train()
    assert saved == [6 * FRAMES]  # the end alone
    often = build(tmp_path / "often", checkpoint_seconds=0.0)
    save_often = often._save_trainer
    often._save_trainer = lambda: (saved.append(often._optim_count), save_often())  # type: ignore[method-assign]
    often.train()
    assert saved[1:] == list(range(1, 25))  # after every optimiser step


@pytest.mark.parametrize("step", [1, 7])
def test_a_signal_between_two_steps_on_a_batch_continues_bit_for_bit(tmp_path: Path, capsys, step: int) -> None:
    options: dict[str, Any] = {"batches": 3, "with_margins": True, "warm_start_steps": 6, "checkpoint_seconds": 3600.0}
    for name in ("straight", "broken"):
        (tmp_path / name).mkdir()
    straight = build(tmp_path / "straight", out_dir=tmp_path / "straight", **options)
    straight.train()
    first = build(tmp_path / "broken", out_dir=tmp_path / "broken", **options)
    first.register_op("post_optim", lambda: signal.raise_signal(signal.SIGTERM) if first._optim_count == step else None)
    with pytest.raises(SystemExit) as ended:
        first.train()
    assert ended.value.code == 143
    assert first._optim_count == step  # the step's own hooks were done, no other step was begun
    assert "SIGTERM" in (said := capsys.readouterr().err)
    assert "resumes from there" in said
    second = build(tmp_path / "broken", out_dir=tmp_path / "broken", **options)
    assert second.resume()
    assert second._optim_count == step
    second.train()
    assert_same(weights(straight), weights(second))
    logs = [(tmp_path / name / "log.jsonl").read_text() for name in ("straight", "broken")]
    assert logs[0] == logs[1]


@pytest.mark.parametrize("error", [RuntimeError("At least one process failed"), BrokenPipeError()])
def test_what_fails_for_want_of_workers_that_a_signal_has_ended_is_no_failure(tmp_path: Path, capsys, error: Exception) -> None:
    def end_all() -> None:
        signal.raise_signal(signal.SIGTERM)
        raise error

    trainer = build(tmp_path)
    trainer.register_op("post_steps", end_all)
    with pytest.raises(SystemExit) as ended:
        trainer.train()
    assert ended.value.code == 143
    assert capsys.readouterr().err.count("interrupted by SIGTERM") == 1


def test_a_checkpoint_that_cannot_be_written_at_a_signal_is_said(tmp_path: Path) -> None:
    def refuse(*_: Any, **options: Any) -> None:
        raise OSError(28, "No space left on device")

    trainer = build(tmp_path, checkpoint_seconds=3600.0)
    trainer.checkpoint_rotation.save = refuse  # type: ignore[method-assign,union-attr]
    trainer.register_op("post_optim", lambda: signal.raise_signal(signal.SIGTERM) if trainer._optim_count == 1 else None)
    with pytest.raises(OutputError, match="No space left"):
        trainer.train()


def test_the_log_holds_the_means_over_the_steps_on_a_batch(tmp_path: Path) -> None:
    trainer, told = build(tmp_path, batches=3, out_dir=tmp_path), []
    step = trainer.optimization_stepper.step
    trainer.optimization_stepper.step = lambda *batch: told.append(step(*batch)) or told[-1].clone()
    trainer.train()
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert len(told) == 4 * len(rows) == 12
    assert set(map(len, trainer._log_dict.values())) == {1}  # it does not grow
    for k, row in enumerate(rows):
        for name in ("loss_safe", "loss_consistency", "grad_norm"):
            assert row[name] == pytest.approx(sum(float(t[name]) for t in told[4 * k : 4 * k + 4]) / 4, rel=1e-5), name


def test_every_batch_leaves_a_line_in_the_log_and_a_loss_that_is_not_finite_stops(tmp_path: Path) -> None:
    trainer = build(out_dir=tmp_path)
    told = set()
    trainer.register_op("post_optim", lambda: told.add(json.loads((tmp_path / "progress.json").read_text())["total"]))
    trainer.train()
    assert told == {24}  # while it runs, a file says how far it is
    assert not (tmp_path / "progress.json").exists()
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [4 * k for k in range(1, 7)]
    assert {row["phase"] for row in rows} == {"joint"}
    trainer = build()
    with torch.no_grad():
        next(trainer.loss_module.parameters()).fill_(float("nan"))
    with pytest.raises(ConfigError, match="expected finite losses"):
        trainer.train()
