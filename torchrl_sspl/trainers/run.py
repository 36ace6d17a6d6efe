"""One run from configuration to report: train, evaluate, write numbers, figures, video and page."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from torchrl_sspl.certification.certificate import Certificate
from torchrl_sspl.certification.ground_truth import viability_kernel
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import MissingDependencyError
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.trainers.certify import CERTIFICATE_FILE, certify
from torchrl_sspl.trainers.config import EvaluationConfig, TrainingConfig
from torchrl_sspl.trainers.evaluation import Draw, Evaluation, evaluate
from torchrl_sspl.trainers.paper import PaperTraining
from torchrl_sspl.trainers.pipeline import SafePolicyTraining, TrainingResult
from torchrl_sspl.trainers.requirements import Requirement

METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"


@dataclass
class RunOutcome:
    """What a run produced.

    Attributes:
        directory: where everything lies.
        training: the training's result.
        evaluation: measurements on the environment's own frames.
        foreign: measurements on frames of another renderer, or None.
        certificate: what is proved, measured and assumed about the agent.
        requirements: table that the evaluation is judged by.
        report: the page, or None where matplotlib is missing.
    """

    directory: Path
    training: TrainingResult
    evaluation: Evaluation
    foreign: Evaluation | None
    certificate: Certificate
    requirements: Sequence[Requirement]
    report: Path | None

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Label, value, must, aim and verdict of every requirement, on own and on foreign frames."""
        table = []
        for evaluation, where in ((self.evaluation, ""), (self.foreign, ", foreign frames")):
            if evaluation is None:
                continue
            for r in self.requirements:
                m = evaluation.measurements.get(r.name)
                value = "not measured" if m is None or m.value is None else f"{m.value:.4g}"
                if m is not None and m.n is not None and m.value is not None:
                    bound = m.upper if r.sense == "<=" else m.lower
                    value += f" (n = {m.n:,}" + (")" if bound is None else f", 95 % bound {bound:.2g})")
                table.append((r.label + where, value, f"{r.sense} {r.must:g}", f"{r.sense} {r.aim:g}", r.verdict(evaluation)))
        return table

    def summary(self) -> str:
        """The table as text."""
        rows = self.rows()
        width = max(len(r[0]) for r in rows)
        lines = [f"{label:<{width}}  {value:<38} must {must:<9} {verdict}" for label, value, must, _, verdict in rows]
        lines += [f"certificate, {layer.name} layer: {layer.verdict}" for layer in self.certificate.layers.values()]
        return "\n".join([*lines, f"training: {self.training.seconds:.0f} s; {self.training.stop_reason}"])


def train(
    config: TrainingConfig,
    make_env: Callable[[list[int], int], SafetyEnv],
    *,
    resume: bool = True,
    logger: Any = None,
) -> TrainingResult:
    """Train an agent as the configuration's preset says.

    Args:
        config: everything that determines the training.
        make_env: ``(batch_size, seed) -> environment``.
        resume: continue from the checkpoint in ``config.out_dir`` if there is one.
        logger: TorchRL logger that gets the numbers of ``log.jsonl`` too.

    Returns:
        The agent with the checks of all rounds.

    Source: paper Algorithm 1.
    """
    kind = PaperTraining if config.preset == "paper" else SafePolicyTraining
    training = kind(config, make_env, resume=resume)
    training.logger = logger
    return training.run()


