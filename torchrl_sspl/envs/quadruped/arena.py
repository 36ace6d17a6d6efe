"""The arena of the walking robot: what its car and the robot in full physics have in common."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_sspl.envs.base import check_positive, numbers
from torchrl_sspl.errors import ConfigError

_SHAPES = ("square", "disc")


def half_view(arena_half_size: float) -> float:
    """Distance from the middle of a frame to its edge, on the ground, in m: robots a little outside the arena are still seen."""
    return 1.2 * float(arena_half_size)


def check_shape(obstacle_shape: str) -> None:
    """Raise a ConfigError unless there is such an obstacle."""
    if obstacle_shape not in _SHAPES:
        raise ConfigError(f"obstacle_shape: expected one of {list(_SHAPES)}, received {obstacle_shape!r}.")


def check_arena(
    *, arena_half_size: float, safe_half_size: float, unsafe_half_size: float, obstacle_shape: str, obstacle_half_size: float,
    obstacle_centre: Sequence[float],
) -> tuple[float, float]:  # fmt: skip
    """The obstacle's centre (x, y); a ConfigError unless it lies in the arena, and shape and sizes leave room for S, U and obstacle."""
    check_shape(obstacle_shape)
    check_positive(
        arena_half_size=arena_half_size, safe_half_size=safe_half_size, unsafe_half_size=unsafe_half_size,
        obstacle_half_size=obstacle_half_size,
    )  # fmt: skip
    centre = numbers(obstacle_centre)
    if len(centre) != 2 or not all(abs(v) <= arena_half_size for v in centre):
        raise ConfigError(f"obstacle_centre: expected (x, y) inside the arena, received {obstacle_centre!r}.")
    if not obstacle_half_size <= unsafe_half_size < safe_half_size < arena_half_size + max(map(abs, centre)):
        raise ConfigError(
            "sizes: expected obstacle <= unsafe < safe < arena, received "
            f"{obstacle_half_size}, {unsafe_half_size}, {safe_half_size}, {arena_half_size}."
        )
    return centre[0], centre[1]
