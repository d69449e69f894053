"""Video of camera frames: as many frames as rows, always, and quick to read at random."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.files import one_line

CODEC = "h264"
OPTIONS = {"preset": "veryfast", "g": "2", "bf": "0"}
"""A key frame every second frame, as LeRobot does, so that any frame is at most two decodes away;
no B-frames, so that frames are stored in the order of their rows."""
_SMALL = 96
_FINE, _USUAL = ("yuv444p", "8"), ("yuv420p", "23")
"""Pixel format and constant rate factor of frames up to 96 pixels, and of larger ones. In small
frames an object is a few pixels: at 48 x 48 the usual came back at 30 dB, half of the colours and
most edges gone, the fine at 43 dB, for 650 instead of 200 bytes a frame (raw: 6,912)."""


def _encoding(height: int, width: int) -> tuple[str, str]:
    return _FINE if max(height, width) <= _SMALL else _USUAL


def feature_info(fps: int, height: int, width: int) -> dict[str, Any]:
    """Return what LeRobot keeps of an encoding in ``info.json``; its tools encode alike from it."""
    pixel_format, crf = _encoding(height, width)
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": CODEC,
        "video.pix_fmt": pixel_format,
        "video.fps": fps,
        "video.channels": 3,
        "video.g": int(OPTIONS["g"]),
        "video.crf": int(crf),
        "video.preset": OPTIONS["preset"],
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": {"bf": int(OPTIONS["bf"])},
        "has_audio": False,
        "is_depth_map": False,
    }


def encode_video(path: Path, frames: Iterable[np.ndarray], fps: int, threads: int = 0) -> int:
    """Write (H, W, 3) uint8 RGB frames as an MP4 and return how many were written.

    Encoding is synchronous: the caller waits, so no frame is ever dropped.

    Args:
        path: the file to write, overwritten.
        frames: at least one frame, all of one size, height and width even.
        fps: frames per second, also the time base.
        threads: encoder threads; 0 lets the codec decide.
    """
    import av

    count = 0
    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = None
        for count, image in enumerate(frames, start=1):
            if stream is None:
                pixel_format, crf = _encoding(*image.shape[:2])
                options = {**OPTIONS, "crf": crf, "threads": str(threads)}
                stream = container.add_stream(CODEC, rate=fps, options=options)
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = pixel_format
                stream.codec_context.time_base = Fraction(1, fps)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = count - 1, Fraction(1, fps)
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode())
    return count


def decode_video(
    path: Path, start: int, stop: int, fps: int, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """Yield frames ``start`` to ``stop - 1`` of a video as (H, W, 3) uint8 RGB, H x W its size.

    Raises:
        DataError: the file is missing or damaged, has fewer frames, or a frame of another size
            (a header says one size, the stream itself may say another); the text names both.
    """
    import av

    wanted = start
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            if stream.codec_context is None:  # to decode it would end the process
                raise ValueError("unknown codec")
            # Starting threads costs more than decoding a few small frames.
            stream.thread_type = "AUTO" if stop - start > 200 else "NONE"
            base = stream.time_base or Fraction(1, fps)
            container.seek(max(0, round(start / fps / base)), stream=stream, backward=True)
            for frame in container.decode(stream):
                if frame.pts is None or round(float(frame.pts * base) * fps) < wanted:
                    continue
                if wanted >= stop:
                    break
                if (frame.height, frame.width) != size:
                    raise DataError(
                        f"{path}: frame {wanted} is {frame.height} x {frame.width} pixels, not "
                        f"{size[0]} x {size[1]}"
                    )
                yield frame.to_ndarray(format="rgb24")
                wanted += 1
    except (av.FFmpegError, OSError, ValueError, IndexError, AttributeError) as error:
        raise DataError(f"{path}: frame {wanted} cannot be decoded ({one_line(error)})") from None
    if wanted < stop:
        raise DataError(f"{path}: ends at frame {wanted}; frames up to {stop} were expected")


def count_frames(path: Path) -> tuple[int, tuple[int, int]]:
    """Return how many frames a video's packets hold and its (height, width), without decoding.

    Raises:
        DataError: the file is missing or no video.
    """
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            frames = sum(packet.size > 0 for packet in container.demux(stream))
            size = (stream.codec_context.height, stream.codec_context.width)
    except (av.FFmpegError, OSError, ValueError, IndexError, AttributeError) as error:
        raise DataError(f"{path}: not a readable video ({one_line(error)})") from None
    return frames, size


def encode_jpeg(image: np.ndarray) -> bytes:
    """Return (H, W, 3) uint8 RGB as a JPEG of quality 95 with full colour resolution."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=95, subsampling=0)
    return buffer.getvalue()


def decode_jpeg(data: bytes) -> np.ndarray:
    """Return a JPEG's (H, W, 3) uint8 RGB pixels; DataError if it is damaged."""
    from PIL import Image

    try:
        return np.asarray(Image.open(io.BytesIO(data), formats=("JPEG",)).convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(f"a JPEG image cannot be decoded ({one_line(error)})") from None
