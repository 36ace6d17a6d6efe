"""``python -m torchrl_sspl``: the command ``sspl``."""

from __future__ import annotations

import sys

from torchrl_sspl.cli import main

if __name__ == "__main__":
    sys.exit(main())
