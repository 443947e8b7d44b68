"""``python -m clod_adapter``: the command ``clod-adapt`` where only the interpreter is at hand, as under torchrun."""

from __future__ import annotations

import sys

from clod_adapter.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
