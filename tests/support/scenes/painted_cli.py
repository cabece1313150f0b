"""The command line with the perception of ``painted.py``, for tests that need a process of their own."""

import sys
from unittest.mock import patch

from painted import colour_perception

from su3d_bench.cli.main import main
from su3d_bench.runs import resume as finished_scenes
from su3d_bench.runs import scene as scene_run

# At import, so that spawned workers, which import this file too, have it as well.
for module in (scene_run, finished_scenes):
    patch.object(module, "build_perception", colour_perception).start()

if __name__ == "__main__":
    sys.exit(main())
