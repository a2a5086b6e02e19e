r"""Measure photogrammetric noise for the ladders `noise-mvs` and `noise-splat` of `pcbench stress`, and check them.

Each scene is a folder that `pcbench synth city --extent SIDE` wrote to FOLDER/city, with the clouds FOLDER/cloud.ply of
`pcbench reconstruct mvs` or FOLDER/splat.ply of `pcbench reconstruct splat`, both with the exact cameras. Points in the
built square of SIDE metres are measured. The bundled patches and the statistics that the tests compare with are from

    python benchmarks/photogrammetric_noise.py --mvs a11:100 c16:120 d12:120 --splat a11:100 \
        --check-mvs c13:120 w17:150 --check-splat c13:120 --out pcbench/studies/stress/ladders \
        --statistics tests/studies/stress/photogrammetric_noise.json

with these settings of `synth city`; the splats have `--set steps=1500`:

    a11  --images 20 --size 480x320 --extent 100 --rig oblique --seed 11
    c13  --images 48 --size 320x180 --extent 120 --rig circles --seed 13
    c16  --images 48 --size 320x180 --extent 120 --rig circles --seed 16
    d12  --images 24 --size 480x320 --extent 120 --rig drone --seed 12
    w17  --images 30 --size 480x270 --extent 150 --rig grid --seed 17

Without `--out` the bundled patches are checked. The table has quantiles in units of the NMAD, correlations at distances
in spacings, and the distance at which they are half of the first.
"""

import argparse
import json
import sys
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from noise_statistics import LAGS, SHARES, STATISTICS, correlation_length, statistics

from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.io import read_cloud
from pcbench.io.meshes import read_mesh
from pcbench.measure.metrics import nmad
from pcbench.studies.stress.ladders.photogrammetric import (
    EDGE_RADIUS,
    PATCH_CELLS,
    PATCHES,
    STRATA,
    encode_patches,
    measured_patches,
    resampled_errors,
    strata_of,
)

Array = NDArray[np.float64]

COLUMNS = (1.5, 4.0, 8.0, 16.0)  # lags in the printed table, in spacings
CLOUDS = {"mvs": "cloud.ply", "splat": "splat.ply"}
PATCH_COUNT = 24  # patches of each stratum
DRAWS = 300  # draws of patches, of which the one with the quantiles closest to those of all points is kept
POOL, MAX_TRIALS = 80, 6000  # patches of a scene and a stratum to draw from, and centres tried for them
FILLERS = 4  # nearest cells with a point, of which one fills an empty cell
MIN_FILLED = (0.25, 0.08, 0.04, 0.04)  # share of the cells of a patch that hold a point, by stratum
SURFACE_POINTS = 400_000  # samples of the true surface that tell edges


class Field(NamedTuple):
    """Measured errors in units of their NMAD, at the closest points of the surface.

    Attributes:
        errors: (N,) signed distances from the surface.
        surface: (N, 3) closest points of the surface.
        normals: (N, 3) normals there.
        strata: (N,) index into `STRATA`.
        spacing: median spacing of the cloud, in metres.
        nmad: NMAD of the errors, in metres.
    """

    errors: Array
    surface: Array
    normals: Array
    strata: NDArray[np.int64]
    spacing: float
    nmad: float


def measured_field(folder: Path, side: float, method: str) -> Field:
    """Return the errors of a cloud in the built square of its city."""
    points = read_cloud(folder / CLOUDS[method]).points
    points = points[np.abs(points[:, :2]).max(axis=1) < side / 2]
    mesh = read_mesh(folder / "city" / "truth" / "mesh.ply")
    matches = MeshIndex(mesh).query(points)
    normals = mesh.normals()[matches.faces]
    outside = np.einsum("ni,ni->n", points - matches.closest, normals) >= 0
    errors = np.where(outside, matches.distances, -matches.distances)
    spacing = median_spacing(Index(points))
    truth = mesh.sample(SURFACE_POINTS, 0)
    surface = Index(np.concatenate([truth.points, matches.closest]))
    directions = np.concatenate([truth.normals, normals])
    strata = strata_of(normals, matches.closest, surface, directions, EDGE_RADIUS * spacing)
    size = nmad(errors)
    return Field(errors / size, matches.closest, normals, strata, spacing, size)


def patch_of(field: Field, stratum: int, rng: np.random.Generator) -> Array | None:
    """Return the errors about a random point of a stratum as a grid (cells, cells), or None if it is too sparse.

    A cell has the error of a random point in it. An empty one has that of one of the nearest cells with a point: always
    the nearest would make neighbours equal.
    """
    rows = np.flatnonzero(field.strata == stratum)
    centre = rng.choice(rows)
    reach = PATCH_CELLS * field.spacing
    near = rows[(np.abs(field.surface[rows] - field.surface[centre]) < reach).all(axis=1)]
    near = near[field.normals[near] @ field.normals[centre] > 0.9]
    normal = field.normals[centre]
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    u = np.cross(helper, normal)
    u /= np.linalg.norm(u)
    axes = np.stack([u, np.cross(normal, u)], axis=1)
    cells = np.floor((field.surface[near] - field.surface[centre]) @ axes / field.spacing + PATCH_CELLS / 2).astype(int)
    inside = ((cells >= 0) & (cells < PATCH_CELLS)).all(axis=1)
    chosen = rng.permutation(np.flatnonzero(inside))
    filled, first = np.unique(cells[chosen], axis=0, return_index=True)
    if len(filled) < MIN_FILLED[stratum] * PATCH_CELLS**2:
        return None
    flat = Index(np.column_stack([filled, np.zeros(len(filled))]).astype(float))
    grid = np.stack(np.meshgrid(*[np.arange(PATCH_CELLS)] * 2, indexing="ij"), axis=2).reshape(-1, 2)
    near_cells = flat.query(np.column_stack([grid, np.zeros(len(grid))]).astype(float), FILLERS)
    filler = np.where(near_cells.distances[:, 0] == 0, 0, rng.integers(FILLERS, size=len(grid)))
    nearest = near_cells.indices[np.arange(len(grid)), filler]
    patch: Array = field.errors[near][chosen[first]][nearest].reshape(PATCH_CELLS, PATCH_CELLS)
    return patch


