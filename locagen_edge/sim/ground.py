"""Ground reflection by an image source: the sound comes a second time, from as far below the ground.

Allen & Berkley, "Image method for efficiently simulating small-room acoustics", J. Acoust. Soc. Am. 65 (1979)
943-950, for one flat surface. The reflection coefficient is one number for all frequencies and angles: near 1
over water or concrete, less over grass, which swallows high frequencies first; negative at grazing angles.
"""

from __future__ import annotations

import numpy as np

from locagen_edge.types import F64


def image_m(source_m: F64, ground_z_m: float | F64) -> F64:
    """Mirror image (..., 3) of sources (..., 3), body axes, in the plane z = `ground_z_m` (z points down)."""
    image = np.array(source_m, dtype=np.float64)
    image[..., 2] = 2.0 * ground_z_m - image[..., 2]
    return image