def run(
    config: TrainingConfig,
    make_env: Callable[[list[int], int], SafetyEnv],
    *,
    title: str,
    requirements: Sequence[Requirement] = (),
    foreign: Callable[[SafetyEnv], Draw] | None = None,
    axes: tuple[str, str] = ("x0", "x1"),
    action: str = "action",
    logger: Any = None,
) -> RunOutcome:
    """Train, evaluate and report; everything lands in ``config.out_dir``.

    Args:
        config: everything that determines the run.
        make_env: ``(batch_size, seed) -> environment``.
        title: title of the report.
        requirements: table that the evaluation is judged by.
        foreign: environment -> renderer ``(n, state_dim) -> (n, 3, H, W)`` other than its own, to evaluate on too.
        axes: names and units of the two state coordinates that figures show.
        action: name and unit of the action.
        logger: TorchRL logger that gets the numbers of ``log.jsonl`` too.

    Returns:
        The outcome; ``metrics.json``, ``figures/``, ``report.html`` and ``agent/`` (with ``certificate.json``) are on disk.

    Source: none.
    """
    directory = Path(config.out_dir)
    training = train(config, make_env, logger=logger)
    env = make_env([1], config.seed)
    own, other = assess(training.agent, env, config.evaluation, foreign, progress=config.progress)
    certificate = certify_run(training.agent, env, config)
    outcome = RunOutcome(directory, training, own, other, certificate, requirements, None)
    write_metrics(outcome, config)
    try:
        from torchrl_sspl.viz.run import write_run_report
    except MissingDependencyError as error:
        tqdm.write(f"no figures and no report: {error}")
        return outcome
    outcome.report = write_run_report(outcome, config, env, title=title, axes=axes, action=action)
    return outcome


def certify_run(agent: Agent, env: SafetyEnv, config: TrainingConfig) -> Certificate:
    """Issue the certificate of a run's agent and keep it beside the agent.

    Args:
        agent: the trained agent.
        env: the system that it was trained on.
        config: of the run.

    Returns:
        The certificate.

    Source: none.
    """
    directory = Path(config.out_dir)
    certificate = certify(
        agent,
        env,
        name=directory.name,
        episodes=config.evaluation.certificate_episodes,
        horizon=config.evaluation.horizon,
        progress=config.progress,
    )
    certificate.save(directory / "agent" / CERTIFICATE_FILE)
    return certificate


def assess(
    agent: Agent,
    env: SafetyEnv,
    config: EvaluationConfig,
    foreign: Callable[[SafetyEnv], Draw] | None = None,
    *,
    progress: bool = False,
) -> tuple[Evaluation, Evaluation | None]:
    """Evaluate an agent on the environment's own frames and on another renderer's.

    Args:
        agent: frozen agent.
        env: the true system.
        config: sizes and seed.
        foreign: see :func:`run`.
        progress: show progress bars.

    Returns:
        Both evaluations; the second is None without a foreign renderer, or where what it needs is not installed.

    Source: none.
    """
    kernel = viability_kernel(env, resolution=config.kernel_grid)
    own = evaluate(agent, env, config, kernel=kernel, progress=progress)
    other = None
    if foreign is not None and config.gymnasium_rollouts:
        try:
            draw = foreign(env)
            draw(torch.zeros(1, env.state_dim))
            other = evaluate(
                agent, env, config, kernel=kernel, draw=draw, rollouts=config.gymnasium_rollouts, progress=progress
            )
        except MissingDependencyError as error:
            tqdm.write(f"not evaluated on foreign frames: {error}")
    return own, other


def write_metrics(outcome: RunOutcome, config: TrainingConfig) -> Path:
    """Write ``metrics.json``: all measurements, the verdicts, the configuration."""
    from torchrl_sspl import __version__

    body: dict[str, Any] = {
        "version": __version__,
        "seed": config.seed,
        "preset": config.preset,
        "training_seconds": outcome.training.seconds,
        "stop_reason": outcome.training.stop_reason,
        "lipschitz": {k: v for k, v in outcome.training.agent.description.get("lipschitz", {}).items() if k != "multipliers"},
        "checks": [vars(c) for c in outcome.training.checks],
        "measurements": outcome.evaluation.to_dict(),
        "foreign_measurements": None if outcome.foreign is None else outcome.foreign.to_dict(),
        "verdicts": {label: verdict for label, _, _, _, verdict in outcome.rows()},
        "config": config.to_dict(),
    }
    path = outcome.directory / METRICS_FILE
    path.write_text(json.dumps(body, indent=1, sort_keys=True) + "\n")
    (outcome.directory / "agent" / "evaluation.json").write_text(json.dumps(body, indent=1, sort_keys=True) + "\n")
    return path
