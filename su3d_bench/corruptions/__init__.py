"""Corruptions of an evaluation's inputs: recordings, detections and class names, each with five severities."""
