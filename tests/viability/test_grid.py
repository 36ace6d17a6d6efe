"""Viability kernels and recoverable sets: known values, analytic cases, constructive checks."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, DTypeError, EmptyRegionError, NonFiniteError, ShapeError
from torchrl_sspl.sets import Box
from torchrl_sspl.viability.grid import Grid, recoverable_set, viability_kernel


@pytest.fixture(scope="module")
def pendulum():
    env = PendulumEnv()
    return env, viability_kernel(env, resolution=101)


@pytest.mark.parametrize(
    ("parameters", "known"),
    [
        (dict(), 0.842),
        (dict(integrator="explicit"), 0.837),
        (dict(integrator="explicit", max_torque=5.0), 0.349),
        (dict(integrator="explicit", max_torque=2.0), 0.140),
        (dict(length=2 / 3, mass=0.75, max_torque=2.0), 0.272),  # gymnasium's coefficients
    ],
)
def test_pendulum_kernels_have_their_known_volumes(parameters, known):
    """Reference values come from another grid; where the torque is weak they differ by a percentage point."""
    kernel = viability_kernel(PendulumEnv(**parameters), resolution=101)
    assert kernel.volume_fraction == pytest.approx(known, abs=0.012)
    assert kernel.change <= 1e-4


@pytest.mark.slow
def test_the_pendulum_kernel_converges_with_the_grid():
    volumes = [viability_kernel(PendulumEnv(), resolution=n).volume_fraction for n in (101, 201, 401)]
    assert max(volumes) - min(volumes) < 0.005


@pytest.mark.parametrize(("turn_rate", "known"), [(1.0, 0.060), (1.25, 0.051), (2.0, 0.034)])
def test_dubins_shells_around_a_square_have_their_known_volumes(turn_rate, known):
    kernel = _dubins(2.0, 0.1, turn_rate, lambda x: x[:, :2].abs().amax(1) - 0.7)
    assert 1 - kernel.volume_fraction == pytest.approx(known, abs=0.004)
    start = torch.cat([torch.rand(500, 2) * 0.8 + 1.2, torch.rand(500, 1) * 6 - 3], dim=1)
    assert kernel.contains(start).all()  # far from the square nothing is doomed
    assert kernel.contains(torch.tensor([[5.0, 0.0, 0.0]])).all()  # having left is safe


def test_the_dubins_shell_around_a_disc_has_its_known_volume():
    kernel = _dubins(1.1, 0.05, 1.25, lambda x: x[:, :2].norm(dim=1) - 0.5)
    assert 1 - kernel.volume_fraction == pytest.approx(0.082, abs=0.006)
    assert (kernel.value <= 0).float().mean() == pytest.approx(0.228, abs=0.01)


def _dubins(half_width, dt, turn_rate, margin):
    def dynamics(x, u):
        move = torch.stack([x[:, 2].cos(), x[:, 2].sin(), u[:, 0]], dim=1)
        return x + move * dt

    return viability_kernel(
        dynamics,
        low=[-half_width, -half_width, -math.pi],
        high=[half_width, half_width, math.pi],
        period=[None, None, 2 * math.pi],
        resolution=(61, 61, 48),
        margin=margin,
        actions=torch.linspace(-turn_rate, turn_rate, 5)[:, None],
        exit_is_safe=True,
    )


def test_a_double_integrator_kernel_has_its_analytic_border():
    """Braking from speed v takes v^2 / 2 of the way left; |x| <= 1, |u| <= 1, exact steps."""
    dt = 0.05

    def dynamics(x, u):
        return torch.cat([x[:, :1] + x[:, 1:] * dt + u * dt**2 / 2, x[:, 1:] + u * dt], dim=1)

    kernel = viability_kernel(
        dynamics,
        low=[-1.2, -2.0],
        high=[1.2, 2.0],
        resolution=161,
        margin=lambda x: 1 - x[:, 0].abs(),
        actions=torch.linspace(-1, 1, 9)[:, None],
    )
    speed = torch.linspace(0.2, 1.8, 9)
    border = 1 - speed**2 / 2
    assert kernel.contains(torch.stack([border - 0.04, speed], 1)).all()
    assert not kernel.contains(torch.stack([border + 0.04, speed], 1)).any()


def test_greedy_control_stays_inside_the_pendulum_kernel(pendulum):
    env, kernel = pendulum
    generator = torch.Generator().manual_seed(0)
    state = Box([-math.pi / 2, -1.5], [math.pi / 2, 1.5]).sample(1000, generator)
    inside = kernel.contains(state)
    stayed = _greedy(env, kernel, state, 60)
    assert (stayed & inside).sum() >= 0.997 * inside.sum()
    assert (stayed & ~inside).sum() <= 0.01 * len(state)


def _greedy(env, kernel, state, steps):
    actions = torch.linspace(-env.max_action, env.max_action, 21)[:, None]
    stayed = torch.ones(len(state), dtype=torch.bool)
    for _ in range(steps):
        after = env.dynamics(state.repeat_interleave(21, 0), actions.repeat(len(state), 1))
        best = kernel.interpolate(after).reshape(-1, 21).argmax(1)
        state = after.reshape(-1, 21, 2)[torch.arange(len(state)), best]
        stayed &= ~env.unsafe_set.contains(state)
    return stayed


def test_the_kernel_holds_S_and_no_state_of_U(pendulum):
    env, kernel = pendulum
    generator = torch.Generator().manual_seed(0)
    assert kernel.contains(env.safe_set.sample(2000, generator)).all()
    unsafe = env.unsafe_set.sample(2000, generator)
    clear = (unsafe[:, 0].abs() > math.pi / 2 + 0.05) | (unsafe[:, 1].abs() > 1.55)
    assert not kernel.contains(unsafe[clear]).any()


def test_the_kernel_wraps_angles_and_excludes_what_has_left(pendulum):
    _, kernel = pendulum
    state = torch.tensor([[0.2, 0.3], [-0.9, 1.0]])
    turned = state + torch.tensor([2 * math.pi, 0.0])
    torch.testing.assert_close(kernel.interpolate(state), kernel.interpolate(turned), atol=1e-4, rtol=0)
    assert not kernel.contains(torch.tensor([[0.0, 3.6], [0.0, float("nan")]])).any()


def test_a_stronger_motor_keeps_more_states_safe():
    weak, strong = (viability_kernel(PendulumEnv(max_torque=u), resolution=61) for u in (5.0, 10.0))
    assert weak.volume_fraction < strong.volume_fraction
    assert not ((weak.value > 0) & (strong.value <= 0)).any()


def test_interpolation_agrees_with_scipy():
    interpolate = pytest.importorskip("scipy.interpolate")
    grid = Grid([-1.0, 0.0, 2.0], [1.0, 3.0, 5.0], resolution=(5, 4, 7))
    value = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))
    state = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([2.0, 3.0, 3.0])
    state += torch.tensor([-1.0, 0.0, 2.0])
    index, inside, outside = grid.locate(state)
    expected = interpolate.interpn([a.numpy() for a in grid.axes], value.numpy(), state.numpy())
    torch.testing.assert_close(grid.gather(grid.pad(value), index, inside).double(), torch.as_tensor(expected))
    assert not outside.any()


def test_interpolation_across_the_seam_of_a_periodic_axis():
    grid = Grid([0.0], [4.0], resolution=4, period=[4.0])
    index, inside, outside = grid.locate(torch.tensor([[3.5], [-0.5], [7.5], [4.0]]))
    value = torch.tensor([0.0, 1.0, 2.0, 3.0])
    assert grid.gather(grid.pad(value), index, inside).tolist() == [1.5, 1.5, 1.5, 0.0]
    assert not outside.any()


def test_a_recoverable_set_counts_steps_and_contains_its_target():
    push = dict(actions=torch.tensor([[-0.1], [0.1]]))

    def walk(x, u):
        return x + u

    goal = viability_kernel(walk, low=[-1.0], high=[1.0], margin=lambda x: 0.2 - x[:, 0].abs(), **push)
    for steps in (0, 1, 3):
        found = recoverable_set(walk, goal, horizon=steps, **push)
        reach = 0.2 + 0.1 * steps
        assert found.contains(torch.tensor([[reach - 0.02], [0.02 - reach]])).all()
        assert not found.contains(torch.tensor([[reach + 0.02], [-0.02 - reach]])).any()
    everything = recoverable_set(walk, goal, **push)
    assert (everything.value > 0).all()


def test_the_strong_pendulum_recovers_from_everywhere_and_the_weak_one_does_not(pendulum):
    env, kernel = pendulum
    assert (recoverable_set(env, kernel).value > 0).float().mean() > 0.999
    weak = PendulumEnv(max_torque=2.0)
    target = viability_kernel(weak, resolution=81)
    share = (recoverable_set(weak, target).value > 0).float().mean()
    assert target.value.gt(0).float().mean() < share < 0.9


def test_a_kernel_under_errors_is_smaller_by_what_they_cost():
    """x' = 1.5 x + u + e with |u| <= 0.1 and |e| <= 0.05 is kept up to |x| = 0.1, half of what is kept without errors."""
    line = {"low": [-1.2], "high": [1.2], "resolution": 481, "margin": lambda x: 1 - x[:, 0].abs()}
    line["actions"] = torch.linspace(-0.1, 0.1, 5)[:, None]
    kernel = viability_kernel(lambda x, u: 1.5 * x + u, errors=torch.tensor([[-0.05], [0.0], [0.05]]), **line)
    assert kernel.contains(torch.tensor([[0.09], [-0.09], [0.11], [-0.11]])).tolist() == [True, True, False, False]
    none = viability_kernel(lambda x, u: 1.5 * x + u, errors=torch.zeros(1, 1), **line)
    assert torch.equal(none.value, viability_kernel(lambda x, u: 1.5 * x + u, **line).value)
    with pytest.raises(ShapeError, match=r"errors: expected shape \(j, 1\)"):
        viability_kernel(lambda x, u: 1.5 * x + u, errors=torch.zeros(3), **line)


