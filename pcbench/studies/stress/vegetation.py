"""Vegetation of a given pair, from the classes of the reference.

Roughness does not tell it at the density of a pair: edges of buildings are as rough as crowns there.
"""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index

VEGETATION_CLASSES = (3, 4, 5)  # low, medium and high vegetation (ASPRS, LAS 1.4, standard point classes)
_MIN_SHARE = 0.01  # of the points, for a pair to have vegetation
_CROWN_SHARE = 0.02  # radius in which a treetop is the highest point, over the extent


def plants_of(points: FloatArray, reference: Cloud, extent: float) -> IntArray | None:
    """Return the number of the plant (M,) at each point of a candidate, -1 for none, or None without vegetation.

    Args:
        points: (M, 3) points of the candidate at its true pose.
        reference: the reference; a point of the candidate has the class of its closest point.
        extent: extent of the scene.
    """
    classes = reference.attributes.get("classification")
    if classes is None:
        return None
    green = np.isin(classes, VEGETATION_CLASSES)[Index(reference.points).query(points).indices.ravel()]
    if green.mean() < _MIN_SHARE:
        return None
    plants = np.full(len(points), -1)
    plants[green] = crowns(points[green], _CROWN_SHARE * extent)
    return plants


def crowns(points: FloatArray, radius: float) -> IntArray:
    """Return the number of the crown (M,) of each point: it climbs to the highest point nearby until it is at a top.

    Treetops are local maxima of the height, as Popescu and Wynne, "Seeing the trees in the forest", 2004, find them.
    """
    flat = np.column_stack([points[:, :2], np.zeros(len(points))])
    near = Index(flat).query_radius(flat, radius)
    start = np.repeat(np.arange(len(points)), near.counts)
    rank = np.empty(len(points), np.int64)
    rank[np.argsort(points[:, 2], kind="stable")] = np.arange(len(points))
    top = np.zeros(len(points), np.int64)
    np.maximum.at(top, start, rank[near.indices])
    higher = np.argsort(rank)[top]
    while not np.array_equal(further := higher[higher], higher):
        higher = further
    return np.unique(higher, return_inverse=True)[1].ravel()
