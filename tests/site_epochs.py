"""Small surveys of a site at several times, with a mound and a pit whose volumes are known."""

import json

import numpy as np

MOUND, PIT = 2.0 * 8 * 6, 1.0 * 6 * 4  # volumes of the two boxes at the last epoch
ZONES = {"heap": (4, 3, 14, 11), "hole": (18, 8, 28, 16)}  # their boxes with a margin
_ORIGIN = np.array([500_000.0, 5_200_000.0, 300.0])


def survey(share, seed, count=6000):
    """Return points (N, 3) of 32 by 20 units with a box of 2 units on it and one of 1 unit in it, times a share."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, [[32], [20]], (2, count))
    heap = 2.0 * ((x > 5) & (x < 13) & (y > 4) & (y < 10))
    hole = 1.0 * ((x > 20) & (x < 26) & (y > 10) & (y < 14))
    z = 0.1 * x + np.sin(y / 6) + share * (heap - hole) + rng.normal(0, 0.02, count)
    return np.column_stack([x, y, z]) + _ORIGIN


def write_surveys(folder, years, write):
    """Write surveys `site_YEAR.xyz` whose changes grow from none to all of the boxes."""
    for number, year in enumerate(years):
        write(folder / f"site_{year}.xyz", survey(number / (len(years) - 1), number))


def write_zones(path, boxes=ZONES):
    """Write zones as GeoJSON."""
    features = []
    for name, (x0, y0, x1, y1) in boxes.items():
        ring = [[x + _ORIGIN[0], y + _ORIGIN[1]] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {"name": name}, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
