"""A transition store that keeps every frame once, and a sampler that knows the region labels."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers import RoundRobinWriter, Sampler, Storage, TensorDictReplayBuffer

from torchrl_sspl.data.augmentation import Augmentation
from torchrl_sspl.data.frames import FrameBank
from torchrl_sspl.data.labels import Labels
from torchrl_sspl.errors import CheckpointError, ConfigError, DTypeError, EmptyRegionError, ShapeError
from torchrl_sspl.seeds import _INDICES
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE

_FILE = "transitions.safetensors"
_BLOCK = 32768  # frames per block of the bank, at most
_GIVEN = ("user_action", "residual")  # that a batch may have
_NAMES = {UNLABELLED: "unlabelled", SAFE: "safe", UNSAFE: "unsafe"}


class _Behind(RoundRobinWriter):
    """Writes behind what the store holds, however that came in."""

    def add(self, data: Any) -> Any:
        self._cursor = self._storage._cursor
        if getattr(data, "batch_size", torch.Size(())).numel() != 1:  # a collector that writes by itself writes step after step of all environments
            raise ShapeError(
                f"store: expected one transition at a time, received {tuple(data.batch_size)}; frames are shared along an episode: extend the buffer "
                "by what a collector yields, buffer.extend(data.reshape(-1)), in place of Collector(replay_buffer=buffer)"
            )
        return super().add(data)

    def extend(self, data: Any) -> Any:
        self._cursor = self._storage._cursor
        return super().extend(data)


class _Buffer(TensorDictReplayBuffer):
    """Takes batches of any shape, time last, and of TorchRL's padded trajectories what is no padding."""

    def extend(self, tensordicts: Any, **options: Any) -> Tensor:
        return super().extend(without_padding(tensordicts).reshape(-1), **options)


