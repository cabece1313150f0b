"""``python -m su3d_bench``."""

import sys

from su3d_bench.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
