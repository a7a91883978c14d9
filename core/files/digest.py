"""A digest of the contents of files."""

from __future__ import annotations

import hashlib
from pathlib import Path


def digest(*paths: Path) -> str:
    """SHA-256 of the contents of files, one after the other, as hexadecimal text. A path that is no file counts as
    missing; "" where the first is none."""
    if not paths[0].is_file():
        return ""
    found = hashlib.sha256()
    for path in paths:
        if not path.is_file():
            found.update(b"missing")
            continue
        with path.open("rb") as file:
            hashlib.file_digest(file, lambda: found)
    return found.hexdigest()