class TransitionStore(Storage):
    """Labelled transitions (o_t, u_t, o_{t+1}) in which every frame is stored once, as uint8.

    An observation is a pair of frames, so a transition refers to three, (t-1, t, t+1), and the next one of the same
    episode shares two of them. The store recognises consecutive transitions by comparing their pixels, keeps triples of
    frame numbers, and hands out the three frames together, so that each can be encoded once. It is a TorchRL
    ``Storage``; ``replay_buffer`` puts it into a ``TensorDictReplayBuffer`` with stratified batches, for TorchRL's
    trainers and collectors. It also works by itself (``extend``, ``sample``). When it is full, the oldest transitions
    make room.

    What is read from a tensordict that is written: ``"pixels"`` and ``("next", "pixels")`` uint8 ``(n, 6, H, W)``,
    ``"action"``, ``"region"``, and where present ``("next", "region")``, ``("next", "terminated")``, ``"user_action"``, ``"residual"`` and, with
    ``keep_state``, ``"state"`` and ``("next", "state")``. What comes out: ``"frames"`` uint8 ``(n, 3, 3, H, W)`` (time,
    RGB, height, width), ``"action"``, ``"region"`` int64 ``(n, 1)``, ``("next", "region")``, ``("next",
    "terminated")``; with ``pixel_views`` also ``"pixels"`` and ``("next", "pixels")``, which share the memory of
    ``"frames"``; with ``keep_state`` also ``("info", "state")`` and ``("info", "next_state")``, which no loss reads.
    ``recorded`` counts all transitions that ever came in, ``given`` the labels of each code among them.

    Args:
        capacity: largest number of transitions.
        pixel_views: hand out the observations beside the frames.
        keep_state: keep the true states, for evaluation.
        augmentation: changes frames before they are stored; transitions that follow each other share a camera.
        labels: which labels are stored, at most so many of all that is ever recorded, and none of ``("next", "region")``.

    Raises ConfigError if ``capacity`` is not a positive integer. Source: the data sets D, S, U of the paper (Section
    IV): S and U are the labelled part of D, not copies.

    Example:
        >>> video = torch.randint(255, (12, 3, 8, 8), dtype=torch.uint8)
        >>> pixels = torch.cat([video[:-1], video[1:]], dim=1)
        >>> store = TransitionStore(100)
        >>> _ = store.extend(TensorDict({
        ...     "pixels": pixels[:-1], "next": {"pixels": pixels[1:]}, "action": torch.zeros(10, 1),
        ...     "region": torch.ones(10, 1, dtype=torch.int64)}, [10]))
        >>> len(store), store.n_frames
        (10, 12)
        >>> store.sample(4, generator=torch.Generator().manual_seed(0))["frames"].shape
        torch.Size([4, 3, 3, 8, 8])
    """

    def __init__(
        self, capacity: int, *, pixel_views: bool = False, keep_state: bool = False, augmentation: Augmentation | None = None,
        labels: Labels | None = None,
    ) -> None:  # fmt: skip
        if not isinstance(capacity, int) or capacity < 1:
            raise ConfigError(f"capacity: expected an integer >= 1, received {capacity!r}.")
        super().__init__(capacity)
        self.pixel_views, self.keep_state, self.augmentation, self.labels = pixel_views, keep_state, augmentation, labels
        self.device = torch.device("cpu")
        self._len = self._cursor = 0
        self._bank = FrameBank(1)
        self._columns: dict[str, Tensor] = {}
        self._by_region: dict[int | None, Tensor] = {}
        self._empty()

    def __len__(self) -> int:
        return self._len

    @property
    def n_frames(self) -> int:
        """Number of different frames held."""
        return int((self._bank._uses > 0).sum())

    @property
    def memory_bytes(self) -> int:
        """Bytes of all tensors that the store has allocated."""
        columns = sum(c.numel() * c.element_size() for c in self._columns.values())
        return self._bank.memory_bytes + columns

    @property
    def region(self) -> Tensor:
        """Region codes ``(n,)`` of the observations in which the transitions start."""
        return self._columns.get("region", torch.zeros(0, 1, dtype=torch.int64))[: self._len, 0]

    def indices(self, region: int | None = None) -> Tensor:
        """Positions of the transitions that start in a region (a code of ``sets``), or of all.

        Raises EmptyRegionError if there is none.
        """
        if region not in self._by_region:
            found = torch.arange(self._len) if region is None else (self.region == region).nonzero().squeeze(1)
            self._by_region[region] = found
        found = self._by_region[region]
        if not found.numel():
            what = "transitions" if region is None else f"{_NAMES[region]} transitions"
            raise EmptyRegionError(
                f"store: expected {what}, found none among {self._len}; collect some, for example "
                "with collect_random(env, n, region=...)."
            )
        return found

    def extend(self, data: TensorDictBase) -> Tensor:
        """Add transitions ``(*batch,)``, time last; the oldest make room. Returns positions."""
        data = without_padding(data).reshape(-1)
        index = (self._cursor + torch.arange(data.shape[0])) % self.max_size
        self.set(index, data)
        for sampler in self._attached_entities:
            sampler.mark_update(index)
        return index

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Write transitions at given positions (the interface of ``Storage``)."""
        index = _positions(cursor, self.max_size)
        data = data.reshape(-1)
        n = data.shape[0]
        if index.numel() != n:
            raise ShapeError(f"store: expected {index.numel()} transitions, received {n}.")
        if index.numel() > self.max_size:  # a ring that is passed more than once keeps the last round
            index, data = index[-self.max_size :], data[-self.max_size :]
        if not index.numel():
            return
        now, then = _observations(data)
        columns = self._rows(data)
        # What is drawn hangs on all that came in before: positions in a ring come again, and their draws would, too.
        before = self.recorded % _INDICES
        self.recorded += n
        if self.labels is not None:
            if self.labels.choose:  # which of the others are asked for is decided later, on latents
                columns["answer"] = self.labels.answers(columns["region"], before)
            columns["region"] = self.labels(columns["region"], self.given, before)
            if self.labels.infers:  # elsewhere nothing is said by a picture that has no label
                columns["drawn"] = self.labels.left(columns["region"], self.given)
            columns["next_region"] = torch.zeros_like(columns["next_region"])
        for code in self.given:
            self.given[code] += int((columns["region"] == code).sum())
        if set_cursor:
            self._set_last_cursor(index)
            self._cursor = int(index[-1] + 1) % self.max_size
        # Free what is overwritten first, so that its slots can serve again.
        triples = self._columns.get("triple")
        if triples is not None:
            old = triples[index]
            self._bank.hold(old[old[:, 0] >= 0], -1)
        columns["triple"] = self._store_frames(now, then, before)
        for name, rows in columns.items():
            if name not in self._columns:
                self._columns[name] = _column(name, rows, self.max_size)
            self._columns[name][index] = rows
        self._len = max(self._len, int(index.max()) + 1)
        self._by_region = {}
        self._bump_mutation_revision()

    def _store_frames(self, now: Tensor, then: Tensor, before: int) -> Tensor:
        """Store the frames of transitions, each once; returns the frame numbers ``(n, 3)``."""
        linked = torch.zeros(now.shape[0], dtype=torch.bool)
        linked[1:] = (now[1:] == then[:-1]).flatten(1).all(1)
        # A transition that continues the one before it brings one new frame, any other three: the frames of
        # every transition are the last three slots taken so far.
        end = torch.where(linked, 1, 3).cumsum(0)
        slots = self._bank.reserve(int(end[-1]), now.shape[2:])
        triple = slots[end[:, None] + torch.tensor([-3, -2, -1])]
        first = triple[~linked]
        places = torch.cat([first[:, 0], first[:, 1], triple[:, 2]])
        frames = torch.cat([now[~linked, :3], now[~linked, 3:], then[:, 3:]])
        if self.augmentation is not None:
            episode = (~linked).cumsum(0) - 1
            frames = self.augmentation(frames, torch.cat([episode[~linked], episode[~linked], episode]), before)
        self._bank.write(places, frames)
        self._bank.hold(triple, +1)
        return triple

    def _rows(self, data: TensorDictBase) -> dict[str, Tensor]:
        n = data.shape[0]
        action, region = data.get("action", None), data.get("region", None)
        if action is None or region is None:
            raise ShapeError("store: expected 'action' and 'region', found not both.")
        rows = {"action": action.reshape(n, -1), "region": region.reshape(n, 1)}
        rows["next_region"] = data.get(("next", "region"), torch.zeros_like(region)).reshape(n, 1)
        for name in _GIVEN:
            value, held = data.get(name, None), name in self._columns
            if self._len and held != (value is not None):  # there is no value for those that lack it
                lacks = f"expected {name!r}, as in the transitions that it holds, found none"
                brings = f"expected no {name!r}, as in the transitions that it holds, received one"
                raise ShapeError(f"store: {lacks if held else brings}; give it with all transitions or with none.")
            if value is not None:
                rows[name] = value.reshape(n, -1)
        ended = data.get(("next", "terminated"), None)
        rows["terminated"] = torch.zeros(n, 1, dtype=torch.bool) if ended is None else ended.reshape(n, 1)
        if self.keep_state:
            state, following = data.get("state", None), data.get(("next", "state"), None)
            if state is None or following is None:
                raise ShapeError("store: keep_state needs 'state' and ('next', 'state'), found not both.")
            rows["state"], rows["next_state"] = state.reshape(n, -1), following.reshape(n, -1)
        return {name: value.detach().cpu() for name, value in rows.items()}

    def get(self, index: Any) -> TensorDict:
        """Transitions at given positions: an integer, a slice, an integer tensor, or a mask over all of them."""
        single = isinstance(index, int) or (isinstance(index, Tensor) and index.ndim == 0)
        rows = _positions(index, self._len)
        if rows.numel() and (int(rows.max()) >= self._len or int(rows.min()) < 0):
            raise ConfigError(f"store: expected positions below {self._len}, received {int(rows.max())}.")
        column = {name: values[rows] for name, values in self._columns.items()}
        frames = self._bank.read(column["triple"].reshape(-1))
        frames = frames.reshape(rows.numel(), 3, *frames.shape[1:])
        following = {"region": column["next_region"], "terminated": column["terminated"]}
        out = TensorDict(
            {"frames": frames, "action": column["action"], "region": column["region"], "next": following},
            batch_size=[rows.numel()],
        )
        if self.pixel_views:
            out["pixels"], out["next", "pixels"] = frames[:, :2].flatten(1, 2), frames[:, 1:].flatten(1, 2)
        out.update({name: values for name, values in column.items() if name in (*_GIVEN, "answer", "drawn")})
        if self.keep_state:
            out["info"] = TensorDict(
                {"state": column["state"], "next_state": column["next_state"]}, batch_size=[rows.numel()]
            )
        return out[0] if single else out

    def sample(
        self, n: int, generator: torch.Generator | None = None, *, safe: float = 0.0, unsafe: float = 0.0
    ) -> TensorDict:
        """Draw n transitions with replacement: shares ``safe`` and ``unsafe`` from S and U, the rest from D.

        Raises EmptyRegionError if a set from which a positive share is wanted is empty.
        """
        return self.get(_stratified(self, n, safe, unsafe, generator))

    def replay_buffer(
        self, batch_size: int, *, safe: float = 0.125, unsafe: float = 0.125, **buffer: Any
    ) -> TensorDictReplayBuffer:
        """This store as a TorchRL replay buffer with stratified batches, see ``RegionSampler``.

        Further arguments are those of ``TensorDictReplayBuffer``, such as ``prefetch`` or ``generator``; a ``sampler`` of
        TorchRL, such as ``PrioritizedSampler``, takes the place of the stratified one.
        """
        buffer = {"sampler": RegionSampler(safe, unsafe), "writer": _Behind(), "collate_fn": _as_it_is, **buffer}
        return _Buffer(storage=self, batch_size=batch_size, **buffer)

    def state_dict(self) -> dict[str, Any]:
        """All transitions and frames as tensors, frames without gaps; see ``load_state_dict``."""
        state: dict[str, Any] = {name: values[: self._len].clone() for name, values in self._columns.items()}
        state["_meta"] = {"len": self._len, "cursor": self._cursor, "keep_state": self.keep_state,
            "recorded": self.recorded, "given": [self.given[SAFE], self.given[UNSAFE]]}  # fmt: skip
        if self._len:
            used, number = state["triple"].unique(return_inverse=True)
            state["frames"], state["triple"] = self._bank.read(used), number
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned, bit for bit; the capacity must suffice.

        Raises CheckpointError, and nothing is changed, for anything that it cannot have returned.
        """
        meta: Any = state_dict.get("_meta")
        if wrong := _wrong(meta, {k: v for k, v in state_dict.items() if k != "_meta"}):
            raise CheckpointError(f"store: expected what state_dict() returns, found {wrong}; record it again.")
        if meta["len"] > self.max_size:
            raise CheckpointError(f"store: expected at most {self.max_size} transitions, found {meta['len']}.")
        self._empty()
        self.keep_state = meta["keep_state"]
        self._len, self._cursor = meta["len"], meta["cursor"] % self.max_size
        if self._len < self.max_size and meta["cursor"] < self._len:  # that one was full, this one is not: the oldest come first
            state_dict = {k: v if k in ("_meta", "frames") else v.roll(-meta["cursor"], 0) for k, v in state_dict.items()}
            self._cursor = self._len
        if self._len:
            slots = self._bank.reserve(state_dict["frames"].shape[0], state_dict["frames"].shape[2:])
            self._bank.write(slots, state_dict["frames"])
            for name, values in state_dict.items():
                if name not in ("_meta", "frames"):
                    self._columns[name] = _column(name, values, self.max_size)
                    self._columns[name][: self._len] = slots[values] if name == "triple" else values
            self._bank.hold(self._columns["triple"][: self._len], +1)
        # An earlier version did not count what was overwritten.
        self.recorded = meta.get("recorded", self._len)
        held = [int((self.region == code).sum()) for code in (SAFE, UNSAFE)]
        self.given = dict(zip((SAFE, UNSAFE), meta.get("given", held), strict=True))
        self._bump_mutation_revision()

    def dumps(self, path: str | os.PathLike[str]) -> None:
        """Write the store into a folder (one safetensors file)."""
        from safetensors.torch import save_file

        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        state = self.state_dict()
        meta = json.dumps({**state.pop("_meta"), "capacity": self.max_size})
        partial = folder / (_FILE + ".partial")
        save_file({k: v.contiguous() for k, v in state.items()}, partial, metadata={"store": meta})
        partial.replace(folder / _FILE)  # a file that is there is complete

    def loads(self, path: str | os.PathLike[str]) -> None:
        """Read what ``dumps`` wrote.

        Raises CheckpointError if there is no such file, or it cannot be read, or it does not fit the capacity.
        """
        state, meta = _read(Path(path))
        self.load_state_dict({**state, "_meta": meta})

    @classmethod
    def from_folder(
        cls, path: str | os.PathLike[str], *, pixel_views: bool = False, augmentation: Augmentation | None = None, labels: Labels | None = None
    ) -> TransitionStore:
        """A store with the content and the capacity of the one that was saved in a folder.

        The file does not hold what is to become of transitions that come later: ``augmentation`` and ``labels`` say it again.
        """
        state, meta = _read(Path(path))
        capacity = meta.get("capacity") if isinstance(meta, dict) else None
        if type(capacity) is not int or capacity < 1:
            raise CheckpointError(f"store: expected a capacity >= 1 in {path}, found {capacity!r:.40}; record it again.")
        store = cls(capacity, pixel_views=pixel_views, augmentation=augmentation, labels=labels)
        store.load_state_dict({**state, "_meta": meta})
        return store

    def _empty(self) -> None:
        self._len, self._cursor = 0, 0
        self._columns, self._by_region = {}, {}
        self.recorded, self.given = 0, {SAFE: 0, UNSAFE: 0}
        self._bank = FrameBank(min(_BLOCK, self.max_size + self.max_size // 4 + 64))

    def contains(self, item: Any) -> Tensor:
        """Whether positions hold a transition."""
        index = torch.as_tensor(item)
        return (index >= 0) & (index < self._len)


def without_padding(data: TensorDictBase) -> TensorDictBase:
    """Without what TorchRL fills trajectories of unequal length up with (``split_trajs``), which are no transitions. Source: none."""
    mask = data.get(("collector", "mask"), None)
    return data if mask is None else data[mask.reshape(data.batch_size)]


def continues(store: TransitionStore, index: Tensor) -> Tensor:
    """Whether transitions at positions ``(k,)`` go on where the one before them in the store ends, ``(k,)`` bool.

    Source: none.
    """
    triple = store._columns["triple"]
    return (triple[index, :2] == triple[index - 1, 1:]).all(1) & (index > 0)


def _column(name: str, rows: Tensor, size: int) -> Tensor:
    """Room for a column of the store whose rows are like these."""
    return torch.full((size, *rows.shape[1:]), -1 if name == "triple" else 0, dtype=rows.dtype)


def _positions(index: Any, size: int) -> Tensor:
    if isinstance(index, slice):
        return torch.arange(*index.indices(size))
    index = torch.as_tensor(index)
    if index.dtype == torch.bool:
        if index.shape != (size,):
            raise ShapeError(f"store: expected a mask {(size,)}, received {tuple(index.shape)}; give it one value for every transition.")
        index = index.nonzero()
    return index.to(torch.int64).reshape(-1).cpu()


def _observations(data: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Present and next observation of transitions, after a look at them."""
    pixels, following = data.get("pixels", None), data.get(("next", "pixels"), None)
    if pixels is None or following is None:
        raise ShapeError("store: expected 'pixels' and ('next', 'pixels'), found not both.")
    for name, value in (("pixels", pixels), ("next pixels", following)):
        if value.dtype != torch.uint8:
            raise DTypeError(f"{name}: expected uint8, received {value.dtype}; keep frames unconverted.")
        if value.ndim != 4 or value.shape[1] != 6:
            raise ShapeError(f"{name}: expected shape (n, 6, H, W), received {tuple(value.shape)}.")
    if not torch.equal(pixels[:, 3:], following[:, :3]):
        raise ConfigError(
            "store: expected ('next', 'pixels') to begin with the second frame of 'pixels', received "
            "other frames; stack two consecutive frames."
        )
    return pixels.cpu(), following.cpu()


def _read(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    from safetensors import SafetensorError, safe_open

    file = folder / _FILE
    try:
        with safe_open(file, framework="pt") as opened:
            meta = json.loads(opened.metadata()["store"])
            return {name: opened.get_tensor(name) for name in opened.keys()}, meta  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"store: expected a transition store in {folder}, cannot read {file.name} ({error}); "
            "pass the folder that was given to dumps()."
        ) from error


def _wrong(meta: Any, columns: dict[str, Any]) -> str:
    """What of a state no store can have returned; empty where nothing is."""
    kinds = {"len": int, "cursor": int, "keep_state": bool}
    if not isinstance(meta, dict) or any(type(meta.get(k)) is not kind for k, kind in kinds.items()):
        return f"'_meta' {meta!r:.60}"
    n, given = meta["len"], meta.get("given", [0, 0])
    counts = [meta.get("recorded", 0), *(given if isinstance(given, list) else ())]
    if len(counts) != 3 or any(type(count) is not int or count < 0 for count in counts):
        return f"counts {counts!r:.60} of transitions and labels"
    if n < 0 or meta["cursor"] < 0:
        return f"{n} transitions and the cursor at {meta['cursor']}"
    needed = {"frames", "triple", "action", "region", "next_region", "terminated"} if n else set()
    needed |= {"state", "next_state"} if n and meta["keep_state"] else set()
    if lacking := needed - set(columns):
        return f"no {', '.join(sorted(lacking))}"
    for name, value in columns.items():
        if name != "frames" and value.shape[:1] != (n,):
            return f"'{name}' {tuple(value.shape)} for {n} transitions"
        if not bool(value.isfinite().all()):
            return f"numbers in '{name}' that are not finite"
    if not n:
        return ""
    frames, triple = columns["frames"], columns["triple"]
    if frames.dtype != torch.uint8 or frames.ndim != 4 or frames.shape[1] != 3:
        return f"frames {frames.dtype} {tuple(frames.shape)}"
    if triple.dtype != torch.int64 or triple.shape != (n, 3) or int(triple.min()) < 0 or int(triple.max()) >= len(frames):
        return f"'triple' {triple.dtype} {tuple(triple.shape)} with numbers of other frames than the {len(frames)} there are"
    for name in {"region", "next_region", "answer"} & set(columns):
        if columns[name].shape != (n, 1) or not set(columns[name].unique().tolist()) <= set(_NAMES):
            return f"'{name}' {tuple(columns[name].shape)} with codes other than {sorted(_NAMES)}"
    return ""


def _stratified(
    store: TransitionStore, n: int, safe: float = 0.0, unsafe: float = 0.0, generator: torch.Generator | None = None
) -> Tensor:
    """Positions of n transitions: ``round(n safe)`` from S, ``round(n unsafe)`` from U, the rest from D.

    Raises ConfigError if a share is negative, or they add up to more than 1; EmptyRegionError if a set from which a
    positive share is wanted is empty.
    """
    if safe < 0 or unsafe < 0 or safe + unsafe > 1:
        raise ConfigError(f"shares: expected safe, unsafe >= 0 with a sum <= 1, received {safe}, {unsafe}.")
    n_safe, n_unsafe = round(n * safe), round(n * unsafe)
    parts = []
    for region, count in ((None, n - n_safe - n_unsafe), (SAFE, n_safe), (UNSAFE, n_unsafe)):
        if count > 0:
            members = store.indices(region)
            parts.append(members[torch.randint(members.numel(), (count,), generator=generator)])
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.int64)


def _as_it_is(batch: TensorDict) -> TensorDict:
    return batch


class RegionSampler(Sampler):
    """Draws fixed shares of each batch from the labelled sets S and U, the rest from all transitions D.

    Raises ConfigError if a share is negative, they add up to more than 1, or the storage is not a ``TransitionStore``.
    Source: Algorithm 1 of the paper (samples of S, U and D). Deviation: none.

    Example:
        >>> TransitionStore(1000).replay_buffer(batch_size=64, safe=0.25, unsafe=0.25).sampler.safe
        0.25
    """

    def __init__(self, safe: float = 0.125, unsafe: float = 0.125) -> None:
        if safe < 0 or unsafe < 0 or safe + unsafe > 1:
            raise ConfigError(f"shares: expected safe, unsafe >= 0 with a sum <= 1, received {safe}, {unsafe}.")
        self.safe, self.unsafe = safe, unsafe

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Positions ``(batch_size,)`` and an empty info."""
        if not isinstance(storage, TransitionStore):
            raise ConfigError(f"storage: expected a TransitionStore, received {type(storage).__name__}.")
        return _stratified(storage, batch_size, self.safe, self.unsafe, self._rng), {}

    def state_dict(self) -> dict[str, Any]:
        """The shares."""
        return {"safe": self.safe, "unsafe": self.unsafe}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned."""
        self.safe, self.unsafe = state_dict["safe"], state_dict["unsafe"]

    def dumps(self, path: str | os.PathLike[str]) -> None:
        """Write the shares into a folder."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "sampler.json").write_text(json.dumps(self.state_dict()))

    def loads(self, path: str | os.PathLike[str]) -> None:
        """Read what ``dumps`` wrote."""
        self.load_state_dict(json.loads((Path(path) / "sampler.json").read_text()))

    def _empty(self) -> None:
        """Nothing to forget."""


__all__ = ["RegionSampler", "TransitionStore", "continues", "without_padding"]
