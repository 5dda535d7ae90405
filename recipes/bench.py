"""Former name of recipes/sweep.py."""

import sys

sys.exit("Error: it is recipes/sweep.py now, with the same settings; out=bench goes on in bench/.")
