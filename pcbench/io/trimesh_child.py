"""Read a mesh with trimesh in a child process: `trimesh_child.py FILE VERTICES.npy FACES.npy`.

Parsers of formats as rich as glTF trust the sizes in a file, and may crash, hang or request all memory. The parent
limits the time and memory of this process, and reports the file. The script does not import pcbench.
"""

import sys


def main(source: str, vertices: str, faces: str) -> None:
    """Write the vertices and faces of a mesh file as .npy."""
    import numpy as np
    import trimesh

    mesh = trimesh.load_scene(source, process=False).to_mesh()
    np.save(vertices, np.asarray(mesh.vertices, dtype=np.float64))
    np.save(faces, np.asarray(mesh.faces, dtype=np.int64))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except MemoryError:
        sys.exit("it requests more memory than a file of its size can need")
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
