"""Tiny networks with random weights in the very files in which the published ones come, for rehearsals and tests.

Whoever reads them can tell them by the size of their weights (``ModelFiles.is_stand_in``): their encoders are called
stand-ins, and every number made with them carries a caveat.
"""
