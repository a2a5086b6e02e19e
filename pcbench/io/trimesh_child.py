"""Reads a mesh with trimesh in a process of its own: `trimesh_child.py FILE VERTICES.npy FACES.npy`.

Parsers of formats as rich as glTF believe what a file says of itself. Here they may crash, hang or ask for all the
memory there is: the limits that the process is started with end them, and the parent says which file it was. Nothing of
pcbench is imported.
"""

import sys


def main(source: str, vertices: str, faces: str) -> None:
    import numpy as np
    import trimesh

    mesh = trimesh.load_scene(source, process=False).to_mesh()
    np.save(vertices, np.asarray(mesh.vertices, dtype=np.float64))
    np.save(faces, np.asarray(mesh.faces, dtype=np.int64))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except MemoryError:
        sys.exit("it asks for more memory than a file of its size can need")
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
