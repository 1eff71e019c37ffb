"""The pixel that a texel of the depth pyramid stands for, by recursion, and how an effect fades below a pixel."""

from __future__ import annotations

from typing import Any, Final

LEVELS: Final = 6


def level_at(distance: float, cap: float) -> int:
    """The first level at which a distance in pixels is no more than `cap` texels, or the last one."""
    level = 0
    while level < LEVELS - 1 and distance > cap * 2**level:
        level += 1
    return level


def selected_pixel(valid: Any, row: int, column: int, level: int) -> tuple[int, int]:
    """Row and column of the pixel that the texel over a pixel stands for. `valid` (H, W)."""
    return texel(valid, row // 2**level, column // 2**level, level)


def texel(valid: Any, row: int, column: int, level: int) -> tuple[int, int]:
    """The texel below in the rotated grid - the row by the column's parity, the column by the row's - or the first valid one
    of its neighbour in the row, its neighbour in the column and the one across; it itself where none is valid."""
    if level == 0:
        return row, column
    height, width = (-(-size // 2 ** (level - 1)) for size in valid.shape)
    choices = []
    for other_row, other_column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        r = 2 * row + (column % 2 + other_row) % 2
        c = 2 * column + (row % 2 + other_column) % 2
        if r < height and c < width:
            pixel = texel(valid, r, c, level - 1)
            if valid[pixel]:
                return pixel
            choices.append(pixel)
    return choices[0]


def fade(span: float) -> float:
    """What is left of an obscurance whose radius spans some pixels: smooth from 0 at half a pixel to 1 at one."""
    share = min(max(2 * span - 1, 0.0), 1.0)
    return share**2 * (3 - 2 * share)
