"""What is kept on disk, whole or not at all: run folders, their records, predictions, scratch."""
