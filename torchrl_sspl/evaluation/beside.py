"""The certificate that lies beside an agent, and whether it is about this agent."""

from __future__ import annotations

from pathlib import Path

from torchrl_sspl.certification.certificate import Certificate, Reason, configuration_digest, weights_digest
from torchrl_sspl.errors import CertificationError
from torchrl_sspl.modules.agent import Agent

CERTIFICATE_FILE = "certificate.json"
#: What a certificate is about; everything else in the description (the certificate's own traces, notes) may change.
_CERTIFIED_KEYS = ("networks", "config", "training", "lipschitz", "seeds", "environment", "trained_on", "tolerated_error")


def configuration_of(agent: Agent) -> str:
    """Digest of what a certificate is about beside the weights. Source: none."""
    certified = {k: agent.description.get(k) for k in _CERTIFIED_KEYS} | {"lipschitz_bound": agent.lipschitz_bound}
    return configuration_digest(certified)


def certificate_beside(directory: str | Path, agent: Agent) -> tuple[Certificate | None, str]:
    """The certificate in an agent's directory, and "" or why it cannot be shown as this agent's: then None.

    It is compared with weights and configuration, and with its own digest; nothing is computed again, which ``sspl verify`` does.
    Source: none.

    Example:
        >>> from torchrl_sspl.modules.agent import agent_directory, load
        >>> certificate, why = certificate_beside(agent_directory("pendulum"), load("pendulum"))
        >>> certificate.layers["deterministic"].holds, why
        (True, '')
    """
    path = Path(directory) / CERTIFICATE_FILE
    if not path.is_file():
        return None, ""
    try:
        found = Certificate.load(path)
    except CertificationError as error:
        return None, f"the certificate beside the agent cannot be read: {error}"
    for reason, said, now in (
        (Reason.WEIGHTS_CHANGED, found.weights, weights_digest(agent.state_dict())),
        (Reason.CONFIGURATION_CHANGED, found.configuration, configuration_of(agent)),
        (Reason.DIGEST_CHANGED, found.written, found.digest),
    ):
        if said != now:
            return None, f"the certificate beside the agent is not shown: {reason.value}; issue it again"
    return found, ""
