"""What reading a damaged file raises, whoever reads it."""

from __future__ import annotations

import struct
import tokenize
import zipfile
import zlib

# Of a damaged .npz; a compression that there is none of is a NotImplementedError, a RuntimeError.
DAMAGE = (
    OSError, EOFError, ValueError, KeyError, TypeError, OverflowError, RuntimeError,
    SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip
