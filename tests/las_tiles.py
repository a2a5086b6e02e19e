"""A cloud as a folder of tiles, as surveys deliver them."""

import numpy as np

from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud


def write_tiles(folder, cloud, tile_size, extension=".laz"):
    """Write a cloud as files tile_0.laz, tile_1.laz, ... of square tiles in a new folder; return the folder.

    Args:
        folder: folder to create.
        cloud: a `Cloud`, or points (N, 3).
        tile_size: side of a tile, in the cloud's unit.
        extension: format of the tiles.
    """
    cloud = cloud if isinstance(cloud, Cloud) else Cloud(cloud)
    folder.mkdir(parents=True)
    cells = np.floor(cloud.points[:, :2] / tile_size).astype(np.int64)
    _, tile = np.unique(cells, axis=0, return_inverse=True)
    tile = tile.reshape(-1)
    order = np.argsort(tile, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(tile[order]) > 0])
    for number, rows in enumerate(np.split(order, starts[1:])):
        write_cloud(folder / f"tile_{number}{extension}", cloud.select(rows))
    return folder
