"""The scripts can be imported here: last, as helpers of the tests have the same names as some of them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
