"""The monitor: verdicts, alarms, and what is done during one."""

from __future__ import annotations

import math
import shutil
from contextlib import closing
from functools import partial
from pathlib import Path

import gymnasium
import pytest
import torch
from torch import Tensor

from torchrl_sspl.envs import GymnasiumPixels, PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, DTypeError, OutputError, ShapeError
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.controllers import as_controller
from torchrl_sspl.modules.agent import load
from torchrl_sspl.runtime import Calibration, CameraFault, Monitor, Verdict, calibrate
from torchrl_sspl.runtime.faults import FAULTS
from torchrl_sspl.runtime.monitor import SIGNALS, Watching, starts

NOISE = 1.0
UPRIGHT = torch.tensor([[0.05, 0.0]])


def shown(n: int = 1, steps: int = 1) -> list[Tensor]:
    """Pictures of a pendulum near upright, with the noise of a camera, under no torque."""
    env, camera = PendulumEnv(batch_size=[1], seed=0), CameraFault("dark", 1.0, noise=NOISE)
    state = UPRIGHT.expand(n, 2)
    before, found = env.previous_state(state), []
    for t in range(steps):
        found.append(camera(torch.cat([env.draw(before), env.draw(state)], 1), t))
        before, state = state, env.wrap(env.dynamics(state, torch.zeros(n, 1)))
    return found


def names(verdict: Tensor) -> list[str]:
    return [Verdict(int(v)).name for v in verdict]


def test_what_is_known_is_where_the_proof_applies():
    monitor = Monitor.load("pendulum")
    out = monitor.step(shown()[0])
    assert names(out.verdict) == ["PROOF_APPLIES"]
    assert out.reasons == [[]]
    assert not bool(out.alarm)
    assert math.isnan(float(out.signals["innovation"]))  # nothing was expected yet
    far = PendulumEnv(batch_size=[1], seed=0)
    camera, state = CameraFault("dark", 1.0, noise=NOISE), torch.tensor([[2.0, 0.0]])
    monitor.reset()
    out = monitor.step(camera(torch.cat([far.draw(state), far.draw(state)], 1), 0))
    assert names(out.verdict) == ["OUTSIDE"]


def test_the_actions_are_the_agents_own():
    monitor, controller = Monitor.load("pendulum", batch_size=3), load("pendulum").controller(3)
    for pixels in shown(3, 4):
        assert torch.equal(monitor.step(pixels).action, controller.step(pixels).action)


