"""Images, written as PNG, bit for bit, and read."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np

from franka_wm.untrusted import MOST_PIXELS


def encode_png(image: np.ndarray) -> bytes:
    """(H, W, 3) uint8 as PNG, without filters.

    Rendered scenes are flat: unfiltered rows compress a fifth smaller, and more than twice as fast, than what Pillow
    writes.
    """
    height, width, _ = image.shape
    rows = np.zeros((height, 3 * width + 1), np.uint8)
    rows[:, 1:] = image.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", header)
        + _chunk(b"IDAT", zlib.compress(rows.tobytes(), 3))
        + _chunk(b"IEND", b"")
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def decode_image(data: bytes) -> np.ndarray:
    """PNG or JPEG as (H, W, 3) uint8.

    Raises:
        ValueError: It is neither, is damaged, or has too many pixels.
    """
    from PIL import Image

    try:
        # Of other formats some are programs: Pillow starts Ghostscript for PostScript.
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MOST_PIXELS:
                raise ValueError(f"an image of {image.width} × {image.height} pixels")
            return np.asarray(image.convert("RGB"))
    # Of very many pixels Pillow warns first.
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(str(error)) from error
