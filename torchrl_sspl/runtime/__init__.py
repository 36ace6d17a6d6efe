"""At run time: other policies protected by an agent's set, and the agent without the training stack."""

from torchrl_sspl.runtime.export import DeployedStep, export
from torchrl_sspl.runtime.filter import Protected, SafetyFilter, Shield
from torchrl_sspl.runtime.wrapper import SafetyWrapper

__all__ = ["DeployedStep", "Protected", "SafetyFilter", "SafetyWrapper", "Shield", "export"]
