"""Reading of a reference and a candidate for studies of one pair."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pcbench.cli.messages import warn_unless

if TYPE_CHECKING:
    from pcbench.geometry.cloud import Cloud
    from pcbench.geometry.mesh import Mesh


def read_pair(reference: Path, candidate: Path, seed: int, *, quiet: bool) -> tuple[Cloud | Mesh, Cloud]:
    """Read a reference, and a candidate that is sampled if it is a mesh, with a warning that says so.

    Raises:
        InputError: a file cannot be read, or its coordinates are no lengths. The message starts with the path.
    """
    from pcbench.geometry.crs import check_lengths
    from pcbench.geometry.mesh import Mesh
    from pcbench.geometry.mesh_samples import sample_candidate, sampling_notice
    from pcbench.io.source import Source

    warn = warn_unless(quiet)
    first, second = (Source.open(path).read(warn) for path in (reference, candidate))
    for path, shape in ((reference, first), (candidate, second)):
        check_lengths(shape, str(path))
    cloud = sample_candidate(second, first, seed)
    if isinstance(second, Mesh):
        warn(f"{candidate}: {sampling_notice(second, len(cloud), seed, scale=1.0)}")
    return first, cloud
