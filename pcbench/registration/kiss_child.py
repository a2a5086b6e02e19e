"""Matches features of clouds with KISS-Matcher in a separate process: `kiss_child.py PAIRS.npz MATCHES.npz`.

The library writes messages to standard output, which is discarded, and uses one thread per CPU: the process is started
on a single CPU. It imports nothing of pcbench.
"""

import sys
from typing import Any


def main(pairs: str, matches: str) -> None:
    """Match the features of all pairs of clouds in a file and write the correspondences."""
    import numpy as np
    from kiss_matcher import KISSMatcher, KISSMatcherConfig

    clouds = np.load(pairs)
    arrays: dict[str, Any] = {}
    for k in range(len(clouds.files) // 2):
        # Lengths are in cells: the library's default thresholds assume cells of about one unit.
        matcher = KISSMatcher(KISSMatcherConfig(voxel_size=1.0, use_voxel_sampling=False))
        matcher.match(clouds[f"candidate{k}"].T, clouds[f"reference{k}"].T)
        candidate, reference = (np.array(part).reshape(-1, 3) for part in matcher.get_keypoints_from_faster_pfh())
        rows = np.array(matcher.get_initial_correspondences(), dtype=np.int64).reshape(-1, 2)
        arrays[f"candidate{k}"], arrays[f"reference{k}"] = candidate[rows[:, 0]], reference[rows[:, 1]]
    np.savez(matches, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
