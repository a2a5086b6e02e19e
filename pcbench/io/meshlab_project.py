"""Read MeshLab projects (`.mlp`): which files they place, and where."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.files import errors_named
from pcbench.regular_files import read_text

_MAX_NAME_LENGTH = 40  # of names of elements in messages


class ProjectMesh(NamedTuple):
    """One file of a project.

    Attributes:
        file: its path; a relative name is in the folder of the project.
        matrix: (4, 4) transform from the coordinates of the file to those of the project, with all digits of the text.
    """

    file: Path
    matrix: FloatArray


def read_meshlab_project(path: Path) -> tuple[ProjectMesh, ...]:
    """Read the files of the first group of meshes of a project, with their transforms; the files are not opened.

    Raises:
        InputError: it is not a MeshLab project, has no mesh, or a mesh lacks its file name or has an unusable matrix.
            The message starts with the path.
    """
    with errors_named(path):
        text = read_text(path)
        if "<!ENTITY" in text:  # entities may expand without bound
            raise InputError("expected a MeshLab project without entity declarations (<!ENTITY): remove them")
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise InputError(f"expected a MeshLab project (XML): {error}") from None
        if root.tag != "MeshLabProject":
            raise InputError(f"expected a MeshLab project, got XML of <{root.tag[:_MAX_NAME_LENGTH]}>")
        group = root.find("MeshGroup")
        meshes = [] if group is None else group.findall("MLMesh")
        if not meshes:
            raise InputError("expected at least one MLMesh in a MeshGroup, got none: save the project with its scans")
        return tuple(_mesh(mesh, number, path.parent) for number, mesh in enumerate(meshes, 1))


def _mesh(mesh: ElementTree.Element, number: int, folder: Path) -> ProjectMesh:
    name = mesh.get("filename", "").strip()
    if not name or "\0" in name:
        raise InputError(f"mesh {number}: expected a file name (filename=...), got none")
    return ProjectMesh(folder / name.replace("\\", "/"), _matrix(mesh.findtext("MLMatrix44"), number))


def _matrix(text: str | None, number: int) -> FloatArray:
    if text is None:  # MeshLab omits it for a mesh that was not moved
        return np.eye(4)
    words = text.split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise InputError(f"mesh {number}: expected MLMatrix44 as 16 numbers, got other text") from None
    if len(values) != 16:
        raise InputError(f"mesh {number}: expected MLMatrix44 as 16 numbers, got {len(values)}")
    if not np.isfinite(values).all():
        raise InputError(f"mesh {number}: expected MLMatrix44 of finite numbers, got NaN or Inf")
    return values.reshape(4, 4)
