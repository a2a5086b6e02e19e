"""Feature matching in a separate process: `match_child DATABASE PAIRS`.

Adds to a database the matches of the image pairs listed by name in a file in COLMAP's format.
"""

from __future__ import annotations

import sys
from pathlib import Path

from reconstructors.sfm.log import log_without_files


def match(database: Path, pairs: Path) -> None:
    """Match on one thread.

    If two of COLMAP's threads build feature indices at the same time, they sometimes corrupt each other's (pycolmap
    4.2.1), and the matches of entire images differ from run to run.
    """
    import pycolmap

    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(pairs)
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = 1
    options.skip_geometric_verification = True
    pycolmap.match_image_pairs(database, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu)


if __name__ == "__main__":
    log_without_files()
    match(Path(sys.argv[1]), Path(sys.argv[2]))