# To generate C++ takes ten times as long as to trace, and is no part of the monitor; test_filter.py has it in every run.
GENERATED = pytest.param(
    "inductor", marks=[pytest.mark.slow, pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")]
)


@pytest.mark.parametrize("backend", ["aot_eager", GENERATED])
def test_a_compiled_monitor_says_what_the_plain_one_says(monkeypatch, backend):
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
    plain, graph = (Monitor.load("pendulum", batch_size=2, compile=compile) for compile in (False, True))
    for t, pixels in enumerate(shown(2, 12)):
        pixels = None if t == 5 else torch.zeros_like(pixels) if t == 8 else pixels
        wanted, found = plain.step(pixels), graph.step(pixels)
        assert torch.equal(wanted.verdict, found.verdict)
        assert wanted.reasons == found.reasons
        for name, value in wanted.signals.items():
            torch.testing.assert_close(found.signals[name], value, atol=1e-4, rtol=1e-4, equal_nan=True)
        for name in ("action", "barrier", "latent"):
            torch.testing.assert_close(getattr(found, name), getattr(wanted, name), atol=1e-3, rtol=1e-4)
        for monitor in (plain, graph):
            monitor.took(torch.full((2, 1), 3.0))


@pytest.mark.parametrize("fault", ["dark", "bright", "colour", "noise", "salt", "shifted", "covered", "crossed", "doubled", "frozen"])
def test_severe_faults_are_alarms_within_three_steps(fault):
    pictures, camera = shown(2, 12), CameraFault(fault, FAULTS[fault][2], onset=6, noise=0.0)
    monitor = Monitor.load("pendulum", batch_size=2)
    alarms = [monitor.step(camera(p, t)).alarm for t, p in enumerate(pictures)]
    assert not bool(torch.stack(alarms[:6]).any())
    assert bool(torch.stack(alarms[6:9]).any(0).all())


@pytest.mark.parametrize("name", ["picture", "place", "texture", "order", "innovation"])
def test_limits_are_those_of_the_calibration(name):
    pictures = shown(1, 2)
    monitor = Monitor.load("pendulum")
    monitor.step(pictures[0])
    value = float(monitor.step(pictures[1]).signals[name])
    for limits, beyond in (((-1.0, value + 1e-6), False), ((-1.0, value - 1e-6), True), ((value + 1e-6, 9.0), True)):
        monitor.reset()
        monitor.calibration.limits[name] = limits
        monitor.step(pictures[0])
        assert (name in monitor.step(pictures[1]).reasons[0]) is beyond


def test_rows_have_alarms_and_resets_of_their_own():
    monitor = Monitor.load("pendulum", batch_size=2)
    good = shown(2)[0]
    black = good.clone()
    black[1] = 0
    assert names(monitor.step(black).verdict) == ["PROOF_APPLIES", "UNKNOWN_PICTURE"]
    monitor.reset(torch.tensor([1]))
    assert names(monitor.step(shown(2, 2)[1]).verdict)[1] == "PROOF_APPLIES"


def test_an_alarm_ends_after_clean_steps_and_the_proof_does_not_come_back():
    monitor = Monitor.load("pendulum", clear_after=3, signals=("place",))
    pictures = shown(1, 8)
    pictures[2] = torch.zeros_like(pictures[2])
    found = [names(monitor.step(p).verdict)[0] for p in pictures]
    assert found[:2] == ["PROOF_APPLIES"] * 2
    assert found[2:5] == ["UNKNOWN_PICTURE"] * 3
    assert "PROOF_APPLIES" not in found[5:]


def test_fallbacks_act_during_an_alarm_only():
    black = torch.zeros(1, 6, 64, 64, dtype=torch.uint8)
    assert float(Monitor.load("pendulum", fallback="stop").step(black).action) == 0.0
    assert float(Monitor.load("pendulum", fallback=lambda told: torch.full_like(told.action, 3.0)).step(black).action) == 3.0
    monitor = Monitor.load("pendulum", fallback=lambda told: torch.full_like(told.action, 3.0))
    assert float(monitor.step(shown()[0]).action) != 3.0
    with pytest.raises(ShapeError, match="fallback"):
        Monitor.load("pendulum", fallback=lambda told: torch.zeros(3)).step(black)


def test_what_was_really_done_is_what_the_memory_goes_on_from():
    monitor, other = Monitor.load("pendulum"), load("pendulum")
    out = monitor.step(shown()[0])
    push = torch.full((1, 1), 7.0)
    monitor.took(push)
    assert torch.equal(monitor._controller._memory.prior, other.dynamics(out.latent, push))
    with pytest.raises(ShapeError, match="expected actions"):
        monitor.took(torch.zeros(2, 1))


def test_other_drivers_are_watched_with_their_own_actions():
    agent, env = load("pendulum"), PendulumEnv(batch_size=[1], seed=0)
    calibration = Calibration.load("pendulum", agent)
    watching = Watching(agent, calibration, driver=as_controller(lambda pixels: torch.full((len(pixels), 1), 2.0)))
    run = simulate(watching, env, start=UPRIGHT.expand(4, 2), horizon=5)
    assert torch.equal(run.actions, torch.full((5, 4, 1), 2.0))
    assert float(watching.extremes()["innovation"][1].max()) < calibration.limits["innovation"][1]


def test_episodes_of_unequal_length_one_after_the_other_are_told_apart():
    agent = load("pendulum")
    watching = Watching(agent, Calibration.load("pendulum", agent), change=CameraFault("dark", 0.0, onset=2))
    pictures = shown(1, 4)
    for length in (2, 4):
        watching.reset()
        for picture in pictures[:length]:
            watching.step(picture)
    assert watching.alarms().tolist() == [[False, False], [False, False], [False, True], [False, True]]
    assert watching.applies().tolist() == [[True, True], [True, True], [False, False], [False, False]]


def test_a_fallback_acts_on_the_rows_with_an_alarm_and_the_memory_knows_it():
    monitor = Monitor.load("pendulum", batch_size=2, fallback=lambda told: torch.full_like(told.action, 3.0))
    pictures = shown(2)[0]
    pictures[1] = 0
    out = monitor.step(pictures)
    assert float(out.action[1]) == 3.0
    assert float(out.action[0]) == pytest.approx(float(monitor.agent.policy(out.latent)[0]))
    assert torch.equal(monitor._controller._memory.prior, monitor.agent.dynamics(out.latent, out.action))


@pytest.mark.parametrize(
    ("pixels", "reason"),
    [
        (None, "missing"),
        (torch.full((1, 6, 64, 64), math.nan), "kind"),
        (torch.zeros(1, 6, 32, 32, dtype=torch.uint8), "size"),
        (torch.zeros(1, 3, 64, 64, dtype=torch.uint8), "size"),
    ],
)
def test_what_is_no_picture_is_an_alarm_and_the_memory_goes_on(pixels, reason):
    monitor = Monitor.load("pendulum")
    first, second = shown(1, 2)
    monitor.step(first)
    out = monitor.step(pixels)
    assert out.reasons == [[reason]]
    assert names(out.verdict) == ["UNKNOWN_PICTURE"]
    assert bool(out.action.isfinite().all())
    expected = monitor.agent.dynamics(out.latent, out.action)
    assert torch.equal(monitor._controller._memory.prior, expected)
    assert bool(monitor.step(second).action.isfinite().all())
    assert Monitor.load("pendulum").step(pixels).reasons == [[reason]]  # as the first thing that is seen


def test_frames_that_follow_each_other_differ_by_nothing_row_by_row():
    monitor = Monitor.load("pendulum", batch_size=2)
    first, second = shown(2, 2)
    monitor.step(first)
    assert monitor.step(second).signals["order"].tolist() == [0.0, 0.0]
    second[1, 0, 0, 0] ^= 64
    monitor.reset()
    monitor.step(first)
    assert monitor.step(second).signals["order"].tolist() == pytest.approx([0.0, 64 / (255 * 3 * 64 * 64)])


def test_the_premise_is_told_during_an_alarm_too():
    monitor = Monitor.load("pendulum", signals=("texture",))
    first, second = shown(1, 2)
    monitor.calibration.limits["texture"] = (-1.0, 0.0)
    assert bool(monitor.step(first).alarm)
    out = monitor.step(second)
    assert names(out.verdict) == ["UNKNOWN_PICTURE"]
    assert bool(out.applies)
    assert not bool(monitor.step(torch.zeros_like(second)).applies)


def test_times_that_do_not_fit_are_alarms():
    monitor = Monitor.load("pendulum", period=0.05)
    found = [bool(monitor.step(p, time=t).alarm) for p, t in zip(shown(1, 4), (0.0, 0.05, 0.1, 0.2), strict=True)]
    assert found == [False, False, False, True]
    assert monitor.step(shown(1, 5)[4], time=math.nan).reasons[0][-1:] == ["time"]


@pytest.mark.parametrize("options", [{"fallback": "run"}, {"clear_after": 0}, {"period": 0.0}, {"signals": ("smell",)}, {"batch_size": 0}])
def test_options_that_are_none_are_refused(options):
    with pytest.raises(ConfigError, match="expected"):
        Monitor.load("pendulum", **options)


def test_another_number_of_pictures_is_refused():
    with pytest.raises(ShapeError, match="2 systems"):
        Monitor.load("pendulum", batch_size=2).step(shown(3)[0])


def test_a_calibration_belongs_to_one_agent_and_is_replaced_in_one_step(tmp_path, monkeypatch):
    agent = load("pendulum")
    with pytest.raises(CheckpointError, match="calibrate"):
        Calibration.load(agent.save(tmp_path), agent)
    Calibration.load("pendulum", agent).save(tmp_path)
    assert set(Calibration.load(tmp_path, agent).limits) == set(SIGNALS)
    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(Path, "replace", full)
        with pytest.raises(OutputError, match="as it was before"):
            Calibration.load("pendulum", agent).save(tmp_path)
    assert Calibration.load(tmp_path, agent).episodes == Calibration.load("pendulum", agent).episodes
    agent.barrier[-1].bias.data.add_(0.1)
    with pytest.raises(CheckpointError, match="other weights"):
        Calibration.load(tmp_path, agent)
    (tmp_path / "monitor.safetensors").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="expected a calibration"):
        Calibration.load(tmp_path, agent)


