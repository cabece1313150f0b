"""A user program that starts another one and is slow; killed runs must not leave either behind.

If no one waits for it any more it continues for a minute, so that it is detected.
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
