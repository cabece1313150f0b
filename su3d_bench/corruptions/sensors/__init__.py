"""Errors of depth cameras, colour cameras and poses: the functions behind corruptions and the sensor track of homes."""