def test_a_calibration_calls_its_own_episodes_clean_and_a_fault_strange():
    agent, env = load("pendulum"), PendulumEnv(batch_size=[1], seed=0)
    found = calibrate(agent, env, episodes=24, horizon=10, pictures=2000, steps=600)
    assert found.false_alarms == pytest.approx(7 / 25)
    start = starts(agent, env, 24, torch.Generator().manual_seed(9))
    alarms = {}
    for name, strength in (("dark", 1.0), ("dark", 0.0)):
        watching = Watching(agent, found, change=CameraFault(name, strength, onset=5, noise=NOISE))
        simulate(watching, env, start=start, horizon=10)
        alarms[strength] = watching.alarms().any(0).float().mean()
    assert float(alarms[1.0]) < 0.5
    assert float(alarms[0.0]) == 1.0


def test_a_system_whose_states_are_unknown_is_not_calibrated():
    env = GymnasiumPixels(
        partial(gymnasium.make, "CartPole-v1", render_mode="rgb_array"), safe=lambda s, _: abs(s[2]) < 0.05, unsafe=lambda s, _: abs(s[2]) > 0.1,
        image_size=64, seed=0,
    )  # fmt: skip
    with closing(env), pytest.raises(ConfigError, match=r"expected a SafetyEnv.*received GymnasiumPixels.*agent\.controller"):
        calibrate(load("pendulum"), env, episodes=2, horizon=2, pictures=10, steps=1)


