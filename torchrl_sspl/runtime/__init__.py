"""At run time: other policies protected by an agent's set, and what is known at every step."""

from torchrl_sspl.runtime.faults import CameraFault
from torchrl_sspl.runtime.filter import Protected, SafetyFilter, Shield
from torchrl_sspl.runtime.monitor import Calibration, Monitor, Verdict, Watched, calibrate
from torchrl_sspl.runtime.wrapper import SafetyVectorWrapper, SafetyWrapper

__all__ = [
    "Calibration", "CameraFault", "Monitor", "Protected", "SafetyFilter", "SafetyVectorWrapper", "SafetyWrapper", "Shield",
    "Verdict", "Watched", "calibrate",
]  # fmt: skip
