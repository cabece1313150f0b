"""The command line with the perception of ``painted.py``, for tests that need a process of their own."""

import sys
from unittest.mock import patch

from painted import WordEncoder, colour_perception

from su3d_bench.cli.main import main
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run

# At import, so that spawned workers, which import this file too, have it as well.
patch.object(scene_run, "build_perception", colour_perception).start()
patch.object(finished_run, "encoder_of", lambda folder, device="cpu": WordEncoder()).start()

if __name__ == "__main__":
    sys.exit(main())
