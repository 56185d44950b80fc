"""The file of an index in memory: an archive of arrays that numpy reads too."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from ._errors import Error, InvalidArgument
from ._wayfold import Index, _restore

_FORMAT = "wayfold index 1"


def save(path: str | os.PathLike[str], content: tuple[Any, ...]) -> None:
    """Writes the content of an index. The file appears whole, or stays as it was."""
    space, inline, next_id, ids, tags, states, holders, ends, payloads = content
    # The file behind a symbolic link is replaced, not the link.
    path = Path(path).resolve()
    name = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    mode = path.stat().st_mode & 0o777 if path.exists() else 0o666
    try:
        with open(name, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            np.savez(
                file,
                format=np.array(_FORMAT),
                space=np.array(space),
                inline=np.array(inline),
                next_id=np.array(next_id, dtype=np.uint64),
                ids=ids,
                tags=tags,
                states=states,
                payload_ids=holders,
                payload_ends=ends,
                payloads=np.frombuffer(payloads, dtype=np.uint8),
            )
            file.flush()
            os.fsync(file.fileno())
        # The mask of the process may have taken bits away.
        if path.exists():
            shutil.copymode(path, name)
        os.replace(name, path)
    except BaseException:
        name.unlink(missing_ok=True)
        raise


def load(path: str | os.PathLike[str]) -> Index:
    """The index of a file that `save` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["format"]) != _FORMAT:
                raise InvalidArgument(f"{path}: the format is {file['format']!s}, not {_FORMAT}", "INVALID_ARGUMENT")
            return _restore(
                str(file["space"]),
                bool(file["inline"]),
                int(file["next_id"]),
                file["ids"],
                file["tags"],
                file["states"],
                file["payload_ids"],
                file["payload_ends"],
                file["payloads"].tobytes(),
            )
    except (Error, MemoryError):
        raise
    except OSError as error:
        # A damaged file makes zipfile seek to a place before its beginning, or is no compressed data. Other errors are
        # those of the system.
        if error.errno not in (None, errno.EINVAL):
            raise
        raise _no_index(path, error) from error
    # numpy, zipfile, and the tokenizer and decompressors below them, each have errors of their own.
    except Exception as error:
        raise _no_index(path, error) from error


def _no_index(path: str | os.PathLike[str], error: Exception) -> InvalidArgument:
    return InvalidArgument(f"{path}: not the file of an index: {error}", "INVALID_ARGUMENT")
