"""What a program or a notebook calls: runs, predictions and finished runs, by the functions that the verbs call."""