def test_every_fault_changes_what_is_shown_at_every_strength():
    env = PendulumEnv(batch_size=[1], seed=0)
    for name, strengths in FAULTS.items():
        for strength in strengths:
            camera, differs, state = CameraFault(name, strength, onset=2), False, torch.tensor([[0.5, 2.0]])
            before = env.previous_state(state)
            for t in range(10):
                clean = torch.cat([env.draw(before), env.draw(state)], 1)
                made = camera(clean, t)
                assert made.shape == clean.shape
                assert made.dtype == torch.uint8
                assert t >= 2 or torch.equal(made, clean)
                differs |= not torch.equal(made, clean)
                before, state = state, env.wrap(env.dynamics(state, torch.ones(1, 1)))
            assert differs or name == "dropped"  # two in a hundred frames
    with pytest.raises(ConfigError, match="faults"):
        CameraFault("rain", 1.0)


@pytest.mark.parametrize("noise", [-1.0, math.inf, math.nan])
def test_a_noise_that_no_camera_has_is_refused(noise):
    with pytest.raises(ConfigError, match="finite noise"):
        CameraFault("dark", 1.0, noise=noise)
    with pytest.raises(ConfigError, match="finite noise"):
        calibrate(None, None, noise=noise)  # before anything is fitted


@pytest.mark.parametrize("fallback", ["policy", "stop"])
def test_a_latent_that_is_no_number_is_an_alarm_and_the_memory_goes_on_afterwards(fallback):
    monitor, pixels = Monitor.load("pendulum", fallback=fallback), torch.zeros(1, 6, 64, 64, dtype=torch.uint8)
    head = monitor.agent.encoder.forward
    monitor.agent.encoder.forward = lambda pixels: torch.full((len(pixels), 3), math.nan)
    found = monitor.step(pixels)
    assert bool(found.alarm)
    assert "nan" in found.reasons[0]
    assert fallback == "policy" or not bool(found.action.any())
    assert bool(monitor.step(None).action.isfinite().all())  # without a picture, as of an episode that begins
    monitor.agent.encoder.forward = head
    after = monitor.step(pixels)
    assert "nan" not in after.reasons[0]
    assert bool(after.action.isfinite().all())
    assert not bool(after.applies)


