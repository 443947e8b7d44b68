"""``python -m clod_adapter``: the command ``clod-adapt`` where only the interpreter is at hand, as
under torchrun.
"""

import sys
from importlib import import_module

if __name__ == "__main__":
    # By name: in the source tree the command is in cli/, and type checkers find no
    # clod_adapter.cli.
    sys.exit(import_module("clod_adapter.cli.main").main())
