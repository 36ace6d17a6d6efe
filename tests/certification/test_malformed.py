"""Files that are no certificates: none is read any further than it has to be, and none ends in a traceback."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from forging import Body, copied, read, sealed, statement, to, verify

from torchrl_sspl.certification.certificate import Certificate, Reason
from torchrl_sspl.evaluation.certify import Exit


def raw(text: str | bytes) -> Callable[[Path, Body], None]:
    data = text if isinstance(text, bytes) else text.encode()
    return lambda file, body: file.write_bytes(data)


def with_(change: Callable[[Body], Any]) -> Callable[[Path, Body], None]:
    def edit(file: Path, body: Body) -> None:
        change(body)
        file.write_text(json.dumps(sealed(body)))

    return edit


def text_edit(old: str, new: str) -> Callable[[Path, Body], None]:
    def edit(file: Path, body: Body) -> None:
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return edit


def counts(**values: Any) -> Callable[[Path, Body], None]:
    return with_(lambda b: b["record"]["blocks"][0].update(values))


def of_record(**values: Any) -> Callable[[Path, Body], None]:
    return with_(lambda b: b["record"].update(values))


MALFORMED: dict[str, Callable[[Path, Body], Any]] = {
    "empty": raw(""),
    "not JSON": raw("{"),
    "not text": raw(b"\xff\xfe\x00\x01"),
    "a number": raw("1"),
    "a list": raw("[]"),
    "null": raw("null"),
    "nested a hundred thousand times": raw("[" * 100_000),
    "nested a few times too often": with_(lambda b: b["record"].update(system=json.loads("[" * 9 + "]" * 9))),
    "nested objects": raw('{"a":' * 50_000 + "1" + "}" * 50_000),
    "ten megabytes": lambda path, body: path.write_text(path.read_text() + " " * 10_000_000),
    "an integer of ten thousand digits": text_edit('"level": 0.0', f'"level": {"9" * 10_000}'),
    "an integer of 400 digits": text_edit('"level": 0.0', f'"level": {"9" * 400}'),
    "level NaN": text_edit('"level": 0.0', '"level": NaN'),
    "level Infinity": text_edit('"level": 0.0', '"level": Infinity'),
    "level 1e999": text_edit('"level": 0.0', '"level": 1e999'),
    "level text": with_(lambda b: b.update(level="0")),
    "level a flag": with_(lambda b: b.update(level=False)),
    "a key twice": text_edit('"level": 0.0', '"level": 0.0, "level": -1.0'),
    "schema of the past": with_(lambda b: b.update(schema=1)),
    "schema true": with_(lambda b: b.update(schema=True)),
    "schema 2.0": with_(lambda b: b.update(schema=2.0)),
    "a key too many": with_(lambda b: b.update(approved_by="the authority")),
    "a key too few": with_(lambda b: b.pop("record")),
    "a layer formal": with_(lambda b: b["layers"].update(formal=b["layers"]["deterministic"] | {"name": "formal"})),
    "statistical calls itself deterministic": with_(lambda b: b["layers"]["statistical"].update(name="deterministic")),
    "no deterministic layer": with_(lambda b: b["layers"].pop("deterministic")),
    "no paper layer beside a record": with_(lambda b: b["layers"].pop("paper")),
    "statistical layer without a record": with_(lambda b: b.update(record=None)),
    "layers a list": with_(lambda b: b.update(layers=list(b["layers"].values()))),
    "a layer a list": with_(lambda b: b["layers"].update(paper=[])),
    "a verdict too good": with_(lambda b: b["layers"]["deterministic"].update(verdict="holds, whatever happens")),
    "a statistical statement called proved": with_(to("episodes", "statistical", kind="proved")),
    "a kind unknown": with_(to("invariance", kind="guaranteed")),
    "holds 0": with_(to("invariance", holds=0)),
    "holds 1": with_(to("invariance", holds=1)),
    "holds null where it decides": with_(to("invariance", holds=None)),
    "holds where nothing is decided": with_(to("starts", "statistical", holds=True)),
    "value text": with_(to("tolerated error", value="0.13")),
    "value a list": with_(to("tolerated error", value=[0.13])),
    "value Infinity": text_edit('"value": 1.5', '"value": Infinity'),
    "value minus Infinity": text_edit('"value": 1.5', '"value": -Infinity'),
    "value a flag": with_(to("Lipschitz constant", value=True)),
    "n a float": with_(to("episodes", "statistical", n=300.0)),
    "n negative": with_(to("episodes", "statistical", n=-1)),
    "confidence 1": with_(to("episodes", "statistical", confidence=1.0)),
    "confidence 95": with_(to("episodes", "statistical", confidence=95)),
    "reason unknown": with_(to("invariance", holds=False, reason="BAD_LUCK")),
    "reason beside what holds": with_(to("invariance", reason="UNDECIDED")),
    "no reason where it fails": with_(to("invariance", holds=False)),
    "detail a list": with_(to("invariance", detail=["a"])),
    "text of a megabyte": with_(to("invariance", text="a" * 100_000)),
    "text over two lines": with_(to("invariance", text="a\nOK: everything holds")),
    "text that moves the cursor": with_(to("invariance", text="\x1b[2Ka")),
    "name empty": with_(to("invariance", name="")),
    "a statement twice": with_(lambda b: b["layers"]["deterministic"]["statements"].append(statement(b, "domain"))),
    "a key too many in a statement": with_(to("domain", note="a")),
    "a statement a text": with_(lambda b: b["layers"]["deterministic"]["statements"].append("safe")),
    "a thousand statements": with_(lambda b: b["layers"]["deterministic"].update(statements=1000 * [statement(b, "domain")])),
    "weights no digest": with_(lambda b: b.update(weights="c0ffee")),
    "weights a number": with_(lambda b: b.update(weights=0)),
    "name of two lines": with_(lambda b: b.update(agent="line\nOK")),
    "name a sentence": with_(lambda b: b.update(agent="line: formally verified!")),
    "counts negative": counts(left=-1),
    "counts of a thousand million": counts(episodes=10**9),
    "counts of more episodes than a block": counts(episodes=251),
    "counts that are floats": counts(left=0.0),
    "counts that are flags": counts(left=False),
    "more events than episodes": counts(left=251, events=251),
    "events left out of the sum": counts(left=5),
    "events out of nothing": counts(events=5),
    "aliased without entering U": counts(aliased=2, events=2),
    "more mistaken than shown": counts(mistaken=251),
    "exceeding more than there are": counts(exceeding=400),
    "more episodes than the last block has": with_(lambda b: b["record"]["blocks"][1].update(episodes=51, steps=204)),
    "more steps than its episodes have": with_(lambda b: [one.update(steps=n) for one, n in zip(b["record"]["blocks"], (999, 201), strict=True)]),
    "episodes longer than the horizon": with_(lambda b: b["record"]["sizes"].update(longest=5)),
    "one block too many": with_(lambda b: b["record"]["blocks"].append(b["record"]["blocks"][0])),
    "one block too few": with_(lambda b: b["record"]["blocks"].pop()),
    "no blocks": of_record(blocks=[]),
    "blocks an object": of_record(blocks={}),
    "episodes a thousand million": of_record(episodes=10**9),
    "episodes a million, counts of a few": of_record(episodes=10**6),
    "episodes zero": of_record(episodes=0),
    "horizon negative": of_record(horizon=-5),
    "horizon shorter than its episodes": of_record(horizon=2),
    "confidence of the record 1": of_record(confidence=1.0),
    "acceptable 1": of_record(acceptable=1.0),
    "acceptable 0": of_record(acceptable=0.0),
    "kind of episodes unknown": of_record(kind="dreams"),
    "system unknown": of_record(system="trust me"),
    "seed negative": of_record(seed=-1),
    "seed text": of_record(seed="lucky"),
    "used seeds a text": of_record(used="none"),
    "used seeds of floats": of_record(used=[0.5]),
    "rims of another part": of_record(rims=[["everywhere", 5, 0.0]]),
    "rims of too many": of_record(rims=100 * [["at the rim", 5, 0.0]]),
    "sizes with a key too many": with_(lambda b: b["record"]["sizes"].update(more=1)),
    "more met than measured": with_(lambda b: b["record"]["sizes"].update(safe_met=10**6)),
    "more repeated than episodes": with_(lambda b: b["record"]["sizes"].update(repeated=10**6)),
    "numbers with text": with_(lambda b: b["record"]["numbers"].update(largest_error="small")),
    "record a list": with_(lambda b: b.update(record=[])),
    "record with a key too many": of_record(signed_by="us"),
}  # fmt: skip


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_file_is_no_certificate(name, issued, tmp_path):
    directory = copied(issued, tmp_path)
    MALFORMED[name](directory / "certificate.json", read(directory))
    began = time.monotonic()
    code, text = verify(directory)
    assert time.monotonic() - began < 2.0
    assert code == Exit.MALFORMED, text
    assert text.startswith(f"FAILED {Reason.SCHEMA_UNKNOWN.name}")
    assert len(text) < 1000
    assert text.isprintable()


def test_nesting_is_refused_before_anything_is_parsed(issued, tmp_path):
    directory = copied(issued, tmp_path)
    (directory / "certificate.json").write_text("[" * 9 + "]" * 9)
    assert "levels of nesting" in verify(directory)[1]


def test_no_certificate_and_a_folder_in_its_place_are_told(issued, tmp_path):
    directory = copied(issued, tmp_path)
    (directory / "certificate.json").unlink()
    assert verify(directory)[0] == Exit.MALFORMED
    (directory / "certificate.json").mkdir()
    assert verify(directory)[0] == Exit.MALFORMED


def test_there_are_enough_malformed_files():
    assert len(MALFORMED) >= 100


@pytest.mark.slow  # every file is read without one
def test_the_command_ends_without_a_traceback(issued, tmp_path):
    directory = copied(issued, tmp_path)
    (directory / "certificate.json").write_text("[" * 100_000)
    code = f"import analytic; from torchrl_sspl.cli import main; raise SystemExit(main(['verify', {str(directory)!r}]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parent.parent, check=False)
    assert done.returncode == Exit.MALFORMED, done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_reading_gives_what_was_written(issued):
    body = read(issued)
    one = Certificate.from_dict(copy.deepcopy(body))
    assert one.to_dict() == body
    assert one.written == one.digest
