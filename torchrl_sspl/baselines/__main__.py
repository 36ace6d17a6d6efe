"""``python -m torchrl_sspl.baselines NAME env=pendulum``: one row of the comparison; ``... table``: the table."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from torchrl_sspl.baselines.cell import STAYS, Cell, run_cell, text
from torchrl_sspl.baselines.registry import METHODS, kind_of
from torchrl_sspl.errors import SSPLError
from torchrl_sspl.interrupts import interruptible

_USAGE = """python -m torchrl_sspl.baselines METHOD [env=pendulum|dubins] [budget=small|full] [seed=0] [trials=8] [out_dir=...] [key=value ...]

Fits a method, measures it and prints the row; score.episodes=... and the like are sizes of the measurement. What has been
measured is read again, not measured again.

python -m torchrl_sspl.baselines table [methods=NAME,NAME:key=value] [env=pendulum,dubins] [budget=small] [seed=0,1,2] [trials=8] [out_dir=runs/baselines] [run=false] [jobs=2]

Runs the cells that are missing, as many at a time as jobs, and writes table.md and table.html into out_dir. METHOD is one of:
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0, or 2 for a wrong argument, with the reason on standard error. Source: none."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        lines = [f"  {name:<16} {(kind_of(name).__doc__ or '').splitlines()[0]}" for name in METHODS]
        print(_USAGE + "\n".join(lines))
        return 0 if words else 2
    try:
        with interruptible(lambda: STAYS):
            if words[0] == "table":
                from torchrl_sspl.baselines import page

                return page.main(words[1:])
            print(text(run_cell(Cell.of(words[0], words[1:]))))
    except SSPLError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
