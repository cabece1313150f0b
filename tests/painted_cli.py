"""The command line with the perception of ``painted.py``, for tests that need a process of their own."""

import sys

from painted import colour_perception

from su3d_bench import scene_run
from su3d_bench.cli.main import main

# At import, so that spawned workers, which import this file too, have it as well.
scene_run.build_perception = colour_perception

if __name__ == "__main__":
    sys.exit(main())
