"""Figures, films and reports of a run; the extra ``viz`` (matplotlib, imageio-ffmpeg) is needed when they are used."""

from torchrl_sspl.viz.animation import Scene, Take, animate
from torchrl_sspl.viz.curves import read_log, training_curves
from torchrl_sspl.viz.figures import frames, latent_space, state_plane, trajectories
from torchrl_sspl.viz.live import watch
from torchrl_sspl.viz.plane import Plane
from torchrl_sspl.viz.report import format_value, requirement_rows, write_report
from torchrl_sspl.viz.slices import slices, walks

__all__ = [
    "Plane", "Scene", "Take", "animate", "format_value", "frames", "latent_space", "read_log", "requirement_rows",
    "slices", "state_plane", "training_curves", "trajectories", "walks", "watch", "write_report",
]  # fmt: skip
