"""Removal of halos: depths beside an object that belong to its edge.

A matcher compares windows. A window in the sky that reaches over the edge of a roof matches best at the depth of the
roof, in all images alike, so that other maps confirm the depth (foreground fattening). These depths surround the object
with a fringe in the colour of its background.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reconstructors.mvs.filter import FilteredMap
from reconstructors.mvs.patchmatch import noise_variance, window_variances

_WINDOW_PX = 3  # side of the windows in which texture is measured; a larger one would leave a wider fringe at the edge
_MAX_PLAIN_TO_NOISE = 4.0  # ratio of variances in a plain window; 1 in 50,000 windows of pure noise exceeds it
_MIN_REGION_PX = 81  # the matcher's windows of 9 x 9 pixels contain texture around smaller regions on all sides
_MIN_KNOWN_SHARE = 0.25  # share of a region's pixels with a depth below which these depths are a fringe


def remove_halos(filtered: FilteredMap, gray: NDArray[np.uint8]) -> FilteredMap:
    """Return a filtered map without the depths of plain regions that are mostly without depths.

    A plain region is a connected part of the image without texture. It shows one surface, or the sky. Where less than a
    quarter of it has depths, these come from windows over its border and not from the surface that it shows.

    Args:
        filtered: filtered map (H, W) of an image.
        gray: the photograph (H, W), undistorted and of the same size.
    """
    halo = find_halos(filtered.depth_map.known, gray)
    return FilteredMap(filtered.depth_map.where(~halo), filtered.agreement & ~halo)


def find_halos(has_depth: NDArray[np.bool_], gray: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the mask (H, W) of the plain regions of which less than a quarter is known, and of their edges.

    Args:
        has_depth: (H, W), True for pixels with a depth.
        gray: the photograph (H, W).
    """
    from scipy.ndimage import binary_dilation, label

    max_variance = max(1.0, _MAX_PLAIN_TO_NOISE * noise_variance(gray))
    regions, count = label(window_variances(gray, _WINDOW_PX) <= max_variance)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    known_sizes = np.bincount(regions[has_depth], minlength=count + 1)
    is_unknown = (sizes >= _MIN_REGION_PX) & (known_sizes < _MIN_KNOWN_SHARE * sizes)
    is_unknown[0] = False  # the textured pixels
    # Windows on the edge contain its contrast. The halo reaches half a window farther.
    reach = np.ones((_WINDOW_PX, _WINDOW_PX), dtype=np.bool_)
    halo: NDArray[np.bool_] = binary_dilation(is_unknown[regions], reach)
    return halo