def measured_strata(fields: list[Field], rng: np.random.Generator) -> Array:
    """Return patches (strata, patches, cells, cells), in equal numbers from each scene."""
    shares = np.linspace(0.005, 0.995, 100)
    strata = []
    for stratum in range(len(STRATA)):
        wanted = np.mean([np.arcsinh(np.quantile(f.errors[f.strata == stratum], shares)) for f in fields], axis=0)
        pools = []
        for field in fields:
            drawn = (patch_of(field, stratum, rng) for _ in range(MAX_TRIALS))
            pools.append(list(islice((patch for patch in drawn if patch is not None), POOL)))
            assert len(pools[-1]) == POOL, (STRATA[stratum], len(pools[-1]))
        best, smallest = None, np.inf
        for _ in range(DRAWS):
            draw = np.array(
                [pools[k % len(pools)][rng.integers(len(pools[k % len(pools)]))] for k in range(PATCH_COUNT)]
            )
            misfit = np.square(np.arcsinh(np.quantile(draw, shares)) - wanted).sum()
            if misfit < smallest:
                best, smallest = draw, misfit
        strata.append(best)
    return np.array(strata)


def check(field: Field, patches: Array, rng: np.random.Generator) -> dict[str, dict[str, list[float]]]:
    """Return the statistics of measured errors and of errors generated on the same surface, all and of two strata."""
    made = resampled_errors(field.surface, field.normals, patches, field.spacing, rng)
    results = {}
    for kind, errors in (("measured", field.errors), ("generated", made / nmad(made))):
        results[kind] = statistics(errors, field.surface, field.normals, field.spacing)
        for stratum in (0, 1):
            rows = field.strata == stratum
            name = f"{kind} {STRATA[stratum]}"
            results[name] = statistics(errors[rows], field.surface[rows], field.normals[rows], field.spacing)
    return results


def scenes(texts: list[str], root: Path) -> dict[str, tuple[Path, float]]:
    """Return folders and sides in metres by name, from texts such as `a11:100`."""
    parts = [text.split(":") for text in texts]
    return {name: (root / name, float(side)) for name, side in parts}


def row_of(name: str, values: dict[str, list[float]]) -> str:
    """Return quantiles, correlations, and the lag at which the correlation is halved, as a row of the table."""
    correlations = [values["correlations"][LAGS.index(lag)] for lag in COLUMNS]
    numbers = [*values["quantiles"], *correlations, correlation_length(values["correlations"])]
    return f"{name:22}" + "".join(f"{number:8.2f}" for number in numbers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for method in CLOUDS:
        parser.add_argument(f"--{method}", nargs="*", default=[], metavar="NAME:SIDE", help="scenes to measure")
        parser.add_argument(
            f"--check-{method}", nargs="*", default=[], metavar="NAME:SIDE", help="scenes to check with"
        )
    parser.add_argument("--root", type=Path, default=Path(), help="folder of the scenes")
    parser.add_argument("--out", type=Path, help="folder for the patches")
    parser.add_argument("--statistics", type=Path, help=f"file for the statistics of the checks, {STATISTICS.name}")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    made = {}
    for method in CLOUDS:
        fields = []
        for name, (folder, side) in scenes(getattr(arguments, method), arguments.root).items():
            fields.append(field := measured_field(folder, side, method))
            print(
                f"{method} {name}: {len(field.errors):,} points, spacing {field.spacing:.3g} m,"
                f" NMAD {field.nmad / field.spacing:.2f} spacings,"
                " NMAD of strata "
                + ", ".join(f"{n} {nmad(field.errors[field.strata == k]):.2g}" for k, n in enumerate(STRATA)),
                flush=True,
            )
        if fields:
            made[method] = measured_strata(fields, rng)
    if arguments.out and made:
        codes = {method: encode_patches(patches) for method, patches in made.items()}
        np.savez_compressed(arguments.out / PATCHES, **codes)
        print(f"wrote {arguments.out / PATCHES}: {(arguments.out / PATCHES).stat().st_size:,} bytes")
    rows: list[str] = []
    results: dict[str, dict[str, dict[str, dict[str, list[float]]]]] = {}
    for method in CLOUDS:
        for name, (folder, side) in scenes(getattr(arguments, f"check_{method}"), arguments.root).items():
            field = measured_field(folder, side, method)
            found = check(field, measured_patches(method), rng)
            results.setdefault(method, {})[name] = found
            for kind in ("measured", "generated"):
                rows.append(row_of(f"{method} {name}, {kind}", found[kind]))
    if rows:
        quantiles, lags = (f"{100 * share:g} %" for share in SHARES), (f"r({lag:g})" for lag in COLUMNS)
        print("".join(f"{text:>8}" for text in (f"{'':22}", *quantiles, *lags, "half at")))
        print("\n".join(rows))
    if arguments.statistics:
        arguments.statistics.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
