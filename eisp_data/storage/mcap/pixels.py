"""From the bytes of a camera image to pixels, with a limit on what they may claim to be."""

from __future__ import annotations

import io

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.mcap.decode import Picture

MAX_PIXELS = 50_000_000
"""The largest image that is decoded; a damaged header may claim 4 billion."""
ENCODINGS: dict[str, tuple[int, tuple[int, ...]]] = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
}
"""Encoding to bytes per pixel and where red, green and blue are; OpenCV's 8UC3 is BGR."""


def size_of(picture: Picture) -> tuple[int, int]:
    """Return (height, width) without decoding the pixels; raises DataError if it cannot be."""
    if picture.encoding is not None:
        size = picture.height, picture.width
    else:
        from PIL import Image, UnidentifiedImageError

        try:
            with Image.open(io.BytesIO(picture.data), formats=("JPEG", "PNG")) as image:
                size = image.height, image.width
        except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
            raise DataError(f"image: neither JPEG nor PNG ({_first_line(error)})") from None
        except Image.DecompressionBombError:
            raise DataError(f"image: more than {MAX_PIXELS} pixels") from None
    if min(size) < 1 or size[0] * size[1] > MAX_PIXELS:
        raise DataError(f"image: {size[0]}x{size[1]} pixels (limit {MAX_PIXELS})")
    return size


def rgb(picture: Picture, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return the image, (H, W, 3) uint8 RGB, resized to ``size`` (height, width) if given."""
    size_of(picture)
    pixels = _raw(picture) if picture.encoding is not None else _compressed(picture.data, size)
    if size is not None and pixels.shape[:2] != size:
        import cv2

        pixels = cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA)
    return pixels


def _compressed(data: bytes, size: tuple[int, int] | None) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
            if size is not None:
                # A JPEG decodes at 1/2, 1/4 or 1/8 for a fraction of the time, still no smaller.
                image.draft("RGB", size[::-1])
            return np.array(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise DataError(f"image: damaged ({_first_line(error)})") from None


def _raw(picture: Picture) -> np.ndarray:
    if picture.encoding not in ENCODINGS:
        raise DataError(
            f"image: encoding {picture.encoding!r}; choose one of {', '.join(ENCODINGS)}"
        )
    depth, order = ENCODINGS[picture.encoding]
    step = picture.step or picture.width * depth
    if step < picture.width * depth or len(picture.data) < step * picture.height:
        raise DataError(
            f"image: {len(picture.data)} bytes do not hold {picture.height} rows of {step}"
        )
    rows = np.frombuffer(picture.data, np.uint8, step * picture.height)
    pixels = rows.reshape(picture.height, step)[:, : picture.width * depth]
    return np.ascontiguousarray(pixels.reshape(picture.height, picture.width, depth)[..., order])


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
