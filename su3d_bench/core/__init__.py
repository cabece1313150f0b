"""What goes from room to room: types, interfaces, the registry, settings, errors, digests, devices, timing."""
