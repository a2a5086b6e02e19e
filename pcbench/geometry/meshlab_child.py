"""Run a filter of pymeshlab: `meshlab_child.py FILTER INPUT.npz OUTPUT.npz NUMBER`.

FILTER is `decimate` (NUMBER: faces to keep) or `poisson` (NUMBER: depth of the octree). pymeshlab is licensed under the
GPL, and a filter may crash or request all memory, so it is imported in this process alone, whose time and memory the
parent limits. The script does not import pcbench.
"""

import sys

CANNOT_IMPORT = 3  # exit code if pymeshlab is not installed or cannot be loaded


def main(name: str, source: str, target: str, number: int) -> None:
    """Apply a filter to the arrays of a file, and write the vertices and faces of its result."""
    import numpy as np

    try:
        import pymeshlab
    except Exception as error:  # importing a library may raise anything
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(CANNOT_IMPORT)
    meshes = pymeshlab.MeshSet(verbose=False)
    with np.load(source, allow_pickle=False) as arrays:
        meshes.add_mesh(pymeshlab.Mesh(**arrays))
    if name == "poisson":
        meshes.generate_surface_reconstruction_screened_poisson(depth=number, threads=1)
    else:
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=number, preservenormal=True, preserveboundary=True
        )
    mesh = meshes.current_mesh()
    vertices, faces = np.array(mesh.vertex_matrix(), np.float64), np.array(mesh.face_matrix(), np.int64)
    np.savez(target, vertices=vertices, faces=faces)


if __name__ == "__main__":
    try:
        main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
    except MemoryError:
        sys.exit("it requests more memory than a mesh of this size can need")
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
