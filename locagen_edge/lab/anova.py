"""Two-way analysis of variance with the same number of samples in every cell."""

from __future__ import annotations

from scipy import stats

from locagen_edge.types import F64


def two_way(y: F64) -> tuple[float, float, float]:
    """p values of the first factor, the second, and their interaction, for y (first, second, repeats).

    Sums of squares of a balanced design: Montgomery, *Design and Analysis of Experiments*, section 5.3.
    """
    a, b, n = y.shape
    mean = y.mean()
    rows, columns, within = y.mean(axis=(1, 2)), y.mean(axis=(0, 2)), y.mean(axis=2)
    square_a = b * n * ((rows - mean) ** 2).sum()
    square_b = a * n * ((columns - mean) ** 2).sum()
    square_ab = n * ((within - rows[:, None] - columns[None, :] + mean) ** 2).sum()
    rest = a * b * (n - 1)
    error = ((y - within[:, :, None]) ** 2).sum() / rest
    freedom = (a - 1, b - 1, (a - 1) * (b - 1))
    squares = (square_a, square_b, square_ab)
    p = [float(stats.f.sf(s / f / error, f, rest)) for s, f in zip(squares, freedom, strict=True)]
    return p[0], p[1], p[2]
