"""Safe policies from pixels with barrier certificates that are checked, for TorchRL."""

from __future__ import annotations

__version__ = "0.1.0"
