"""Environments of gymnasium side by side, here or spread over processes: what each shows, and how it is labelled."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import sys
import time
import traceback
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, Pipe
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_sspl.errors import ConfigError, MissingDependencyError, OverlapError, SSPLError, WorkerError
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE

Predicate = Callable[[Any, Mapping[str, Any]], Any]
Picture = NDArray[np.uint8]
_PATIENCE = 5.0  # seconds for a process to end by itself


@dataclass(frozen=True)
class Moment:
    """What an environment shows after a reset or a step."""

    picture: Picture  # (size, size, 3)
    region: int
    state: NDArray[np.float32] | None
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False


class Game:
    """One environment of gymnasium, its pictures averaged down, its observations labelled."""

    def __init__(
        self, make: Callable[[], Any], *, safe: Predicate, unsafe: Predicate, image_size: int, ignore_termination: bool
    ) -> None:
        self.env, self.image_size, self.ignore_termination = make(), image_size, ignore_termination
        self._predicates = (("safe", safe), ("unsafe", unsafe))
        shape: tuple[int, ...] = getattr(self.env.observation_space, "shape", None) or ()
        self._observes_vector = len(shape) == 1
        self._observes_pictures = len(shape) == 3 and shape[2] == 3 and self.env.observation_space.dtype == np.uint8
        if not self._observes_pictures and getattr(self.env, "render_mode", None) != "rgb_array":
            raise ConfigError(
                f"make: expected an environment with render_mode='rgb_array', received "
                f"{getattr(self.env, 'render_mode', None)!r}; give it to gymnasium.make."
            )

    def spaces(self) -> tuple[Any, Any]:
        """Of observations and of actions."""
        return self.env.observation_space, self.env.action_space

    def reset(self, seed: int, options: dict[str, Any] | None, settling: Sequence[Any] = ()) -> tuple[Picture, Moment]:
        """Begins an episode, which goes on with some actions; the picture of the reset, and what is shown after these."""
        observation, info = self.env.reset(seed=seed, options=options)
        before = self._picture(observation)
        if settling:
            return before, self.step(settling)
        return before, self._moment(before, observation, info)

    def step(self, actions: Sequence[Any]) -> Moment:
        """As many steps as there are actions; rewards add up, the end of an episode ends them too."""
        total = 0.0
        for action in actions:
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            terminated = bool(terminated) and not self.ignore_termination
            if terminated or truncated:
                break
        return self._moment(self._picture(observation), observation, info, total, terminated, bool(truncated))

    def close(self) -> None:
        """Close the environment of gymnasium."""
        self.env.close()

    def _moment(self, picture: Picture, observation: Any, info: Mapping[str, Any], *rest: Any) -> Moment:
        state = np.array(observation, np.float32) if self._observes_vector else None
        return Moment(picture, self._region(observation, info), state, *rest)

    def _picture(self, observation: Any) -> Picture:
        picture = np.asarray(observation if self._observes_pictures else self._drawn())
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise ConfigError(
                f"render: expected a uint8 picture (height, width, 3), received {picture.dtype} {picture.shape}."
            )
        if picture.shape[:2] == (self.image_size, self.image_size):
            return picture.copy()  # some renderers draw into the same memory again
        return area_averaged(picture, self.image_size)

    def _drawn(self) -> Any:
        from gymnasium.error import DependencyNotInstalled

        try:
            return self.env.render()
        except DependencyNotInstalled as error:
            raise MissingDependencyError(
                f"expected what gymnasium draws with, found less: {error}; `pip install 'torchrl-sspl[viz]'` brings what its classic "
                "control needs"
            ) from error

    def _region(self, observation: Any, info: Mapping[str, Any]) -> int:
        safe, unsafe = (self._judged(name, predicate, observation, info) for name, predicate in self._predicates)
        if safe and unsafe:
            raise OverlapError(
                "safe and unsafe: expected predicates that exclude each other, received a state that both claim; "
                "make one of them smaller."
            )
        return SAFE if safe else UNSAFE if unsafe else UNLABELLED

    @staticmethod
    def _judged(name: str, predicate: Predicate, observation: Any, info: Mapping[str, Any]) -> bool:
        try:
            return bool(predicate(observation, info))
        except (TypeError, ValueError, LookupError, AttributeError) as error:
            raise ConfigError(
                f"{name}: expected a predicate (observation, info) -> bool of one state, received "
                f"{type(error).__name__}: {error}"
            ) from error


class Games:
    """Games in this process."""

    def __init__(self, build: Callable[[], Game], count: int) -> None:
        self.games = [build() for _ in range(count)]

    def ask(self, method: str, arguments: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """What a method of some games returns, by their numbers."""
        return _asked(self.games, method, arguments)

    def close(self) -> None:
        """Close all of them."""
        for game in self.games:
            game.close()


def _asked(games: Any, method: str, arguments: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
    return {k: getattr(games[k], method)(*given) for k, given in arguments.items()}


class SpreadGames:
    """Games spread over processes that are forked off this one; each of them answers as it would here.

    Forked, as nothing has to be pickled then and a child starts at once. A child keeps nothing of its parent: open files
    would hold locks and pipes of one that has died. Signals are for the parent to handle; a child ends with it.

    Raises what a game raises, WorkerError where a process has ended, and ConfigError where there is no fork. Source: none.
    """

    def __init__(self, build: Callable[[], Game], count: int, workers: int) -> None:
        if not hasattr(os, "fork"):
            raise ConfigError(f"workers: expected 1 on a system without fork, received {workers}.")
        self._owner = [k % workers for k in range(count)]
        self._pipes: list[Connection] = []
        self.processes: list[int] = []
        self.close = weakref.finalize(self, _end, self._pipes, self.processes, os.getpid())
        self._asked = 0
        sys.stdout.flush()  # or a child prints it once more
        for worker in range(workers):
            here, there = Pipe()
            # Signals are blocked in the child for ever, and in the parent for as long as a child could take them for its own.
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
            try:
                with warnings.catch_warnings():  # of threads, none of which a child needs
                    warnings.simplefilter("ignore", DeprecationWarning)
                    pid = os.fork()
                if pid == 0:
                    _serve(there, build, [k for k in range(count) if self._owner[k] == worker])
            except OSError as error:
                self.close()
                raise WorkerError(f"workers: expected {workers} processes, received {error} for number {worker + 1}; lower it") from error
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            there.close()
            self._pipes.append(here)
            self.processes.append(pid)
        self._answers(range(workers))  # none, or why there are no games

    def ask(self, method: str, arguments: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """See :meth:`Games.ask`; the processes work side by side."""
        self._asked += 1
        asked = sorted({self._owner[k] for k in arguments})
        for worker in asked:
            try:
                self._pipes[worker].send((self._asked, method, {k: v for k, v in arguments.items() if self._owner[k] == worker}))
            except OSError:
                raise self._ended() from None
        found = self._answers(asked)
        return {k: found[k] for k in arguments}

    def _answers(self, asked: Sequence[int]) -> dict[int, Any]:
        found, errors = dict[int, Any](), list[Exception]()
        for worker in asked:
            number = -1
            while number != self._asked:  # an interrupted question leaves its answers behind
                try:
                    number, answer = self._pipes[worker].recv()
                except (EOFError, OSError):
                    raise self._ended() from None
            if isinstance(answer, Exception):
                errors.append(answer)
            else:
                found |= answer
        if errors:
            raise errors[0]
        return found

    def _ended(self) -> WorkerError:
        self.close()
        return WorkerError(
            "workers: expected processes that step the environments, received the end of one; what it printed says why, "
            "and workers=1 steps them in this process."
        )


def _end(pipes: list[Connection], processes: list[int], parent: int) -> None:
    """Lets the processes end; those that do not are killed."""
    if os.getpid() != parent:  # a fork of the parent has a copy of it
        return
    for pipe in pipes:
        with suppress(OSError):
            pipe.send(None)
        pipe.close()
    until = time.monotonic() + _PATIENCE
    for pid in processes:
        while os.waitpid(pid, os.WNOHANG)[0] == 0:
            if time.monotonic() > until:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.002)


def _serve(pipe: Connection, build: Callable[[], Game], numbers: Sequence[int]) -> None:
    """What a child does until it is told to end, or its parent has ended. Never returns."""
    try:
        gc.freeze()  # what belongs to the parent is the parent's to close
        signal.set_wakeup_fd(-1)
        os.closerange(3, pipe.fileno())
        os.closerange(pipe.fileno() + 1, os.sysconf("SC_OPEN_MAX"))
        torch.set_num_threads(1)  # the parent's threads are not here
        games, answer = dict[int, Game](), _tried(lambda: {k: build() for k in numbers})
        if isinstance(answer, dict):
            games, answer = answer, {}
        question: Any = (0, "", {})
        while question is not None:
            pipe.send((question[0], answer))
            question = pipe.recv()
            if question is not None:
                _, method, arguments = question
                answer = _tried(partial(_asked, games, method, arguments))
        for game in games.values():
            game.close()
    except (EOFError, OSError):
        pass  # the parent has ended
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(BaseException):  # whatever happens, it must not go on as its parent
            sys.stdout.flush()
        os._exit(0)


def _tried(job: Callable[[], dict[int, Any]]) -> dict[int, Any] | Exception:
    """What a job returns or raises; an error that cannot be sent is one that says the same."""
    try:
        return job()
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return SSPLError(f"{type(error).__name__}: {error}")
        return error


def area_averaged(picture: Picture, size: int) -> Picture:
    """A uint8 picture ``(h, w, 3)`` as ``(size, size, 3)``: bit for bit torch's mode "area", rounded, and faster."""
    turned = picture.strides[0] < picture.strides[1]  # pygame's pictures lie in memory column by column
    first, n = _summed(picture.transpose(1, 0, 2) if turned else picture, size)
    second, m = _summed(first.transpose(1, 0, 2), size)
    high, wide = (m, n) if turned else (n, m)
    mean = (second if turned else second.transpose(1, 0, 2)).astype(np.float32) / high[:, None, None] / wide[:, None]
    return (mean + np.float32(0.5)).astype(np.uint8)


def _summed(values: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums over ``size`` bins of the first axis, which may share a row, and how many rows each has (float32)."""
    n, bins = len(values), np.arange(size)
    first, last = bins * n // size, -(-(bins + 1) * n // size)
    counts = last - first
    small = values.dtype == np.uint8 and counts.max() <= 256  # 16 bits hold the sum
    sums = np.empty((size, *values.shape[1:]), np.uint16 if small else np.uint32)
    for k in range(size):
        np.add.reduce(values[first[k] : last[k]], axis=0, dtype=sums.dtype, out=sums[k])
    return sums, counts.astype(np.float32)


__all__ = ["Game", "Games", "Moment", "SpreadGames", "area_averaged"]
