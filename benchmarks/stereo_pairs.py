"""Two-view matching of real photographs against OpenCV's SGBM: python benchmarks/stereo_pairs.py

Three rectified pairs with disparities from structured light (Middlebury 2005). Shares are of all pixels with a true
disparity, occluded ones included; `wrong` is the share of the found disparities that are off by more than 2 pixels.
"""

import argparse
import importlib.util
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from measure import alternate, limit_threads, setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from data_folder import data_root
from stereo_cases import DISPARITIES, MIN_DISPARITY_PX, PAIRS, Pair, match_pair, read_pair, score_pair

SGBM_BLOCK_PX = 5


def match_sgbm(pair: Pair) -> np.ndarray:
    """Return the disparities (H, W) of OpenCV's semi-global matching (Hirschmuller 2008); NaN where unknown."""
    import cv2

    matcher = cv2.StereoSGBM_create(
        minDisparity=MIN_DISPARITY_PX,
        numDisparities=DISPARITIES,
        blockSize=SGBM_BLOCK_PX,
        P1=8 * SGBM_BLOCK_PX**2,
        P2=32 * SGBM_BLOCK_PX**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=32,
    )
    disparity = matcher.compute(pair.left.gray, pair.right.gray).astype(np.float32) / 16
    return np.where(disparity >= MIN_DISPARITY_PX, disparity, np.nan)


CONTESTANTS: dict[str, Callable[[Pair], np.ndarray]] = {"pcbench": match_pair}
if importlib.util.find_spec("cv2"):
    CONTESTANTS["OpenCV SGBM"] = match_sgbm


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    root = data_root()
    if root is None or not (root / "stereo").is_dir():
        sys.exit("missing: the folder PCBENCH_DATA with stereo/Art, stereo/Books and stereo/Laundry")
    limit_threads(1)
    missing_note = "" if "OpenCV SGBM" in CONTESTANTS else "; missing: cv2 (pip install opencv-python-headless)"
    print(f"{setting()}; one thread, median of {options.runs} alternating runs{missing_note}")
    print(f"{'pair':9}{'size':>9}  {'method':12}{'CPU s':>7}{'< 1 px':>8}{'< 2 px':>8}{'known':>8}{'wrong':>8}")
    for name in PAIRS:
        pair = read_pair(root / "stereo" / name)
        height, width = pair.left.gray.shape
        seconds = alternate({method: partial(run, pair) for method, run in CONTESTANTS.items()}, options.runs)
        for method, run in CONTESTANTS.items():
            score = score_pair(pair, run(pair))
            print(
                f"{name:9}{f'{width}x{height}':>9}  {method:12}{seconds[method].cpu:7.2f}"
                f"{score.one:8.3f}{score.two:8.3f}{score.known:8.3f}{score.wrong:8.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
