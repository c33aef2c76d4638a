"""Files that are whole or absent: everything is written beside its final name and then renamed.

Also the one place that hashes inputs and that finds the presets, from a checkout as from an installed wheel.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rangecheck.errors import InputError, OutputError

#: the names under which `whole_file` writes
_PART = re.compile(r"\..+\.[a-z0-9_]{8}\.part(\.[^.]+)?")
#: what this process is writing
_under_way: set[Path] = set()
#: what zipfile and NumPy raise for damaged archives, for headers that lie, and for versions and packings that do not exist
DAMAGED_ARCHIVE = (
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    RuntimeError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    MemoryError,
)


@contextmanager
def whole_file(path: str | Path, *, force: bool = True, durable: bool = True) -> Iterator[Path]:
    """A temporary path beside `path`, with the same ending, that becomes `path` when the block ends without an error. `durable`: it is on the
    disk then, and outlives a loss of power; else only the end of this process.

    Raises OutputError when the folder cannot be written, or when `path` exists and `force` is False."""
    path = Path(path)
    if not force and path.exists():
        raise OutputError(path, "exists already; pass --force to replace it")
    if path.is_dir():
        raise OutputError(path, "is a folder; name a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".part{path.suffix}", dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise OutputError(path, f"cannot be written ({error.strerror}); choose a folder you may write to") from None
    part = Path(name)
    _under_way.add(part)
    try:
        yield part
        if durable:
            with part.open("rb+") as stream:
                os.fsync(stream.fileno())
        part.chmod(0o666 & ~_umask())
        part.replace(path)
    except OSError as error:
        raise OutputError(path, f"could not be written ({error.strerror or error}); nothing was left under that name") from None
    finally:
        _under_way.discard(part)
        with suppress(OSError):
            part.unlink(missing_ok=True)


def drop_parts() -> None:
    """Remove what this process has begun to write and not finished, before it ends without unwinding."""
    for part in tuple(_under_way):
        with suppress(OSError):
            part.unlink(missing_ok=True)


def is_part(path: Path) -> bool:
    """Whether `whole_file` was, or is, writing it."""
    return _PART.fullmatch(path.name) is not None and path.is_file()


def sweep_parts(folder: str | Path) -> None:
    """Remove what `whole_file` left below `folder` when its process was killed; call it only where nobody else writes."""
    for path in Path(folder).rglob(".*.part*"):
        if is_part(path):
            path.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_bytes(path: str | Path, content: bytes, *, force: bool = True, durable: bool = True) -> None:
    """Write `content` whole or not at all; `durable` as of `whole_file`."""
    with whole_file(path, force=force, durable=durable) as part:
        part.write_bytes(content)


def write_json(path: str | Path, document: Any, *, force: bool = True, durable: bool = True) -> None:
    """Write `document` as indented JSON, whole or not at all. NaN is refused: JSON has none."""
    write_bytes(
        path, (json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode(), force=force, durable=durable
    )


def read_json(path: str | Path) -> Any:
    """The document in `path`. NaN and Infinity, which JSON does not have, are refused. Raises InputError."""

    def refuse(word: str) -> Any:
        raise ValueError(f"{word} is not a JSON number")

    try:
        return json.loads(read_bytes(path), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON ({error}); correct it and try again") from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables in a TOML file. Raises InputError."""
    try:
        return tomllib.loads(read_bytes(path).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(path, f"is not valid TOML ({' '.join(str(error).split())}); correct it and try again") from None


def beside(name: str, folder: str | Path) -> str:
    """A file by its name, as a file in `folder` has it: from where the program runs, else in that folder; as it is where it is in neither."""
    there = Path(folder) / name
    return str(there) if not Path(name).is_file() and there.is_file() else name


def read_bytes(path: str | Path, limit: int | None = None) -> bytes:
    """The file's bytes (at most `limit`). Raises InputError in one line when it is missing, a folder, or unreadable."""
    path = Path(path)
    try:
        with path.open("rb") as stream:
            return stream.read() if limit is None else stream.read(limit)
    except FileNotFoundError:
        raise InputError(path, "does not exist; check the name") from None
    except IsADirectoryError:
        raise InputError(path, "is a folder, and a file is needed") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror}); ask for the right to, or copy it") from None


def sha256(path: str | Path) -> str:
    """Hex digest of a file's content, of which no more than a piece is held. Raises InputError."""
    path = Path(path)
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except FileNotFoundError:
        raise InputError(path, "does not exist; check the name") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror}); ask for the right to, or copy it") from None


def presets_folder() -> Path:
    """The folder of shipped presets: `configs/` in a checkout, `presets/` inside an installed package."""
    package = Path(__file__).resolve().parent
    for folder in (package / "presets", package.parent / "configs"):
        if folder.is_dir():
            return folder
    raise InputError(package / "presets", "the shipped presets are missing; install rangecheck again")
