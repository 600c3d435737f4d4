"""The bar below the picture of an episode: what is played, how it went, what was drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]
"""Of a video, shape (height, width, 3)."""

INK, PAPER = (34, 34, 34), (255, 255, 255)
SIZE, LINE, EDGE = 14, 18, 8  # [pixels]: letters, from a line to the next, room around
MOST = 7  # lines of drawn values


@final
@dataclass(frozen=True)
class Caption:
    """Texts below the frames of a video.

    Attributes:
        heads: Lines above.
        drawn: Names and values that were drawn, one after another; as many as fit.
    """

    heads: Sequence[str]
    drawn: Mapping[str, str]

    def below(self, frame: Frame, time: str) -> Frame:
        """Put the bar below a frame.

        Args:
            frame: Shape (height, width, 3).
            time: What stands in the upper right corner of the bar.

        Returns:
            Shape (height + bar, width, 3), both even, as videos want it.
        """
        from PIL import ImageDraw

        bar = self._bar(frame.shape[1]).copy()
        pen = ImageDraw.Draw(bar)
        width = frame.shape[1]
        pen.text((width - EDGE, EDGE), time, fill=INK, font=_font(), anchor="ra")
        whole = np.concatenate([frame, np.asarray(bar, dtype=np.uint8)])
        return even(whole)

    def lines(self, width: int) -> list[str]:
        """Break the texts into lines for a width [pixels]; says how many values do not fit."""
        room = width - 2 * EDGE
        heads = [line for head in self.heads for line in _broken([head], room, " ")]
        texts = [f"{name} {value}" for name, value in self.drawn.items()]
        lines = _broken(texts, room, ",  ")
        fewer = len(texts)
        while len(lines) > MOST and fewer:
            fewer -= 1
            more = f"and {len(texts) - fewer} more"
            lines = _broken([*texts[:fewer], more], room, ",  ")
        return [*heads, *lines]

    def _bar(self, width: int) -> Any:
        return _painted(tuple(self.lines(width)), width)


@cache
def _painted(lines: tuple[str, ...], width: int) -> Any:
    from PIL import Image, ImageDraw

    bar = Image.new("RGB", (width, 2 * EDGE + LINE * len(lines)), PAPER)
    pen = ImageDraw.Draw(bar)
    for number, line in enumerate(lines):
        pen.text((EDGE, EDGE + LINE * number), line, fill=INK, font=_font())
    return bar


@cache
def _font() -> Any:
    import matplotlib
    from PIL import ImageFont

    found = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(found), SIZE)


def _broken(texts: Sequence[str], room: float, between: str) -> list[str]:
    """Put texts one after another into lines; a text that is too long is cut with dots."""
    lines: list[str] = []
    for text in texts:
        longer = f"{lines[-1]}{between}{text}" if lines else text
        if _font().getlength(longer) <= room:
            lines[-1:] = [longer]
        else:
            lines.append(_cut(text, room))
    return lines


def _cut(text: str, room: float) -> str:
    if _font().getlength(text) <= room:
        return text
    while text and _font().getlength(f"{text}…") > room:
        text = text[:-1]
    return f"{text}…"


def even(frame: Frame) -> Frame:
    """Add a row or a column of white, so that height and width are even.

    Example:
        >>> even(np.zeros((3, 4, 3), dtype=np.uint8)).shape
        (4, 4, 3)
    """
    odd = [(0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)]
    return np.pad(frame, odd, constant_values=255)
