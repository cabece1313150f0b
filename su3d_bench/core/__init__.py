"""Shared by all packages: types, interfaces, the registry, settings, errors, digests, devices, timing."""
