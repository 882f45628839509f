"""Video files and contact sheets from frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from eagle_rl.errors import ConfigError

from .offscreen import Frame

_INK = (38, 51, 71)


class Writer(Protocol):
    """Where frames go."""

    def __call__(self, frame: Frame) -> None:
        """Append a frame, RGB, shape (height, width, 3)."""


@contextmanager
def video_writer(path: Path, width: int, height: int, fps: float) -> Iterator[Writer]:
    """Write an H.264 video; the file at ``path`` is replaced when it is complete.

    Args:
        path: name of the video, ending in ``.mp4``.
        width: width of the frames [pixel], even.
        height: height of the frames [pixel], even.
        fps: frames per second.

    Raises:
        ConfigError: the name does not end in ``.mp4``, or the folder cannot be written.
    """
    check_writable(path, ".mp4")
    part = path.with_name(f".{path.stem}.part.mp4")
    rate = Fraction(fps).limit_denominator(1000)
    encoder = imageio_ffmpeg.write_frames(
        str(part),
        (width, height),
        fps=float(rate),
        quality=7,
        macro_block_size=2,
        output_params=["-preset", "veryfast"],
    )
    encoder.send(None)
    try:
        yield lambda frame: encoder.send(np.ascontiguousarray(frame))
        encoder.close()
        part.replace(path)
    finally:
        encoder.close()
        part.unlink(missing_ok=True)


def contact_sheet(frames: Sequence[Frame], columns: int = 3, width: int = 640) -> Frame:
    """Frames over time as one picture, row by row, each ``width`` pixels wide."""
    height = round(width * frames[0].shape[0] / frames[0].shape[1])
    rows = -(-len(frames) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    for index, frame in enumerate(frames):
        tile = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
        sheet.paste(tile, (index % columns * width, index // columns * height))
    return np.asarray(sheet)


def evenly(num_frames: int, num_picks: int) -> list[int]:
    """Indices of ``num_picks`` frames spread over a video, the first and the last among them."""
    return np.unique(np.linspace(0, num_frames - 1, num_picks).round().astype(int)).tolist()


def captioned(frame: Frame, text: str) -> Frame:
    """The frame with a line of text at the top."""
    image = Image.fromarray(frame)
    size = frame.shape[0] // 30
    font = ImageFont.load_default(size)
    ImageDraw.Draw(image).text((size, 0.7 * size), text, _INK, font)
    return np.asarray(image)


def save_picture(path: Path, frame: Frame) -> None:
    """Write a PNG of 256 colours, a third of the size of all of them."""
    check_writable(path, ".png")
    Image.fromarray(frame).quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def check_writable(path: Path, suffix: str) -> None:
    """Refuse a name or folder that cannot take the file, before work is put into it.

    Raises:
        ConfigError: says why.
    """
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{path}: expected a name that ends in {suffix}, got {path.suffix!r}.")
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder, expected the name of a file.")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}. Make it first.")
