"""Files that are packed as a whole, which Mitsuba reads none of. Imports no Mitsuba."""

from __future__ import annotations

_BEGINNINGS = (
    (b"\x1f\x8b", "gzip"),
    (b"BZh", "bzip2"),
    (b"\xfd7zXZ\x00", "xz"),
    (b"\x28\xb5\x2f\xfd", "zstd"),
    (b"PK\x03\x04", "zip"),
)
"""First bytes -> the program that packed the file."""
MAGIC_BYTES = max(len(start) for start, _ in _BEGINNINGS)
"""How much of a file tells whether it is packed."""


def advice(start: bytes) -> str | None:
    """What to say of a file that begins so, after its name; None where it is not packed."""
    packer = next((name for magic, name in _BEGINNINGS if start.startswith(magic)), None)
    return packer and f"is packed by {packer}, and packed files are not read: unpack it, and name what comes out"
