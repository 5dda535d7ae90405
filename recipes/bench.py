"""Former name of recipes/sweep.py."""

import sys

sys.exit(
    "Error: bench.py is recipes/sweep.py now, with the same settings; out=bench continues there."
)
