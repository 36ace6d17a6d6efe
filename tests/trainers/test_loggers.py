"""Loggers: what each of them is given arrives, wandb stays on disk without key or network, names are those documented."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.record.loggers.csv import CSVLogger

from torchrl_sspl.errors import ConfigError, DTypeError, MissingDependencyError, ShapeError
from torchrl_sspl.trainers import loggers
from torchrl_sspl.trainers.hooks import RestartHook
from torchrl_sspl.trainers.loggers import METRICS, close_logger, log_figure, log_scalars, log_video, make_logger

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
DOCS = Path(__file__).parents[2] / "docs" / "logging.md"


@pytest.fixture
def figure():
    plt = pytest.importorskip("matplotlib.figure", reason="needs the extra viz")
    drawn = plt.Figure(figsize=(1, 1))
    drawn.add_subplot().plot([0, 1])
    return drawn


def film(n: int = 3) -> torch.Tensor:
    frames = torch.zeros(n, 3, 8, 8, dtype=torch.uint8)
    for k in range(n):
        frames[k, :, k] = 255
    return frames


def test_csv_is_the_default_and_keeps_numbers_pictures_and_films(tmp_path, figure):
    logger = make_logger(directory=tmp_path)
    assert isinstance(logger, CSVLogger)
    log_scalars(logger, {"grad_norm": 2.5, "loss_safe": torch.tensor(1.5)}, step=7)
    assert (tmp_path / "run" / "scalars" / "grad_norm.csv").read_text() == "7,2.5\n"
    log_scalars(logger, {"grad_norm": 3.0}, step=8)
    assert (tmp_path / "run" / "scalars" / "grad_norm.csv").read_text() == "7,2.5\n8,3.0\n"
    assert logger.experiment.scalars["grad_norm"] == [(8, 3.0)]  # in memory and in checkpoints it does not grow
    assert log_figure(logger, "latent", figure, 7).read_bytes()[1:4] == b"PNG"
    written = log_video(logger, "episode", film(), 7)
    close_logger(logger)
    pillow = pytest.importorskip("PIL.Image")
    with pillow.open(written) as gif:
        assert gif.n_frames == 3
        gif.seek(2)
        assert gif.convert("RGB").getpixel((0, 2)) == (255, 255, 255)


def test_tensorboard_gets_numbers_pictures_and_films(tmp_path, figure):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger = make_logger("tensorboard", directory=tmp_path)
    log_scalars(logger, {"grad_norm": 2.5}, step=7)
    log_figure(logger, "latent", figure, 7)
    log_video(logger, "episode", film(), 7)
    close_logger(logger)
    events = EventAccumulator(str(tmp_path / "run")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("grad_norm")] == [(7, 2.5)]
    assert events.Images("latent")[0].encoded_image_string[1:4] == b"PNG"
    assert events.Images("episode")[0].encoded_image_string[:3] == b"GIF"


def test_wandb_stays_on_disk_without_a_key(tmp_path, figure, monkeypatch):
    pytest.importorskip("wandb")
    for name in ("WANDB_API_KEY", "WANDB_MODE", "WANDB_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.setenv("WANDB_SILENT", "true")
    logger = make_logger("wandb", directory=tmp_path)
    try:
        log_scalars(logger, {"grad_norm": 2.5, "loss_safe": 1.0}, step=7)
        log_figure(logger, "latent", figure, 7)
        log_video(logger, "episode", film(), 7)
        assert logger.experiment.offline
        summary = dict(logger.experiment.summary)
        assert summary["grad_norm"] == 2.5
    finally:
        close_logger(logger)
    assert list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))
    assert "WANDB_MODE" not in __import__("os").environ


@pytest.mark.slow
def test_wandb_takes_a_figure_where_nobody_has_imported_pyplot(tmp_path):
    pytest.importorskip("wandb")
    pytest.importorskip("matplotlib")
    program = """
