"""Online evaluation: maps scored while the camera moves."""
