"""What the machine gives: devices, files, signals at the end, clocks and memory."""
