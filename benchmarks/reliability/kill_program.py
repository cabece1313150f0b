"""A program of somebody else that starts another one and takes its time; killed runs must not leave either behind.

Once nobody waits for it any more it goes on for a minute, so that it is seen.
"""

import os
import shutil
import subprocess
import sys
from contextlib import suppress

output, ready = sys.argv[1:]
parent = os.getppid()
child = subprocess.Popen(["sleep", "60"])
with suppress(subprocess.TimeoutExpired):
    child.wait(0.2)
if os.getppid() != parent:
    child.wait()
child.kill()
child.wait()
shutil.copyfile(ready, f"{output}/prediction.npz")
