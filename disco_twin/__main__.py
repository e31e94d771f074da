"""`python -m disco_twin`: the command `disco-twin`."""

import sys
from pathlib import Path

# `python -m` looks in the current folder first, where a user may have a folder `pipeline` or `hw` of another kind.
if not sys.flags.safe_path and Path(sys.path[0] or ".").resolve() != Path(__file__).resolve().parents[1]:
    del sys.path[0]

from disco_twin.cli.start import main

main()
