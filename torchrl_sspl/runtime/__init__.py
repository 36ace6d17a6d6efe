"""At run time: other policies protected by an agent's set, and the agent without the training stack."""

from torchrl_sspl.runtime.filter import Protected, SafetyFilter, Shield
from torchrl_sspl.runtime.wrapper import SafetyWrapper

__all__ = ["Protected", "SafetyFilter", "SafetyWrapper", "Shield"]
