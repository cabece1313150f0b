"""The reference pipeline, OpenSU3D: 2D masks fused and tracked into a 3D instance map."""