import sys, warnings
warnings.simplefilter("error", UserWarning)  # what a logger that fails costs
from torchrl_sspl.trainers.loggers import close_logger, log_figure, make_logger
from torchrl_sspl.viz.plane import new_figure
logger = make_logger("wandb", directory=sys.argv[1])
log_figure(logger, "latent", new_figure(1, 1), 7)
close_logger(logger)
assert "matplotlib.pyplot" not in sys.modules
"""
    told = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=False,
        env=os.environ | {"WANDB_MODE": "offline", "WANDB_SILENT": "true"},
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    assert list((tmp_path / "wandb").glob("offline-run-*/files/media/images/latent*.png"))


class Broken:
    """A logger that takes nothing, as a full disk or a lost server."""

    log_dir, exp_name = "/dev/null/nowhere", "run"

    class experiment:
        def close():
            raise OSError("no space left on device")

    def log_scalar(self, name, value, step, **options):
        raise OSError("no space left on device")


def test_a_logger_that_fails_costs_a_warning(figure):
    logger = Broken()
    for call in (
        lambda: log_scalars(logger, {"grad_norm": 1.0}, step=0),
        lambda: log_figure(logger, "latent", figure, 0),
        lambda: log_video(logger, "episode", film(), 0),
        lambda: close_logger(logger),
    ):
        with pytest.warns(UserWarning, match="Broken did not take"):
            assert call() is None
    with pytest.raises(ConfigError, match="METRICS"):  # a mistake of ours is one
        log_scalars(logger, {"my_number": 1.0}, step=0)


@pytest.mark.parametrize(
    ("key", "mode", "reachable", "offline"),
    [
        (None, None, True, True),
        ("k", None, True, False),
        ("k", None, False, True),
        ("k", "offline", True, True),
        (None, "online", False, False),
        ("netrc", None, True, False),
    ],
)
def test_wandb_goes_online_with_a_key_and_a_network_only(key, mode, reachable, offline, monkeypatch, tmp_path):
    netrc = tmp_path / "netrc"
    if key == "netrc":
        netrc.write_text("machine wandb.example login user password secret\n")
        netrc.chmod(0o600)
    monkeypatch.setenv("NETRC", str(netrc))
    monkeypatch.setenv("WANDB_BASE_URL", "https://wandb.example:8443/x")
    for name, value in (("WANDB_API_KEY", key if key == "k" else None), ("WANDB_MODE", mode)):
        monkeypatch.delenv(name, raising=False) if value is None else monkeypatch.setenv(name, value)
    asked = []

    class Connection:
        def close(self) -> None:
            pass

    def connect(address, timeout):
        asked.append(address)
        if not reachable:
            raise OSError("no route")
        return Connection()

    monkeypatch.setattr(loggers.socket, "create_connection", connect)
    assert loggers.wandb_offline() is offline
    assert asked in ([], [("wandb.example", 8443)])


@pytest.mark.parametrize(("kind", "extra"), [("wandb", "wandb"), ("tensorboard", "tensorboard")])
def test_a_missing_package_is_named(kind, extra, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, kind, None)
    with pytest.raises(MissingDependencyError, match=rf"torchrl-sspl\[{extra}\]"):
        make_logger(kind, directory=tmp_path)


def test_what_does_not_fit_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="one of csv, wandb, tensorboard, none, received 'cvs'"):
        make_logger("cvs")
    with pytest.raises(ConfigError, match=r"names of METRICS, received \['my_number'\]"):
        log_scalars(None, {"my_number": 1.0}, step=0)
    with pytest.raises(DTypeError, match="uint8"):
        log_video(None, "episode", film().float(), 0)
    with pytest.raises(ShapeError, match="T >= 1"):
        log_video(None, "episode", film(0), 0)
    assert make_logger("none") is None
    assert log_figure(None, "a", None, 0) is None


def test_documented_names_are_the_names_of_the_library():
    _, _, metrics = DOCS.read_text().partition("## Metrics")
    documented = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", metrics, re.MULTILINE))
    assert documented == {name: text.replace("|", "\\|") for name, text in METRICS.items()}


def emitted(folder: Path, **options) -> set[str]:
    from test_trainer import build

    trainer = build(batches=2, logger=CSVLogger("run", log_dir=str(folder)), log_interval=0, **options)
    RestartHook(trainer, lambda attempt: trainer.loss_module, after=10**6, most=1).register(trainer)
    trainer.train()
    return {path.stem for path in (folder / "run" / "scalars").glob("*.csv")}


def from_losses() -> set[str]:
    """Keys that the losses can return, with every term on."""
    from torchrl_sspl.lipschitz import LMIBarrier
    from torchrl_sspl.modules import InverseDynamics, LatentDynamics, Policy
    from torchrl_sspl.objectives import ActionValueLoss, LipschitzLoss, SSPLLoss, TargetLoss

    parts = (LatentDynamics(2, 1, (8,)), torch.nn.Linear(2, 1), Policy(2, 1, (8,)))
    everything = dict.fromkeys(
        ("inverse_dynamics", "variance", "covariance", "saturation", "growth", "off_manifold", "descent", "policy"), 1.0
    )
    options = {f"{name}_coeff": weight for name, weight in everything.items()}
    loss = SSPLLoss(None, *parts, inverse_dynamics=InverseDynamics(2, 1), **options)
    losses = (
        loss, LipschitzLoss(LMIBarrier(2, (8,))), TargetLoss(parts[1], parts[2], action_scale=1.0),
        ActionValueLoss(parts[2]),
    )  # fmt: skip
    return {key for one in losses for key in one.out_keys}


def test_emitted_names_are_the_documented_ones(tmp_path):
    logged = emitted(tmp_path / "a", with_margins=True)
    logged |= emitted(tmp_path / "b", lmi=True)
    assert logged <= set(METRICS), f"not documented: {sorted(logged - set(METRICS))}"
    possible = logged | from_losses() | rounds() | evaluations()
    assert possible <= set(METRICS), f"not documented: {sorted(possible - set(METRICS))}"
    assert set(METRICS) <= possible, f"documented and never emitted: {sorted(set(METRICS) - possible)}"


def rounds() -> set[str]:
    from dataclasses import fields

    from torchrl_sspl.trainers.phases import Check

    checks = {f.name for f in fields(Check)} - {"round", "reason"}
    return checks | {"inside_of_allowed", "sweeps"}


def evaluations() -> set[str]:
    from torchrl_sspl.evaluation.episodes import logged
    from torchrl_sspl.evaluation.known import Evaluation, share

    result = Evaluation()
    for name in METRICS:
        if name.startswith("eval_"):
            result.add(share(name.removeprefix("eval_"), 0, 0))
    return set(logged(result))
