"""How certificates are changed and verified, for the tests of forged files and of malformed ones."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from analytic import Line

from torchrl_sspl.certification.certificate import Layer, Statement, configuration_digest
from torchrl_sspl.evaluation.certify import verify_run

Body = dict[str, Any]


def copied(source: Path, target: Path) -> Path:
    for file in source.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target


def verify(directory: Path, **options: Any) -> tuple[int, str]:
    lines: list[str] = []
    began = time.monotonic()
    code = verify_run(directory, report=lines.append, **({"env": Line()} | options))
    assert time.monotonic() - began < 60.0
    return code, "\n".join(lines)


def sealed(body: Body) -> Body:
    """With a digest that fits, as a careful forger would."""
    body["digest"] = configuration_digest({k: v for k, v in body.items() if k != "digest"})
    return body


def read(directory: Path) -> Body:
    return json.loads((directory / "certificate.json").read_text())


def write(directory: Path, body: Body, *, seal: bool = True) -> None:
    (directory / "certificate.json").write_text(json.dumps(sealed(body) if seal else body))


def statement(body: Body, name: str, layer: str = "deterministic") -> Body:
    return next(s for s in body["layers"][layer]["statements"] if s["name"] == name)


def to(name: str, layer: str = "deterministic", /, **values: Any) -> Callable[[Body], None]:
    def change(body: Body) -> None:
        statement(body, name, layer).update(values)

    return change


def verdicts(body: Body) -> None:
    """Verdicts as the statements give them."""
    for layer in body["layers"].values():
        layer["verdict"] = Layer(layer["name"], [Statement(**s) for s in layer["statements"]]).verdict
