"""The machine: devices, reading files, termination signals, timing and memory."""
