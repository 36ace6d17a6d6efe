"""What a run has produced, as text and as ``metrics.json``."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any

from torchrl_sspl.certification.certificate import Certificate
from torchrl_sspl.configs.schema import Config
from torchrl_sspl.envs.system import System, bounded
from torchrl_sspl.evaluation.measurements import Evaluation, Measurement
from torchrl_sspl.files import write
from torchrl_sspl.modules.agent import Agent

METRICS_FILE = "metrics.json"
EVALUATION_FILE = "evaluation.json"
SCHEMA = 1
_SENTENCES = {
    "unsafe_called_safe": "episodes with an observation of U at B <= 0",
    "safe_called_unsafe": "episodes with an observation of S at B > 0",
    "starts_inside": "resets with B <= 0",
    "touch_unsafe": "episodes from B <= 0 that touch U, under the policy",
    "leave": "episodes from B <= 0 that leave it, under the policy",
    "policy_touch_unsafe": "episodes that touch U, under the policy, wherever they start",
    "random_touch_unsafe": "episodes that touch U, under random actions",
}
_SENTENCES_KNOWN = {
    "unsafe_called_safe": "U with B <= 0",
    "safe_called_unsafe": "S with B > 0",
    "volume_over_kernel": "volume of {B <= 0} over the true kernel",
    "false_safe": "{B <= 0} outside the true kernel",
    "safe_rollouts_touch_unsafe": "episodes from {B <= 0} that touch U",
    "safe_rollouts_leave": "episodes from {B <= 0} that leave it",
    "unsafe_rollouts_return": "recoverable starts in U that come back",
    "labelled_safe_rollouts_touch_unsafe": "episodes from S that touch U",
}


@dataclass
class Outcome:
    """What a run has produced.

    Attributes:
        directory: where everything lies.
        agent: the agent.
        config: of the run.
        system: names and requirements of the system; None where it is known by being run only.
        evaluations: by name: "own" on the system's own frames, further ones by their renderer.
        certificate: what is proved, measured and assumed; None where the agent came without one.
        seconds: of the training; None where nothing was trained.
        checks: held-out checks of every round.
        stop_reason: why the training ended.
        budget: what it was trained on, counted: transitions, labels of S and U, resets.
        warnings: what went wrong, and what to do about it.
        advice: what to try where it is not certified.
        report: the page, or None where matplotlib is missing.
    """

    directory: Path
    agent: Agent
    config: Config
    system: System | None
    evaluations: dict[str, Evaluation]
    certificate: Certificate | None = None
    seconds: float | None = None
    checks: list[Any] = field(default_factory=list)
    stop_reason: str = ""
    budget: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)
    report: Path | None = None

    @property
    def evaluation(self) -> Evaluation:
        """That on the system's own frames."""
        return self.evaluations["own"]

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Label, value, must, aim and verdict of every requirement, on own and on other frames; as the report says it."""
        table = []
        for where, evaluation in self.evaluations.items():
            for r in () if self.system is None else self.system.requirements:
                m = evaluation.measurements.get(r.name)
                if m is None and where != "own":
                    continue
                label = r.label if where == "own" else f"{r.label}, {where} frames"
                bound = None if m is None else m.upper if r.sense == "<=" else m.lower
                limits = f"{r.sense} {r.must:g}", f"{r.sense} {r.aim:g}"
                table.append((label, _value(m, bound), *limits, bounded(r, r.verdict(evaluation), m)))
        return table

    def measured(self) -> list[str]:
        """The main measurements as sentences, with counts and exact 95 % bounds."""
        lines = []
        for name, label in (_SENTENCES if self.system is None else _SENTENCES_KNOWN).items():
            m = self.evaluation.measurements.get(name)
            if m is None:
                continue
            value = "not measured" if m.value is None else f"{m.value:.2%} ({m.events} of {m.n})"
            bounds = "" if m.lower is None or m.upper is None else f", 95 % bounds {m.lower:.2%} to {m.upper:.2%}"
            lines.append(f"{label}: {value}{bounds}")
        return lines

    def summary(self) -> str:
        """The requirements (or the main measurements), the certificate's verdicts, warnings and advice as text."""
        rows = self.rows()
        width = max((len(r[0]) for r in rows), default=0)
        lines = [f"{label:<{width}}  {value:<38} must {must:<9} {verdict}" for label, value, must, _, verdict in rows]
        lines = lines or self.measured()
        layers = {} if self.certificate is None else self.certificate.layers
        lines += [f"certificate, {layer.name} layer: {layer.verdict}" for layer in layers.values()]
        if self.seconds is not None:
            lines.append(f"training: {self.seconds:.0f} s" + (f"; {self.stop_reason}" if self.stop_reason else ""))
        lines += [f"warning: {text}" for text in self.warnings] + [f"to try: {text}" for text in self.advice]
        return "\n".join(lines)


def _value(m: Measurement | None, bound: float | None) -> str:
    if m is None or m.value is None:
        return "not measured"
    text = f"{m.value:.4g}"
    if m.n is None:
        return text
    return f"{text} (n = {m.n:,}" + (")" if bound is None else f", 95 % bound {bound:.2g})")


def write_metrics(outcome: Outcome) -> Path:
    """Write ``metrics.json``, and the same beside an agent just trained; returns the file. Source: none.

    Measurements (by evaluation, then by name), requirements and verdicts, checks, budget, warnings and configuration.
    No path of this machine is written: of the configuration, ``out_dir`` is left out, and of paths only the last part
    stays, in the configuration with a hash that tells two of them apart.
    """
    from torchrl_sspl import __version__

    proof = outcome.agent.description.get("lipschitz", {})
    config = {k: v for k, v in outcome.config.to_dict().items() if k != "out_dir"}
    verdicts = {row[0]: row[-1] for row in outcome.rows()}
    body: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "seed": outcome.config.seed,
        "preset": outcome.config.preset,
        "training_seconds": outcome.seconds,
        "stop_reason": outcome.stop_reason,
        "budget": outcome.budget,
        "lipschitz": {k: v for k, v in proof.items() if k != "multipliers"} | {"proved": outcome.agent.lipschitz_proved},
        "checks": [asdict(c) if is_dataclass(c) else dict(c) for c in outcome.checks],  # type: ignore[arg-type]
        "measurements": {name: evaluation.to_dict() for name, evaluation in outcome.evaluations.items()},
        "verdicts": verdicts,
        "requirements": [asdict(r) for r in ([] if outcome.system is None else outcome.system.requirements)],
        "warnings": outcome.warnings,
        "config": config,
    }
    text = json.dumps(without_paths(finite(body)), indent=1, sort_keys=True, allow_nan=False) + "\n"
    path = Path(outcome.directory) / METRICS_FILE
    write(path, text)
    beside = path.parent / "agent"
    if outcome.seconds is not None and beside.is_dir():
        write(beside / EVALUATION_FILE, text)
    return path


def finite(value: Any) -> Any:
    """None for what JSON has no number for. Source: none.

    Example:
        >>> finite({"a": [1.0, float("nan")]})
        {'a': [1.0, None]}
    """
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def without_paths(value: Any, told: bool = False) -> Any:
    """Of absolute paths, wherever they stand alone, the last part; in a configuration, with what tells two of them apart."""
    if isinstance(value, Mapping):
        return {k: without_paths(v, told or k == "config") for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_paths(v, told) for v in value]
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).is_absolute()):
        return Path(value).name + (f"-{hashlib.sha256(str(value).encode()).hexdigest()[:8]}" if told else "")
    return value