def test_missing_and_bad_arguments_are_named():
    def still(x, u):
        return x

    good = dict(low=[-1.0], high=[1.0], margin=lambda x: 1 - x[:, 0].abs(), actions=torch.zeros(1, 1))
    with pytest.raises(ConfigError, match=r"without \['low', 'high', 'margin', 'actions'\]"):
        viability_kernel(still)
    with pytest.raises(ConfigError, match="saturation"):
        viability_kernel(still, saturation=0.0, **good)
    with pytest.raises(EmptyRegionError, match="holds nowhere"):
        viability_kernel(still, **{**good, "margin": lambda x: -torch.ones(len(x))})
    with pytest.raises(ShapeError, match=r"dynamics: expected shape \(201, 1\)"):
        viability_kernel(lambda x, u: x[:, :0], **good)
    with pytest.raises(NonFiniteError, match="NaN"):
        viability_kernel(lambda x, u: x * float("nan"), **good)
    with pytest.raises(ShapeError, match="margin"):
        viability_kernel(still, **{**good, "margin": lambda x: x})
    with pytest.raises(ShapeError, match="actions"):
        viability_kernel(still, **{**good, "actions": torch.zeros(3)})
    with pytest.raises(ConfigError, match="period"):
        Grid([0.0], [1.0], 5, [2.0])
    with pytest.raises(ConfigError, match="low < high"):
        Grid([0.0], [0.0], 5)
    with pytest.raises(ShapeError, match="one length"):
        Grid([0.0], [1.0, 2.0], 5)
    kernel = viability_kernel(still, resolution=5, **good)
    with pytest.raises(ShapeError, match=r"\(\*batch, 1\)"):
        kernel.contains(torch.zeros(3, 2))
    with pytest.raises(DTypeError, match="int64"):
        kernel.contains(torch.zeros(3, 1, dtype=torch.int64))
    with pytest.raises(ConfigError, match="horizon"):
        recoverable_set(still, kernel, horizon=-1, actions=torch.zeros(1, 1))


def test_a_kernel_that_has_not_converged_says_so():
    """x grows slowly whatever is done: nothing is viable, but the iteration comes from above."""
    drift = dict(dynamics=lambda x, u: x + 5e-4, low=[-1.0], high=[1.0], resolution=41, margin=lambda x: 0.9 - x[:, 0].abs(), actions=torch.zeros(1, 1))
    system = drift.pop("dynamics")
    with pytest.warns(UserWarning, match="the kernel still changes by .* after 20 iterations.* raise max_iterations"):
        kernel = viability_kernel(system, **drift, max_iterations=20)
    assert not kernel.converged
    assert kernel.volume_fraction > 0.5
    assert viability_kernel(PendulumEnv(), resolution=31).converged
