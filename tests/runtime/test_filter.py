"""The safety filter: what it lets through, what it takes instead, and that the system stays out of U behind it."""

from __future__ import annotations

import math
import shutil
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import Compose, InitTracker, TransformedEnv

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.modules import LatentDynamics, Policy
from torchrl_sspl.modules.agent import Agent, load
from torchrl_sspl.runtime import SafetyFilter, SafetyVectorWrapper, SafetyWrapper, Shield


class Moves(LatentDynamics):
    """z+ = z + u / 10."""

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return (latent + action / 10).clamp(-1, 1)


class Back(Policy):
    """Pushes back with full strength."""

    def forward(self, latent: Tensor) -> Tensor:
        return -self.action_scale * latent.sign()


class Pushes(Policy):
    """The same action everywhere."""

    def __init__(self, action: float) -> None:
        super().__init__(1, 1)
        self.action = action

    def forward(self, latent: Tensor) -> Tensor:
        return torch.full_like(latent, self.action)


class Shown(nn.Module):
    """Latents with these first entries, one after the other, whatever is seen."""

    def __init__(self, first: list[float]) -> None:
        super().__init__()
        self.first = iter(first)

    def forward(self, pixels: Tensor) -> Tensor:
        return torch.tensor([[next(self.first), 0.0, 0.0]])


def line(error: float = 0.01, own: Policy | None = None) -> Agent:
    """On a line, B(z) = z - 0.5, actions of at most 1."""
    barrier = nn.Sequential(nn.Linear(1, 1))
    with torch.no_grad():
        barrier[0].weight.fill_(1.0)
        barrier[0].bias.fill_(-0.5)
    return Agent(nn.Identity(), Moves(1, 1), barrier, own or Back(1, 1), 1.0, {"tolerated_error": error}, 0.5)


def shield(**options: Any) -> Shield:
    return Shield(line(), **{"level": 0.0, "margin": 0.02} | options)


@pytest.mark.parametrize(
    ("latent", "wanted", "taken"),
    [
        (0.0, 0.7, 0.7),  # nothing speaks against it
        (0.45, 0.2, 0.2),  # to 0.47, inside by 0.03
        (0.45, 1.0, 0.3),  # to 0.48 at most
        (0.45, -1.0, -1.0),
        (0.55, 0.3, -1.0),  # outside: the agent's own action
        (0.55, -0.9, -1.0),  # also where the other one leads back
        (0.0, 3.0, 1.0),  # beyond its range
    ],
)
def test_what_is_taken(latent, wanted, taken):
    found = shield()(torch.tensor([[latent]]), torch.tensor([[wanted]]))
    assert float(found.action) == pytest.approx(taken, abs=2e-3)
    assert bool(found.intervened) == (abs(wanted - taken) > 1e-9)
    assert float(found.deviation) == pytest.approx(abs(wanted - taken), abs=2e-3)
    after = latent + float(found.action) / 10
    assert float(found.margin) == pytest.approx(0.5 - 0.02 - after, abs=1e-5)
    assert latent > 0.5 or float(found.margin) >= 0.0


def test_a_lower_level_acts_earlier_and_blending_goes_the_agents_way():
    latent, wanted = torch.tensor([[0.35]]), torch.tensor([[1.0]])
    assert float(shield()(latent, wanted).action) == 1.0
    assert float(shield(level=-0.1)(latent, wanted).action) == pytest.approx(0.3, abs=2e-3)
    assert float(shield(level=-0.103, mode="blend")(latent, wanted).action) == pytest.approx(0.27, abs=4e-3)


def test_where_no_action_keeps_the_lower_level_it_is_the_agents_own():
    assert float(shield(level=-0.3)(torch.tensor([[0.45]]), torch.tensor([[1.0]])).action) == -1.0


@pytest.mark.parametrize(
    ("own", "wanted", "taken"),
    [
        (-0.2, -0.2, -0.2),  # the agent's own, to B = -.07, though the level is not kept
        (-0.2, -0.4, -0.4),  # better than that
        (-0.2, 1.0, -0.2),
        (0.4, 0.4, 0.4),  # the agent's own, to B = -.01, less than the margin inside: [V] speaks of no other action
        (0.4, 0.35, 0.3),
    ],
)
def test_no_more_is_asked_of_an_action_than_of_the_agents_own(own, wanted, taken):
    protect = Shield(line(own=Pushes(own)), level=-0.3, margin=0.02)
    found = protect(torch.tensor([[0.45]]), torch.tensor([[wanted]]))
    assert float(found.action) == pytest.approx(taken, abs=2e-3)
    assert bool(found.intervened) == (wanted != taken)


