"""The Python API: runs, predictions and finished runs, by the same functions as the command line."""
