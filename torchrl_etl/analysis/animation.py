"""Episodes side by side in a grid, as a video and as a small animation."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from torchrl_etl.extras import extra
from torchrl_etl.io import write_atomically

__all__ = [
    "CAPTION_HEIGHT",
    "FPS",
    "animated_picture",
    "grid_shape",
    "side_by_side",
    "write_animation",
]

FPS = 25
"""Frames per second of the video."""
CAPTION_HEIGHT = 24
"""Pixels above the grid; even, as MP4 encoding requires."""

_SMALL_WIDTH = 640  # pixels, of the animation
_SMALL_SECONDS = 8
_EVERY = 2  # the animation has every second frame


def grid_shape(episodes: int) -> tuple[int, int]:
    """Rows and columns of a grid that is at least as wide as it is high.

    Examples:
        >>> [grid_shape(n) for n in (1, 2, 4, 5)]
        [(1, 1), (1, 2), (2, 2), (2, 3)]
    """
    columns = math.ceil(math.sqrt(episodes))
    return math.ceil(episodes / columns), columns


def side_by_side(sides: Mapping[str, Sequence[np.ndarray]]) -> Iterator[np.ndarray]:
    """Frames [24 + rows H, sides columns W, 3] that show all episodes at once.

    Each episode shows its last frame until the longest one ends.

    Args:
        sides (mapping): captions to episodes, from left to right, with equal numbers of episodes;
            an episode is an array [T, H, W, 3] of uint8.

    Examples:
        >>> short, long = (np.full((t, 16, 20, 3), t, np.uint8) for t in (1, 3))
        >>> frames = list(side_by_side({"before": [short], "after": [long]}))
        >>> len(frames), frames[-1].shape, frames[-1][-1, [0, -1], 0]
        (3, (40, 40, 3), array([1, 3], dtype=uint8))
    """
    episodes = [episode for side in sides.values() for episode in side]
    height, width = episodes[0].shape[1:3]
    rows, columns = grid_shape(len(episodes) // len(sides))
    captions = _captions(list(sides), columns * width)
    for now in range(max(map(len, episodes))):
        frame = np.zeros((CAPTION_HEIGHT + rows * height, captions.shape[1], 3), np.uint8)
        frame[:CAPTION_HEIGHT] = captions
        for number, side in enumerate(sides.values()):
            for place, episode in enumerate(side):
                top = CAPTION_HEIGHT + place // columns * height
                left = (number * columns + place % columns) * width
                frame[top : top + height, left : left + width] = episode[min(now, len(episode) - 1)]
        yield frame


def write_animation(
    folder: Path, sides: Mapping[str, Sequence[np.ndarray]], name: str = "episodes"
) -> list[Path]:
    """Write the frames of :func:`side_by_side` to ``name.mp4`` and, small enough for a page, to
    ``name.webp``. Creates the folder and returns both paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    video, picture = folder / f"{name}.mp4", folder / f"{name}.webp"
    _write_video(video, side_by_side(sides))
    write_atomically(picture, animated_picture(side_by_side(sides)))
    return [video, picture]


def _write_video(path: Path, frames: Iterator[np.ndarray]) -> None:
    with extra("video"):
        import imageio.v2 as imageio
    with TemporaryDirectory(prefix=".", dir=path.parent) as aside:  # ffmpeg needs a file
        whole = Path(aside) / path.name
        with imageio.get_writer(whole, fps=FPS, macro_block_size=1) as writer:
            for frame in frames:
                writer.append_data(frame)
        os.replace(whole, path)


def animated_picture(frames: Iterable[np.ndarray], *, quality: int = 50) -> bytes:
    """A looping WebP of every second frame [H, W, 3] of the first eight seconds at 25 frames per
    second, at most 640 pixels wide. ``quality`` is in 0 to 100.
    """
    with extra("video"):
        from PIL import Image
    images = []
    for frame in islice(frames, 0, _SMALL_SECONDS * FPS, _EVERY):
        image = Image.fromarray(frame)
        image.thumbnail((_SMALL_WIDTH, image.height))
        images.append(image)
    content = BytesIO()
    images[0].save(
        content,
        "WEBP",
        save_all=True,
        append_images=images[1:],
        duration=round(1000 * _EVERY / FPS),
        loop=0,
        quality=quality,
        method=4,
    )
    return content.getvalue()


def _captions(texts: Sequence[str], width: int) -> np.ndarray:
    with extra("video"):
        from PIL import Image, ImageDraw, ImageFont
    strip = Image.new("RGB", (len(texts) * width, CAPTION_HEIGHT), "white")
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(14)
    for number, text in enumerate(texts):
        middle = (number * width + width / 2, CAPTION_HEIGHT / 2)
        draw.text(middle, text, fill="black", font=font, anchor="mm")
    return np.asarray(strip)
