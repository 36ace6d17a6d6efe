"""Mutants of what is done to pictures: augmentation, and the place of the camera."""

from __future__ import annotations

AUGMENT, STORE, MOMENTS = "torchrl_sspl/data/augmentation.py", "torchrl_sspl/data/store.py", "torchrl_sspl/modules/moments.py"
KNOWN, SELECT = "torchrl_sspl/evaluation/known.py", "torchrl_sspl/trainers/selection.py"

CHANGED, PLACED = "tests/data/test_augmentation.py", "tests/modules/test_moments.py"
SELECTED = "tests/trainers/test_selection.py"

MUTANTS = [
    (AUGMENT, "chosen[:, 0] * self.noise * drawn[:, 0]", "chosen[:, 0] * self.noise", CHANGED),
    (AUGMENT, "1.0 + chosen[:, 1] * self.brightness * (2.0 * drawn[:, 1] - 1.0)", "1.0 + chosen[:, 1] * self.brightness * drawn[:, 1]", CHANGED),
    (AUGMENT, "self.shift * (2.0 * drawn[:, 2:] - 1.0)", "self.shift * (2.0 * drawn[:, 2:3] - 1.0)", CHANGED),
    (AUGMENT, "by[..., None] / 32.0", "by[..., None] / 64.0", CHANGED),
    (AUGMENT, "torch.rand(cameras, 3, generator=draw) < self.share", "torch.rand(cameras, 3, generator=draw) <= 1.0", CHANGED),
    (AUGMENT, "spawn(self.seed, \"pictures\", position)", "spawn(self.seed, \"pictures\", 0)", CHANGED),
    (AUGMENT, "seen.round_().clamp_(0, 255)", "seen.round_()", CHANGED),
    (STORE, "episode = (~linked).cumsum(0) - 1", "episode = torch.arange(len(linked))", CHANGED),
    (MOMENTS, "(like.flatten(1) @ self.places.T + self.still).argmax(1)", "(like.flatten(1) @ self.places.T).argmax(1)", PLACED),
    (MOMENTS, "        super()._load_from_state_dict(*arguments)\n        self._look()", "        super()._load_from_state_dict(*arguments)", PLACED),
    (KNOWN, "torch.arange(len(part)).repeat(2)", "torch.arange(2 * len(part))", CHANGED),
    (SELECT, "int(changed.sum()), 0.0", "int(changed.sum()), 1e-3 * len(changed)", SELECTED),
    (SELECT, "changed = held_out.changed <= level + s.guard", "changed = held_out.changed <= level", SELECTED),
    (SELECT, "changed = encode_states(agent, env, in_unsafe, augmentation=cameras)", "changed = encode_states(agent, env, in_unsafe)", SELECTED),
]
