"""A handful of shapes on an RGB image, with NumPy alone. Lengths are in pixels; rows grow downwards."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

PAPER: Colour = (250, 250, 247)
FIELD: Colour = (255, 255, 255)
LINE: Colour = (226, 228, 232)
SLATE: Colour = (72, 82, 96)
BLUE: Colour = (46, 110, 196)
GREEN: Colour = (52, 160, 104)
PALE_GREEN: Colour = (222, 242, 230)
RED: Colour = (208, 76, 62)
GREY: Colour = (178, 184, 192)


def blank(height: int, width: int, colour: Colour = PAPER) -> Image:
    """Return an image of one colour, shape (height, width, 3)."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = colour
    return image


def box(image: Image, top: int, left: int, height: int, width: int, colour: Colour, radius: float = 0.0) -> None:
    """Paint a rectangle with rounded corners onto the image; `radius` is at most half of the shorter side."""
    rows = np.arange(height)[:, None] + 0.5 - height / 2
    columns = np.arange(width)[None, :] + 0.5 - width / 2
    # Signed distance to a rounded rectangle: to the inner rectangle, less the radius. Half a pixel on each side of
    # the edge is shaded by how much of it is covered, which is what makes the curves smooth.
    outside_rows = np.maximum(np.abs(rows) - (height / 2 - radius), 0.0)
    outside_columns = np.maximum(np.abs(columns) - (width / 2 - radius), 0.0)
    cover = np.clip(radius + 0.5 - np.hypot(outside_rows, outside_columns), 0.0, 1.0)[:, :, None]
    if radius == 0.0:
        cover = np.ones_like(cover)
    patch = image[top : top + height, left : left + width]
    patch[:] = np.rint(cover * np.array(colour) + (1.0 - cover) * patch).astype(np.uint8)


def disc(image: Image, row: int, column: int, diameter: int, colour: Colour) -> None:
    """Paint a disc around a point."""
    box(image, row - diameter // 2, column - diameter // 2, diameter, diameter, colour, radius=diameter / 2)
