"""Filters of pymeshlab (extra `meshlab`), each run in a child process with limits on time and memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pcbench.children import Limits, run_script
from pcbench.errors import InputError
from pcbench.extras import missing_extra
from pcbench.geometry import meshlab_child
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh
from pcbench.scratch import scratch_folder

_BASE_MEMORY, _BYTES_PER_ROW = 8 << 30, 20_000  # address space for the libraries, and for each vertex, point or face
_BASE_SECONDS, _ROWS_PER_SECOND = 300, 1_000


def decimate(mesh: Mesh, faces: int) -> Mesh:
    """Return a mesh of about `faces` faces, simplified by quadric edge collapse (Garland and Heckbert 1997).

    Borders are preserved.

    Raises:
        InputError: `faces` is not 1 to the number of faces, or pymeshlab fails.
        MissingExtra: pymeshlab is not installed or does not load.
    """
    if not 1 <= faces <= len(mesh):
        raise InputError(f"expected 1 to {len(mesh)} faces (those of the mesh), got {faces}")
    origin = mesh.vertices.mean(axis=0)
    arrays = {"vertex_matrix": mesh.vertices - origin, "face_matrix": mesh.faces.astype(np.int32)}
    vertices, rows = _run("decimate", arrays, faces)
    return replace(mesh, vertices=vertices + origin, faces=rows)


def screened_poisson(points: FloatArray, normals: FloatArray, depth: int) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of the Poisson surface of points (N, 3) with unit normals (N, 3).

    Raises:
        InputError: pymeshlab fails.
        MissingExtra: pymeshlab is not installed or does not load.
    """
    return _run("poisson", {"vertex_matrix": points, "v_normals_matrix": normals}, depth)


def _run(name: str, arrays: dict[str, NDArray[np.generic]], number: int) -> tuple[FloatArray, IntArray]:
    rows = sum(map(len, arrays.values()))
    seconds = _BASE_SECONDS + rows // _ROWS_PER_SECOND
    limits = Limits(seconds=2 * seconds, cpu_seconds=seconds, memory=_BASE_MEMORY + _BYTES_PER_ROW * rows, one_cpu=True)
    with scratch_folder() as folder:
        source, target = folder / "input.npz", folder / "output.npz"
        np.savez(source, allow_pickle=False, **arrays)
        done = run_script(meshlab_child.__file__, name, str(source), str(target), str(number), limits=limits)
        if done.timed_out:
            raise InputError(f"pymeshlab did not finish within {2 * seconds} s: use a smaller cloud or mesh")
        if done.code == meshlab_child.CANNOT_IMPORT:
            kind, _, text = done.last_error_line.partition(": ")
            is_absent = kind == "ModuleNotFoundError" and "pymeshlab" in text
            error = ModuleNotFoundError(text, name="pymeshlab") if is_absent else ImportError(text)
            raise missing_extra("pymeshlab", error)
        if done.code:
            reason = done.last_error_line or f"exit status {done.code}"
            raise InputError(f"pymeshlab failed: {''.join(c if c.isprintable() else ' ' for c in reason)[:200]}")
        with np.load(target, allow_pickle=False) as result:
            return result["vertices"], result["faces"]
