"""At run time: other policies protected by an agent's set, what is known at every step, the agent without the training stack."""

from torchrl_sspl.runtime.export import DeployedStep, export
from torchrl_sspl.runtime.faults import CameraFault
from torchrl_sspl.runtime.filter import Protected, SafetyFilter, Shield
from torchrl_sspl.runtime.monitor import Calibration, Monitor, Verdict, Watched, calibrate
from torchrl_sspl.runtime.wrapper import SafetyWrapper

__all__ = [
    "Calibration", "CameraFault", "DeployedStep", "Monitor", "Protected", "SafetyFilter", "SafetyWrapper", "Shield", "Verdict",
    "Watched", "calibrate", "export",
]  # fmt: skip
