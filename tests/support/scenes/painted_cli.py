"""``painted.py`` for other processes: importing it installs its perception there.

As a program it is the command line.
"""

import sys
from pathlib import Path

if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))

from painted import Collector, Painted, WordEncoder, colour_perception

from su3d_bench.cli.main import main
from su3d_bench.runs import finished, scene

if "pytest" not in sys.modules:  # a test patches its own process, and undoes it
    scene.build_perception = colour_perception  # type: ignore[attr-defined, assignment]
    finished.encoder_of = lambda run, device="cpu": WordEncoder()

__all__ = ["Collector", "Painted"]

if __name__ == "__main__":
    sys.exit(main())
