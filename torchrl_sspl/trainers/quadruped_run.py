"""One run of the quadruped from configuration to report: train or load, evaluate, let it walk, write everything."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchrl_sspl.certification.certificate import Certificate
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.errors import MissingDependencyError
from torchrl_sspl.modules.agent import Agent, agent_directory, load
from torchrl_sspl.trainers.certify import CERTIFICATE_FILE
from torchrl_sspl.trainers.config import TrainingConfig
from torchrl_sspl.trainers.evaluation import Evaluation, Measurement
from torchrl_sspl.trainers.pipeline import Check
from torchrl_sspl.trainers.quadruped import QUADRUPED, Walk, WalkConfig, evaluate_dubins, evaluate_walks, walk
from torchrl_sspl.trainers.run import METRICS_FILE, certify_run, train
from torchrl_sspl.viz.report import format_value

_PHYSICS = "torchrl_sspl.envs.quadruped.env"


@dataclass
class QuadrupedRun:
    """What a run does apart from the training.

    Attributes:
        agent: shipped agent or directory that is evaluated; None: train one.
        dubins: evaluate on the Dubins car against its true kernel.
        walks: size of the evaluation in full physics.
    """

    agent: str | None = None
    dubins: bool = True
    walks: WalkConfig = field(default_factory=WalkConfig)


@dataclass
class QuadrupedOutcome:
    """What a run produced.

    Attributes:
        directory: where everything lies.
        agent: the agent.
        evaluation: all measurements.
        certificate: what is proved, measured and assumed about the agent; None where it came without one.
        report: the page, or None where matplotlib is missing.
        notes: what was not done, and why.
    """

    directory: Path
    agent: Agent
    evaluation: Evaluation
    certificate: Certificate | None
    report: Path | None
    notes: list[str]

    def summary(self) -> str:
        """The table of requirements as text."""
        lines = []
        for r in QUADRUPED:
            m = self.evaluation.measurements.get(r.name)
            value = "not measured" if m is None or m.value is None else format_value(m.value, m.unit)
            n = f" (n = {m.n:,})" if m is not None and m.n else ""
            lines.append(f"{r.label:<52} {value + n:<26} must {r.sense} {r.must:<6g} {r.verdict(self.evaluation)}")
        if self.certificate is not None:
            lines += [f"certificate, {layer.name} layer: {layer.verdict}" for layer in self.certificate.layers.values()]
        return "\n".join([*lines, *self.notes])


def make_physics(model: DubinsEnv) -> Callable[[], Any]:
    """Maker of the robot's full-physics environment with the obstacle and the regions of a Dubins car.

    Args:
        model: the Dubins car.

    Returns:
        A function that makes the environment.

    Raises:
        MissingDependencyError: the simulator is not installed.
    """
    try:
        importlib.import_module("pybullet")
        kind = importlib.import_module(_PHYSICS).QuadrupedEnv
    except ImportError as error:
        raise MissingDependencyError(
            f"full physics: expected the simulator, received {error}; pip install 'torchrl-sspl[quadruped]'."
        ) from error
    return lambda: kind(
        max_yaw_rate=model.max_yaw_rate,
        speed=model.speed,
        dt=model.dt,
        arena_half_size=model.arena_half_size,
        safe_half_size=model.safe_half_size,
        unsafe_half_size=model.unsafe_half_size,
        image_size=model.image_size,
        obstacle_shape=model.obstacle_shape,
        obstacle_half_size=model.obstacle_half_size,
        obstacle_centre=model.obstacle_centre,
    )


def run_quadruped(
    config: TrainingConfig,
    make_env: Callable[[list[int], int], DubinsEnv],
    task: QuadrupedRun | None = None,
    *,
    make_training_env: Callable[[list[int], int], DubinsEnv] | None = None,
) -> QuadrupedOutcome:
    """Train or load an agent, evaluate it on the Dubins car and in full physics, and report.

    Args:
        config: everything that determines training and evaluation; ``out_dir`` is where all is written.
        make_env: ``(batch_size, seed) -> DubinsEnv`` without a yaw lag, on which the agent is evaluated.
        task: what is done apart from the training.
        make_training_env: the car on which the agent is trained and certified, which may turn late as the walking robot
            does; default ``make_env``.

    Returns:
        The outcome; ``metrics.json``, ``figures/`` and ``report.html`` are on disk, after a training ``agent/`` with its
        certificate too.

    Source: paper Section IV-B. Deviation: trained on the car that turns late, because the robot does.
    """
    task = task or QuadrupedRun()
    directory = Path(config.out_dir)
    directory.mkdir(parents=True, exist_ok=True)
    env = make_env([1], config.seed)
    evaluation, notes = Evaluation(), []
    certificate: Certificate | None
    if task.agent is None:
        make_training_env = make_training_env or make_env
        result = train(config, make_training_env)
        agent, checks = result.agent, list(result.checks)
        certificate = certify_run(agent, make_training_env([1], config.seed), config)
        notes.append(f"Training took {result.seconds:.0f} s. Why it ended: {result.stop_reason}.")
        evaluation.add(Measurement("training_minutes", result.seconds / 60, "min", note="wall clock, data included"))
    else:
        agent, checks = load(task.agent), []
        beside = agent_directory(task.agent) / CERTIFICATE_FILE
        certificate = Certificate.load(beside) if beside.is_file() else None
        notes += _trained_before(task.agent, evaluation, checks)
    if task.dubins:
        found = evaluate_dubins(agent, env, config.evaluation, progress=config.progress)
        evaluation.measurements |= found.measurements
        evaluation.arrays = found.arrays
    walks: list[Walk] = []
    film = None
    if task.walks.episodes:
        try:
            make = make_physics(env)
            found, walks = evaluate_walks(agent, env, make, task.walks, progress=config.progress)
            evaluation.measurements |= found.measurements
            film = _film(agent, env, make, task.walks.seconds)
        except MissingDependencyError as error:
            notes.append(f"Not evaluated in full physics: {error}")
    outcome = QuadrupedOutcome(directory, agent, evaluation, certificate, None, notes)
    _write_metrics(outcome, config, checks, task)
    try:
        from torchrl_sspl.viz.quadruped import write_quadruped_report

        outcome.report = write_quadruped_report(
            directory,
            agent,
            env,
            evaluation,
            walks,
            requirements=QUADRUPED,
            config=config.to_dict(),
            checks=checks,
            film=film,
            notes="\n\n".join(notes),
            certificate=certificate,
        )
    except MissingDependencyError as error:
        tqdm.write(f"no figures and no report: {error}")
    return outcome


def _trained_before(name: str, evaluation: Evaluation, checks: list[Any]) -> list[str]:
    """Training time and checks of an agent that was trained before, where they are known."""
    path = agent_directory(name) / "evaluation.json"
    if not path.is_file():
        return []
    body = json.loads(path.read_text())
    checks += [Check(**c) for c in body.get("checks", [])]
    known = body.get("measurements", {}).get("training_minutes")
    if known:
        evaluation.add(Measurement(**known))
    return [f"The agent's own evaluation of its training is in {path.name} beside it."]


def _film(agent: Agent, env: DubinsEnv, make: Callable[[], Any], seconds: float) -> Any:
    """A walk towards the obstacle, with frames."""
    world = make()
    try:
        steps = max(1, round(seconds / env.dt))
        return walk(agent, world, (-1.7, 0.1, 0.0), steps, seed=0, keep_frames=True)
    finally:
        world.close()


def _write_metrics(outcome: QuadrupedOutcome, config: TrainingConfig, checks: list[Any], task: QuadrupedRun) -> None:
    from torchrl_sspl import __version__

    body = {
        "version": __version__,
        "seed": config.seed,
        "preset": config.preset,
        "checks": [vars(c) for c in checks],
        "lipschitz": {
            k: v for k, v in outcome.agent.description.get("lipschitz", {}).items() if k != "multipliers"
        },
        "measurements": outcome.evaluation.to_dict(),
        "verdicts": {r.label: r.verdict(outcome.evaluation) for r in QUADRUPED},
        "walks": asdict(task.walks),
        "notes": outcome.notes,
        "config": config.to_dict(),
    }
    text = json.dumps(body, indent=1, sort_keys=True) + "\n"
    (outcome.directory / METRICS_FILE).write_text(text)
    if task.agent is None:
        (outcome.directory / "agent" / "evaluation.json").write_text(text)


__all__ = ["QuadrupedOutcome", "QuadrupedRun", "make_physics", "run_quadruped"]
