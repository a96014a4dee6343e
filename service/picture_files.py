"""Pictures as PNG and JPEG files."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

MEDIA_TYPES: Final = {"png": "image/png", "jpg": "image/jpeg"}
_PNG_COMPRESSION: Final = 1
"""Quick: a picture is made while somebody waits for it."""


def picture_file(picture: NDArray[np.uint8], suffix: str, *, jpeg_quality: int) -> bytes:
    """[H, W] gray or [H, W, 3] BGR as a file.

    Args:
        suffix: one of ``MEDIA_TYPES``.
        jpeg_quality: 0 to 100; of no meaning for PNG.
    """
    jpeg, png = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality], [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION]
    return bytes(cv2.imencode(f".{suffix}", picture, jpeg if suffix == "jpg" else png)[1])
