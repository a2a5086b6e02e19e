"""Matching in a process of its own: `match_child DATABASE PAIRS` adds to a database the matches of the pairs that a
file lists, by the names of the images, as COLMAP reads it.
"""

from __future__ import annotations

import sys
from pathlib import Path


def match(database: Path, pairs: Path) -> None:
    """On one thread: where two of COLMAP's build the indices of two images' features at the same time, they now and
    then spoil each other's (pycolmap 4.2.1), and the matches of whole images are others than in the next run.
    """
    import pycolmap

    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(pairs)
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = 1
    options.skip_geometric_verification = True
    pycolmap.match_image_pairs(database, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu)


if __name__ == "__main__":
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    match(Path(sys.argv[1]), Path(sys.argv[2]))
