"""A program of somebody else that starts another one and takes its time; killed runs must not leave either behind."""

import shutil
import subprocess
import sys
import time

output, ready = sys.argv[1:]
child = subprocess.Popen(["sleep", "60"])
time.sleep(0.2)
child.kill()
child.wait()
shutil.copyfile(ready, f"{output}/prediction.npz")
