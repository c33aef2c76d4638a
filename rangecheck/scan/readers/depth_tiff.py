"""Grey TIFF files (TIFF 6.0) of 8 or 16 bits or of 32-bit floats as distances; one page, any compression that Pillow reads."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.scan.readers.limits import check_cells, check_holds

MAGIC = (b"II*\0", b"MM\0*")
_BYTES = {"L": 1, "I;16": 2, "I;16B": 2, "F": 4}
#: LZW's codes of 12 bits stand for at most 4096 bytes
_RATIO = 4096


def read_tiff(path: Path) -> npt.NDArray[Any]:
    """Counts (h, w) uint8 or uint16, or values float32. Raises InputError for colour, other depths, many pages and damage."""
    from PIL import Image

    content = read_bytes(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = Image.open(io.BytesIO(content), formats=("TIFF",))
            width, height = picture.size
            check_cells(path, width, height)
            if picture.mode not in _BYTES:
                raise InputError(
                    path,
                    f"is a TIFF of kind {picture.mode}; distances are grey, 8 or 16 bits or 32-bit floats",
                    mode=picture.mode,
                )
            check_holds(path, width * height * _BYTES[picture.mode] // _RATIO, len(content), f"{width} x {height} cells")
            pages = int(getattr(picture, "n_frames", 1))
            if pages != 1:
                raise InputError(path, f"holds {pages} pages; a depth picture is one page: save them one by one")
            values = np.asarray(picture)
    except InputError:
        raise
    except (MemoryError, RecursionError):
        raise InputError(path, "is a damaged TIFF file: it asks for more memory than its size allows") from None
    except Exception as error:  # Pillow's decoders raise whatever a damaged tag leads them to
        raise InputError(
            path, f"is a damaged TIFF file ({str(error).splitlines()[0][:120] if str(error) else type(error).__name__})"
        ) from None
    if values.shape != (height, width):
        raise InputError(path, f"decodes to {values.shape}, not to the {height} x {width} cells of its header")
    return values.astype(values.dtype.newbyteorder("="))