def test_the_agents_own_action_is_the_one_that_is_known_already():
    latent, wanted = torch.tensor([[0.45], [0.55]]), torch.tensor([[1.0], [1.0]])
    found, known = shield()(latent, wanted), shield()(latent, wanted, torch.tensor([[-1.0], [-1.0]]))
    assert all(torch.equal(getattr(found, name), getattr(known, name)) for name in vars(found))
    assert shield()(latent, wanted, torch.tensor([[-1.0], [-0.7]])).action[1] == -0.7  # outside it is what is taken
    with pytest.raises(ShapeError, match=r"\(2, 1\)"):
        shield()(latent, wanted, torch.zeros(2, 2))


def test_where_no_action_keeps_the_margin_it_is_the_agents_own():
    protect = Shield(line(own=Pushes(0.4)), level=0.0, margin=0.2)  # -1 leads to B = -.15
    assert float(protect(torch.tensor([[0.45]]), torch.tensor([[1.0]])).action) == pytest.approx(0.4)


@pytest.mark.slow  # the compiled monitor is held to the plain one, and no module breaks its graph
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_a_compiled_shield_takes_what_the_plain_one_takes():
    g = torch.Generator().manual_seed(0)
    latent, wanted = torch.rand(256, 1, generator=g) * 2 - 1, torch.rand(256, 1, generator=g) * 4 - 2
    one, other = (shield(compile=compile)(latent, wanted) for compile in (False, True))
    assert 20 < int((one.intervened & (wanted.abs()[:, 0] <= 1.0)).sum()) < 200
    assert torch.equal(one.intervened, other.intervened)
    torch.testing.assert_close(other.action, one.action, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(other.margin, one.margin, atol=1e-5, rtol=0.0)


def test_rows_do_not_mix():
    g = torch.Generator().manual_seed(0)
    latent, wanted = torch.rand(64, 1, generator=g), torch.rand(64, 1, generator=g) * 2 - 1
    whole = shield()(latent, wanted)
    for k in range(0, 64, 7):
        one = shield()(latent[k : k + 1], wanted[k : k + 1])
        assert torch.equal(one.action[0], whole.action[k])
        assert torch.equal(one.margin[0], whole.margin[k])


class Uneven(Moves):
    """Whose results differ from call to call, as those of products in floating point may, in their last bits, from batch to batch."""

    calls = 0

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        self.calls += 1
        return super().forward(latent, action) + 0.004 * self.calls


@pytest.mark.parametrize("mode", ["nearest", "blend"])
def test_what_the_memory_is_given_is_what_was_checked(mode):
    agent = line()
    agent.dynamics = Uneven(1, 1)
    latent, wanted = torch.linspace(0.3, 0.6, 23)[:, None], torch.ones(23, 1)
    made = Shield(agent, mode=mode, level=0.0, margin=0.02)(latent, wanted)
    assert bool(((made.action > -1.0) & made.intervened).any())  # another one than both was looked for
    assert torch.equal(made.margin, -0.02 - agent.barrier(made.predicted)[:, 0])
    assert bool((made.margin[latent[:, 0] < 0.5] >= 0.0).all())
    assert not torch.equal(made.predicted, agent.dynamics(latent, made.action))  # a second evaluation is another number
    batch = TensorDict(pixels=latent, prior=latent, is_init=torch.ones(23, 1, dtype=torch.bool), action=wanted, batch_size=[23])
    out = SafetyFilter(agent, mode=mode, level=0.0, margin=0.02)(batch)
    assert torch.equal(out["safety_margin"], -0.02 - agent.barrier(out["next", "prior"]))


def test_the_wrappers_memory_is_given_what_was_checked():
    wrapped = SafetyWrapper(Gym(), load("pendulum"))
    wrapped.reset(seed=5)
    guard, asked = wrapped._guard, torch.tensor([[4.0]])
    made = guard.shield(guard._latent, asked)
    made.predicted += 0.5
    guard.shield = lambda latent, wanted: made
    guard.protect(asked.numpy())
    assert torch.equal(guard._controller.expected()[0], made.predicted)


@pytest.mark.parametrize("options", [{"mode": "soft"}, {"level": 0.1}, {"margin": -0.1}, {"level": math.nan}])
def test_options_that_are_none_are_refused(options):
    with pytest.raises(ConfigError, match="expected mode"):
        shield(**options)


def test_bad_actions_are_refused():
    with pytest.raises(ShapeError, match=r"\(2, 1\)"):
        shield()(torch.zeros(2, 1), torch.zeros(2, 2))
    with pytest.raises(NonFiniteError, match="protected"):
        shield()(torch.zeros(1, 1), torch.full((1, 1), math.nan))
    with pytest.raises(NonFiniteError, match="latent"):
        shield()(torch.full((1, 1), math.nan), torch.zeros(1, 1))
    assert shield()(torch.zeros(1, 1), torch.zeros(1, 1, dtype=torch.float64)).action.dtype == torch.float32


def test_an_agent_without_a_proof_needs_a_margin():
    with pytest.raises(ConfigError, match="margin"):
        Shield(line(error=0.0))
    assert Shield(line(error=0.0), margin=0.02).margin == 0.02


def test_the_margin_of_a_proof_is_its_tolerated_error():
    agent = load("pendulum")
    made = Shield(agent)
    least = agent.lipschitz_bound * agent.tolerated_error
    assert least < made.margin < least + 0.01


def test_behind_a_policy_that_pushes_the_pendulum_stays_out_of_u():
    agent = load("pendulum")
    env = PendulumEnv(batch_size=[32], seed=0)
    pushes = TensorDictModule(lambda pixels: torch.full((len(pixels), 1), 10.0), ["pixels"], ["action"])
    protect = SafetyFilter(agent)

    env.initial_set = env.safe_set
    outer = TransformedEnv(env, Compose(InitTracker(), protect.make_tensordict_primer()))
    bare = outer.rollout(60, pushes)["next", "region"]
    kept = outer.rollout(60, TensorDictSequential(pushes, protect))
    assert bool((bare == 2).any(1).all())
    assert not bool((kept["next", "region"] == 2).any())
    assert bool(kept["intervened"].any())
    assert kept["deviation"].shape == kept["safety_margin"].shape == (32, 60, 1)
    changed = (kept["action"] - 10.0).abs() > 0
    assert torch.equal(changed, kept["intervened"])


def test_what_an_environment_would_give_is_named_where_it_is_missing():
    protect, pixels = SafetyFilter(load("pendulum")), torch.zeros(3, 6, 64, 64, dtype=torch.uint8)
    with pytest.raises(ConfigError, match=r"expected \['prior'.*make_tensordict_primer\(\).*Monitor and Shield"):
        protect(TensorDict({"pixels": pixels, "action": torch.zeros(3, 1)}, [3]))


class Gym(gymnasium.Env):
    """The pendulum as an environment of gymnasium, its two frames in one of three layouts."""

    def __init__(self, layout: str = "channels first", high: float = 10.0, size: int = 64) -> None:
        self.inner = PendulumEnv(batch_size=[1], seed=0, image_size=size)
        self.inner.initial_set = self.inner.safe_set
        self.layout = layout
        shape = {"channels first": (6, size, size), "channels last": (size, size, 6), "stacked": (2, size, size, 3)}[layout]
        self.observation_space = Box(0, 255, shape, np.uint8)
        self.action_space = Box(-high, high, (1,), np.float32)

    def _shown(self, data: Any) -> np.ndarray:
        pixels = data["pixels"][0]
        if self.layout == "stacked":
            pixels = pixels.unflatten(0, (2, 3)).permute(0, 2, 3, 1)
        return (pixels.permute(1, 2, 0) if self.layout == "channels last" else pixels).numpy()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        if seed is not None:
            self.inner.set_seed(seed)
        self.data = self.inner.reset()
        return self._shown(self.data), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        self.data = self.inner.step(self.data.set("action", torch.as_tensor(action)[None]))["next"]
        return self._shown(self.data), 0.0, False, False, {"unsafe": bool(self.data["region"] == 2)}


@pytest.mark.parametrize("layout", ["channels first", "channels last", "stacked"])
def test_the_wrapper_keeps_a_policy_that_knows_nothing_of_it_out_of_u(layout):
    env = SafetyWrapper(Gym(layout), load("pendulum"))
    _, info = env.reset(seed=3)
    assert set(info["safety"]) == {"barrier", "inside", "applies"}
    assert info["safety"]["applies"]
    for _ in range(60):
        _, _, _, _, info = env.step(env.action_space.high)
        assert not info["unsafe"]
    told = info["safety"]
    assert set(told) == {"intervened", "wanted", "taken", "deviation", "margin", "barrier", "inside", "applies"}
    assert env.statistics["steps"] == 60
    assert 0 < env.statistics["interventions"] <= 60


def test_layouts_show_the_same():
    seen = []
    for layout in ("channels first", "channels last", "stacked"):
        env = SafetyWrapper(Gym(layout), load("pendulum"))
        seen.append(env.reset(seed=3)[1]["safety"]["barrier"])
    assert seen[0] == seen[1] == seen[2]


def test_the_wrapper_is_the_filter():
    agent = load("pendulum")
    wrapped, protect = SafetyWrapper(Gym(), agent), SafetyFilter(agent)
    observation, _ = wrapped.reset(seed=5)
    prior, begins = torch.zeros(1, 3), torch.ones(1, 1, dtype=torch.bool)
    for _ in range(20):
        pixels = torch.from_numpy(np.array(observation))[None]
        batch = TensorDict(pixels=pixels, prior=prior, is_init=begins, action=torch.full((1, 1), 4.0), batch_size=[1])
        out = protect(batch)
        observation, _, _, _, info = wrapped.step(np.array([4.0], np.float32))
        assert np.allclose(info["safety"]["taken"], out["action"][0].numpy(), atol=1e-5)
        prior, begins = out["next", "prior"], torch.zeros(1, 1, dtype=torch.bool)


def test_the_memory_of_the_filter_is_held_in_the_set():
    agent = line()
    begins, seen = torch.zeros(1, 1, dtype=torch.bool), torch.tensor([[0.9]])
    batch = TensorDict(pixels=seen, prior=torch.tensor([[0.45]]), is_init=begins, action=torch.zeros(1, 1), batch_size=[1])
    assert float(SafetyFilter(agent, margin=0.02)(batch)["latent"]) == pytest.approx(0.46)


def test_the_wrapper_says_when_the_proof_no_longer_applies():
    wrapped = SafetyWrapper(Gym(), load("pendulum"))
    wrapped.agent.encoder = Shown([-1.0, 0.0, -1.0, -1.0])
    wrapped.agent.barrier = nn.Sequential(nn.Linear(3, 1))
    with torch.no_grad():
        wrapped.agent.barrier[0].weight.zero_()[0, 0] = 1.0
        wrapped.agent.barrier[0].bias.fill_(0.5)
    told = [wrapped.reset(seed=0)[1]["safety"]]
    told += [wrapped.step(np.zeros(1, np.float32))[4]["safety"] for _ in range(2)]
    # The memory stays in the set, but one picture did not lie there.
    assert [t["inside"] for t in told] == [True, True, True]
    assert [t["applies"] for t in told] == [True, False, False]
    assert wrapped.reset(seed=0)[1]["safety"]["applies"]


@pytest.mark.parametrize(("margin", "applies"), [(None, True), (0.0, False), (1.0, True)])
def test_with_a_margin_below_the_proved_one_no_proof_applies(margin, applies):
    wrapped = SafetyWrapper(Gym(), load("pendulum"), margin=margin)
    assert wrapped.reset(seed=5)[1]["safety"]["inside"]
    assert wrapped.reset(seed=5)[1]["safety"]["applies"] == applies


@pytest.mark.parametrize(
    ("env", "error", "words"),
    [
        (lambda: Gym(high=2.0), ConfigError, "RescaleAction"),
        (lambda: Gym(size=32), ShapeError, "64"),
        (lambda: gymnasium.make("CartPole-v1"), ConfigError, "two RGB frames"),
    ],
)
def test_environments_that_do_not_fit_are_refused(env, error, words):
    with pytest.raises(error, match=words):
        SafetyWrapper(env(), load("pendulum"))


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(ConfigError, match="reset"):
        SafetyWrapper(Gym(), load("pendulum")).step(np.zeros(1))


class Short(Gym):
    """Episodes of some steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps, self.t = steps, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.t = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        self.t += 1
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, self.t >= self.steps, info


def vectorised(lengths: tuple[int, ...], mode: AutoresetMode, **options: Any) -> SafetyVectorWrapper:
    return SafetyVectorWrapper(SyncVectorEnv([partial(Short, k) for k in lengths], autoreset_mode=mode), load("pendulum"), **options)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, pytest.param(AutoresetMode.SAME_STEP, marks=pytest.mark.slow)])
def test_rows_of_a_vectorised_environment_are_protected_as_single_ones(mode):
    """Row by row what the wrapper of single environments does, resets included; at a level at which the nearest action does not hang on
    the last digits of the barrier, which a batch rounds otherwise."""
    lengths, pushes, level = (7, 100), np.full((2, 1), 10.0, np.float32), {"level": -0.05}
    envs, singles = vectorised(lengths, mode, **level), [SafetyWrapper(Short(k), load("pendulum"), **level) for k in lengths]
    _, info = envs.reset(seed=3)
    told = [one.reset(seed=3 + k)[1]["safety"] for k, one in enumerate(singles)]
    ended, steps = [False, False], 0
    for t in range(20):
        for k in (0, 1):
            assert info["safety"]["barrier"][k] == pytest.approx(told[k]["barrier"], abs=1e-4), (t, k)
        _, _, _, truncated, info = envs.step(pushes)
        for k, one in enumerate(singles):
            if ended[k] and mode == AutoresetMode.NEXT_STEP:
                told[k], ended[k] = one.reset()[1]["safety"], False
                assert not info["safety"]["intervened"][k]
                assert info["safety"]["deviation"][k] == 0.0
                continue
            _, _, _, ended[k], one_info = one.step(pushes[k])
            told[k], steps = one_info["safety"], steps + 1
            assert bool(truncated[k]) == ended[k]
            assert info["safety"]["taken"][k] == pytest.approx(told[k]["taken"], abs=1e-3)
            if ended[k] and mode == AutoresetMode.SAME_STEP:
                told[k], ended[k] = one.reset()[1]["safety"], False
    assert envs.statistics["steps"] == steps
    assert envs.statistics["interventions"] == sum(one.statistics["interventions"] for one in singles) > 0


def test_rows_whose_proof_is_lost_get_it_back_with_their_next_episode():
    envs = vectorised((3, 3), AutoresetMode.SAME_STEP)
    envs.reset(seed=0)
    envs._guard._controller._applies[:] = False
    assert [envs.step(np.zeros((2, 1), np.float32))[4]["safety"]["applies"].tolist() for _ in range(3)][1:] == [[False] * 2, [True] * 2]
    envs._guard._controller._applies[:] = False
    assert envs.reset(seed=0)[1]["safety"]["applies"].all()


def test_vectorised_environments_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="autoreset_mode=Disabled"):
        vectorised((3,), AutoresetMode.DISABLED)
    with pytest.raises(ConfigError, match="SafetyVectorWrapper"):
        SafetyWrapper(SyncVectorEnv([Gym]), load("pendulum"))
    with pytest.raises(ConfigError, match="two RGB frames"):
        SafetyVectorWrapper(gymnasium.make_vec("CartPole-v1", num_envs=1), load("pendulum"))
    envs = vectorised((3,), AutoresetMode.NEXT_STEP)
    with pytest.raises(ConfigError, match="before the first step"):
        envs.step(np.zeros((1, 1)))
    with pytest.raises(ConfigError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array([True])})


def test_an_environment_that_begins_episodes_without_a_word_is_refused():
    env = gymnasium.wrappers.Autoreset(Gym())
    with pytest.raises(ConfigError, match="put Autoreset around"):
        SafetyWrapper(gymnasium.wrappers.TimeLimit(env, 10), load("pendulum"))


def test_the_filter_takes_an_agent_of_float64():
    protect = SafetyFilter(load("pendulum").double())
    given = TensorDict({
        "pixels": torch.zeros(2, 6, 64, 64, dtype=torch.uint8), "action": torch.ones(2, 1), "prior": torch.zeros(2, 3, dtype=torch.float64),
        "is_init": torch.ones(2, 1, dtype=torch.bool),
    }, [2])  # fmt: skip
    assert protect(given)["latent"].dtype == torch.float64
