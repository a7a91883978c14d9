"""Files that are whole or not there: written under another name and put in place at once, and looked at before they
count as finished."""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import struct
import zipfile
import zlib
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

_PART = re.compile(r"\.(?P<stem>.+)\.[0-9a-f]{16}\.part(?P<suffix>\.[^.]+)?")
_PNG = b"\x89PNG\r\n\x1a\n"
_EXR, _TILED, _DEEP, _MULTIPART = 20000630, 0x200, 0x800, 0x1000
# Lines of a chunk by the number of a compression (OpenEXR file layout, "Compression")
_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write to, in the same folder and with the same suffix, that takes the place of `path` when the block
    ends without an error.

    The file is there, empty, and no other process or link has its name. Raises OSError where what was written is not
    whole or does not reach the disk.
    """
    with _new_part(path) as part:
        yield part
        with part.open("rb+") as written:
            os.fsync(written.fileno())  # some file systems say only here that they are full
        if not is_whole(part):
            raise OSError(errno.EIO, "it was not written whole", str(path))
        os.replace(part, path)


@contextmanager
def _new_part(path: Path) -> Iterator[Path]:
    """A file of ours beside path, which is gone at the end. It is locked meanwhile: that tells others that somebody is
    at work."""
    name = f".{path.stem}.{secrets.token_hex(8)}"
    new, part = path.with_name(f"{name}.new{path.suffix}"), path.with_name(f"{name}.part{path.suffix}")
    handle = os.open(new, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    try:
        if os.name == "nt":  # nobody could put another in its place while it is open
            os.close(handle)
        else:
            _lock(handle, wait=False)
        os.rename(new, part)  # locked before anybody takes it for a part
        yield part
    finally:
        if os.name != "nt":
            os.close(handle)
        for left in (part, new):
            with suppress(OSError):
                left.unlink(missing_ok=True)


def check_writable(folder: Path) -> None:
    """Raise OSError where no file can be made in a folder."""
    with _new_part(folder / "lipac"):
        pass


def sweep(folder: Path, stems: Container[str]) -> None:
    """Remove what processes that were killed had begun to write in a folder, of files of these names without their
    endings."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            found = _PART.fullmatch(entry.name)
            if found and found["stem"] in stems and entry.is_file(follow_symlinks=False) and _is_left(entry.path):
                with suppress(OSError):
                    os.unlink(entry.path)


def _is_left(part: str) -> bool:
    """Whether nobody writes to a part any more."""
    if os.name == "nt":
        return True  # one that is open cannot be removed
    try:
        handle = os.open(part, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        return _lock(handle, wait=False)
    finally:
        os.close(handle)


def _lock(handle: int, wait: bool) -> bool:
    """Lock an open file or folder until it is closed. False where another process has it, or where the file system
    knows no locks."""
    if os.name == "nt":
        return True
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        return False
    return True


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """A block that no other process is in for the same folder."""
    if os.name == "nt":
        import hashlib
        import msvcrt
        import tempfile

        name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]
        with (Path(tempfile.gettempdir()) / f"lipac-{name}.lock").open("a+") as file:
            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)  # type: ignore[attr-defined]
            yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        _lock(handle, wait=True)
        yield
    finally:
        os.close(handle)


# Whether they are whole


def is_whole(path: Path) -> bool:
    """Whether a file is there from its first to its last byte: .exr, .png, .npz, .json and .blend by what is in them,
    others by not being empty."""
    check = {
        ".exr": _whole_exr,
        ".png": _whole_png,
        ".npz": _whole_npz,
        ".json": _whole_json,
        ".blend": _whole_blend,
    }.get(path.suffix.lower())
    try:
        if not path.is_file() or path.stat().st_size == 0:
            return False
        if check is None:
            return True
        with path.open("rb") as file:
            return check(file, path.stat().st_size)
    except (OSError, ValueError, struct.error, KeyError, RecursionError, zipfile.BadZipFile):
        return False


def _whole_png(file: IO[bytes], size: int) -> bool:
    """All chunks with their check sums, up to IEND (PNG specification, section 5)."""
    if file.read(8) != _PNG:
        return False
    while True:
        length, kind = struct.unpack(">I4s", file.read(8))
        if length > size:
            return False
        data = file.read(length)
        if zlib.crc32(kind + data) != struct.unpack(">I", file.read(4))[0]:
            return False
        if kind == b"IEND":
            return True


def _whole_exr(file: IO[bytes], size: int) -> bool:
    """All chunks of scan lines are where the table says, each with its line, and within the file (OpenEXR file layout).
    Other kinds: their beginning."""
    magic, version = struct.unpack("<II", file.read(8))
    if magic != _EXR:
        return False
    if version & (_TILED | _DEEP | _MULTIPART):
        return True
    header: dict[str, bytes] = {}
    while name := _text(file):
        _text(file)
        header[name] = file.read(struct.unpack("<I", file.read(4))[0])
    _, low, _, high = struct.unpack("<4i", header["dataWindow"])
    lines = _LINES[header["compression"][0]]
    count = -(-(high - low + 1) // lines)
    if 8 * count > size:
        return False
    offsets = struct.unpack(f"<{count}Q", file.read(8 * count))
    for k, offset in enumerate(offsets):
        if not 0 < offset < size:
            return False
        file.seek(offset)
        line, length = struct.unpack("<iI", file.read(8))
        if line != low + k * lines or not length or offset + 8 + length > size:
            return False
    return True


def _text(file: IO[bytes]) -> str:
    """A text that ends with a zero."""
    out = bytearray()
    while (byte := file.read(1)) != b"\0":
        if not byte or len(out) > 255:
            raise ValueError("no header")
        out += byte
    return out.decode("latin-1")


def _whole_npz(file: IO[bytes], size: int) -> bool:
    with zipfile.ZipFile(file) as archive:
        return all(entry.header_offset + entry.compress_size < size for entry in archive.infolist())


def _whole_blend(file: IO[bytes], size: int) -> bool:
    """Its last block, or the end of the table of compressed frames (Zstandard seekable format)."""
    start = file.read(7)
    file.seek(max(size - 64, 0))
    end = file.read()
    return b"ENDB" in end if start == b"BLENDER" else end.endswith(struct.pack("<I", 0x8F92EAB1))


def _whole_json(file: IO[bytes], _size: int) -> bool:
    json.load(file)
    return True
