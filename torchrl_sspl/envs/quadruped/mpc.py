"""Convex model-predictive control of the ground forces of a walking robot."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from torchrl_sspl.envs.quadruped.gait import GRAVITY
from torchrl_sspl.envs.quadruped.kinematics import Array, Mask, skew
from torchrl_sspl.errors import MissingDependencyError, NonFiniteError, SolverError

Solver = Callable[[Array, Array, Array, Array, Array], tuple[Array, int]]

HORIZON, STEP = 10, 0.03  # number of steps, and their length in s
_ROOT_WEIGHTS = np.sqrt([2.0, 2.0, 15.0, 0.0, 0.0, 80.0, 0.05, 0.05, 0.3, 1.0, 1.0, 0.5])  # of the diagonal of Q
_EFFORT = 1e-5
_FRICTION = 0.6
_LOW, _HIGH = 2.0, 160.0  # N, vertical force of a standing foot
_MAX_FAILURES = 10  # in a row
_TOLERANCE = 1e-4  # N; by how much forces may leave the friction pyramid


def solve_daqp(hessian: Array, gradient: Array, constraints: Array, lower: Array, upper: Array) -> tuple[Array, int]:
    """Quadratic program by daqp: the minimiser of ``x' H x / 2 + g' x`` with bounds on ``(x, A x)``.

    H is ``(n, n)`` and positive definite, g ``(n,)``, A ``(m, n)``, the bounds ``(n + m,)``, of x, then of A x. Returns
    x ``(n,)`` and daqp's exit flag; 1 means optimal. Raises MissingDependencyError without daqp. Source: Arnström et
    al. (2022), "A dual active-set solver for embedded quadratic programming".
    """
    try:
        import daqp
    except ImportError as error:
        raise MissingDependencyError(
            "The walking controller needs daqp, which is not installed; run `pip install 'torchrl-sspl[quadruped]'`."
        ) from error
    x, _, flag, _ = daqp.solve(hessian, gradient, constraints, upper, lower)
    return np.asarray(x), int(flag)


class ConvexMPC:
    r"""Ground forces that let a single rigid body follow a reference.

    State x = (roll, pitch, yaw; p; w; v) of the centre of mass, all in world axes turned so that the heading is
    now zero. With forces f_i at r_i from the centre of mass,

        d/dt (roll, pitch, yaw) = R_z(yaw)' w,   d/dt w = I^-1 sum_i r_i x f_i,   d/dt v = sum_i f_i / m - g e_z

    linearised about the yaw of the reference, and the forces of the horizon minimise

        sum_k |x_k - x_ref,k|^2_Q + effort |f|^2,   |f_x|, |f_y| <= friction f_z,   f_min <= f_z <= f_max

    for feet that stand; the others carry nothing and are no variables. The states are eliminated.

    Every solution is checked: the solver's status, finite numbers, and the constraints. Where a check fails the forces
    of the last good solution are held and ``failures`` counts it; many in a row raise a SolverError.

    ``mass`` in kg, ``inertia`` ``(3, 3)`` about the centre of mass in the base frame in kg m^2.

    Source: Di Carlo et al. (2018), "Dynamic locomotion in the MIT Cheetah 3 through convex model-predictive control".
    Deviation: forces enter positions and angles within their own step (second order in dt).

    Example:
        >>> mpc = ConvexMPC(12.0, np.diag([0.05, 0.15, 0.18]))
        >>> state = np.zeros(12)
        >>> state[5] = 0.28
        >>> corners = np.array([[0.18, -0.13, -0.28], [0.18, 0.13, -0.28], [-0.18, -0.13, -0.28], [-0.18, 0.13, -0.28]])
        >>> forces = mpc.solve(state, np.tile(state, (10, 1)), np.tile(corners, (10, 1, 1)), np.ones((10, 4), bool))
        >>> bool(abs(forces[:, 2].sum() - 12.0 * 9.81) < 1.0)  # standing still, it carries its weight
        True
    """

    def __init__(self, mass: float, inertia: Array, solver: Solver = solve_daqp) -> None:
        self.failures, self.solves, self._in_a_row = 0, 0, 0
        self._mass, self._inverse_inertia, self._solver = mass, np.linalg.inv(inertia), solver
        self._last = np.zeros((4, 3))
        # Steps that a force at step j has acted on x_k, k = j + 1, ..., horizon: velocities see all of them,
        # positions the mean time since.
        k, j = np.arange(1, HORIZON + 1)[:, None], np.arange(HORIZON)[None]
        self._acted = (k > j).astype(float)
        self._since = self._acted * (k - j - 0.5) * STEP
        self._times = np.arange(1, HORIZON + 1) * STEP

    def reset(self, forces: Array) -> None:
        """Start anew from forces ``(4, 3)`` in N that are held if the first solution fails."""
        self._last, self._in_a_row = forces.copy(), 0

    def solve(self, state: Array, reference: Array, feet: Array, contacts: Mask) -> Array:
        """Forces of the ground on the feet until the next call, ``(4, 3)`` in N; zero for feet that swing.

        The state is ``(12,)`` with yaw 0; the reference ``(HORIZON, 12)`` is for the ends of the steps; feet
        ``(HORIZON, 4, 3)`` in m, from the centre of mass of the reference, and contacts ``(HORIZON, 4)``, bool, for
        their beginnings. Raises NonFiniteError for NaN or infinity; SolverError without a valid solution many times in
        a row.
        """
        if not (np.isfinite(state).all() and np.isfinite(reference).all() and np.isfinite(feet).all()):
            raise NonFiniteError(
                "mpc: expected a finite state, reference and feet, received NaN or infinity; check the command and "
                "the simulation."
            )
        self.solves += 1
        if not contacts.any():
            return np.zeros((4, 3))
        hessian, gradient = self._build(state, reference, feet, contacts)
        constraints, lower, upper = _friction_pyramid(int(contacts.sum()))
        x, flag = self._solver(hessian, gradient, constraints, lower, upper)
        problem = _problem_with(x, flag, constraints, lower, upper)
        if problem is None:
            self._in_a_row = 0
            self._last = np.zeros((4, 3))
            standing = int(contacts[0].sum())
            self._last[contacts[0]] = x[: 3 * standing].reshape(standing, 3)
            return self._last.copy()
        self.failures += 1
        self._in_a_row += 1
        if self._in_a_row >= _MAX_FAILURES:
            raise SolverError(
                f"mpc: expected a solution at least once in {_MAX_FAILURES} attempts, received none; last: "
                f"{problem}. The robot has probably fallen; reset it."
            )
        return np.where(contacts[0][:, None], self._last, 0.0)

    def _build(self, state: Array, reference: Array, feet: Array, contacts: Mask) -> tuple[Array, Array]:
        """Hessian ``(n, n)`` and gradient ``(n,)`` of the program in the n = 3 x (standing feet) forces."""
        step, foot = np.nonzero(contacts)
        yaw = np.concatenate([[state[2]], reference[:-1, 2]])
        cos, sin = np.cos(yaw), np.sin(yaw)
        to_body = np.zeros((HORIZON, 3, 3))  # R_z(yaw)'
        to_body[:, 0, 0] = to_body[:, 1, 1] = cos
        to_body[:, 0, 1], to_body[:, 1, 0], to_body[:, 2, 2] = sin, -sin, 1.0
        # Change of the angular velocity per force, one (3, 3) for each variable foot.
        inverse = to_body.transpose(0, 2, 1) @ self._inverse_inertia @ to_body
        spin = STEP * inverse[step] @ skew(feet[step, foot])
        # Change of the angles at the end of step k per angular velocity gained in step j: turned[k] - middle[j].
        turned = np.cumsum(STEP * to_body, axis=0)
        middle = turned - 0.5 * STEP * to_body
        angles = (turned[:, None] - middle[None, step]) @ spin
        acted, since = self._acted[:, step], self._since[:, step]
        n = len(step)
        response = np.zeros((HORIZON, 12, n, 3))
        response[:, 0:3] = (angles * acted[..., None, None]).transpose(0, 2, 1, 3)
        response[:, 6:9] = acted[:, None, :, None] * spin.transpose(1, 0, 2)
        axes = np.arange(3)
        response[:, 3 + axes, :, axes] = since * STEP / self._mass
        response[:, 9 + axes, :, axes] = acted * STEP / self._mass
        weighted = (response * _ROOT_WEIGHTS[:, None, None]).reshape(12 * HORIZON, 3 * n)
        free = np.empty((HORIZON, 12))
        free[:, 0:3] = state[0:3] + turned @ state[6:9]
        free[:, 3:6] = state[3:6] + self._times[:, None] * state[9:12]
        free[:, 5] -= 0.5 * GRAVITY * self._times**2
        free[:, 6:9] = state[6:9]
        free[:, 9:12] = state[9:12]
        free[:, 11] -= GRAVITY * self._times
        hessian = 2.0 * (weighted.T @ weighted)
        hessian[np.diag_indices(3 * n)] += 2.0 * _EFFORT
        return hessian, 2.0 * weighted.T @ ((free - reference) * _ROOT_WEIGHTS).ravel()


def _problem_with(x: Array, flag: int, constraints: Array, lower: Array, upper: Array) -> str | None:
    if flag != 1:
        return f"solver status {flag}"
    if not np.isfinite(x).all():
        return "forces that are not finite"
    values = np.concatenate([x, constraints @ x])
    excess = float(np.maximum(values - upper, lower - values).max())
    return f"constraints missed by {excess:.1e} N" if excess > _TOLERANCE else None


@functools.lru_cache(maxsize=64)
def _friction_pyramid(feet: int) -> tuple[Array, Array, Array]:
    """Constraint rows ``(4 feet, 3 feet)`` and bounds of ``(forces, rows)`` for a number of standing feet."""
    side = [[1.0, 0.0, -_FRICTION], [-1.0, 0.0, -_FRICTION], [0.0, 1.0, -_FRICTION], [0.0, -1.0, -_FRICTION]]
    reach = _FRICTION * _HIGH  # implied by the pyramid; finite bounds keep the solver's scaling sane
    lower = np.concatenate([np.tile([-reach, -reach, _LOW], feet), np.full(4 * feet, -1e30)])
    upper = np.concatenate([np.tile([reach, reach, _HIGH], feet), np.zeros(4 * feet)])
    return np.kron(np.eye(feet), np.array(side)), lower, upper