def test_a_size_that_changes_is_an_alarm_where_the_encoder_takes_any():
    monitor = Monitor.load("pendulum")
    monitor.agent.encoder.image_size = None
    monitor.step(torch.zeros(1, 6, 64, 64, dtype=torch.uint8))
    assert monitor.step(torch.zeros(1, 6, 128, 128, dtype=torch.uint8)).reasons == [["size"]]


def test_what_others_do_is_not_what_was_proved():
    monitor = Monitor.load("pendulum")
    out = monitor.step(shown()[0])
    assert monitor.took(out.action).tolist() == [True]
    assert monitor.took(out.action + 1.0).tolist() == [False]
    assert names(monitor.step(shown(1, 2)[1]).verdict) == ["INSIDE"]


@pytest.mark.parametrize(("options", "time"), [({}, 0.0), ({"period": 0.05}, None)])
def test_a_time_and_a_period_go_together(options, time):
    monitor = Monitor.load("pendulum", **options)
    with pytest.raises(ConfigError, match="period=dt"):
        monitor.step(shown()[0], time=time)
    if options:
        assert monitor.step(None).reasons == [["missing"]]


def test_a_step_that_is_refused_leaves_the_time_as_it_was():
    monitor = Monitor.load("pendulum", period=0.05)
    monitor.step(shown()[0], time=0.0)
    with pytest.raises(ShapeError):
        monitor.step(shown(2)[0], time=0.05)
    assert monitor.step(shown(1, 2)[1], time=0.05).reasons == [[]]


def test_a_calibration_of_other_weights_is_refused():
    agent, calibration = load("pendulum"), Monitor.load("pendulum").calibration
    Monitor(agent.double(), calibration)  # the same numbers
    with torch.no_grad():
        agent.barrier[-1].bias.sub_(0.1)
    with pytest.raises(CheckpointError, match="other weights"):
        Monitor(agent, calibration)


def test_an_agent_of_float64_is_watched_as_one_of_float32():
    one, other = Monitor.load("pendulum"), Monitor.load("pendulum")
    other = Monitor(other.agent.double(), other.calibration)
    for pixels in shown(1, 3):
        a, b = one.step(pixels), other.step(pixels)
        assert torch.equal(a.verdict, b.verdict)
        assert b.action.dtype == torch.float64
        torch.testing.assert_close(b.signals["place"].float(), a.signals["place"], atol=1e-5, rtol=1e-5)


def test_what_is_no_picture_and_no_row_is_refused():
    monitor = Monitor.load("pendulum")
    with pytest.raises(DTypeError, match="received list"):
        monitor.step([1, 2])
    with pytest.raises(ShapeError, match="rows of 1 systems"):
        monitor.reset(torch.tensor([7]))


def test_a_camera_keeps_frames_of_another_time_alone():
    clean = torch.zeros(1, 6, 8, 8, dtype=torch.uint8)
    kept = {}
    for name in ("dark", "delayed"):
        camera = CameraFault(name, 1.0, onset=0)
        for t in range(5):
            camera(clean, t)
        kept[name] = len(camera.history)
    assert kept == {"dark": 0, "delayed": 5}
