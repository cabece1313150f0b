"""What readers raise on a damaged file, an .npz above all; apart from the errors, for what it imports."""

from __future__ import annotations

import struct
import tokenize
import zipfile
import zlib

DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    SyntaxError,
    RuntimeError,  # zipfile's, of a compression unknown to it
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
)
