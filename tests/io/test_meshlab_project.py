"""MeshLab projects: files and transforms, and projects that are refused."""

import numpy as np
import pytest
from wording import check_error

from pcbench.io.meshlab_project import read_meshlab_project

MATRIX = "0 -1 0 0.123456789012345\n1 0 0 -2\n0 0 1 3e5\n0 0 0 1\n"


def write(folder, *meshes, before="<!DOCTYPE MeshLabDocument>\n"):
    path = folder / "scans.mlp"
    path.write_text(f"{before}<MeshLabProject><MeshGroup>{''.join(meshes)}</MeshGroup><RasterGroup/></MeshLabProject>")
    return path


def mesh(matrix, name='filename="a.ply"'):
    return f"<MLMesh {name}><MLMatrix44>{matrix}</MLMatrix44></MLMesh>"


def test_files_are_relative_to_the_project_and_matrices_keep_their_digits(tmp_path):
    path = write(tmp_path, mesh(MATRIX), '<MLMesh filename="sub\\b.ply"/>', '<MLMesh filename="/c/d.ply"/>')
    first, second, third = read_meshlab_project(path)
    assert first.file == tmp_path / "a.ply"
    np.testing.assert_array_equal(first.matrix[:3, 3], [0.123456789012345, -2, 3e5])
    np.testing.assert_array_equal(first.matrix[0, :3], [0, -1, 0])
    assert second.file == tmp_path / "sub/b.ply"
    np.testing.assert_array_equal(second.matrix, np.eye(4))
    assert third.file.as_posix() == "/c/d.ply"


def test_only_the_first_group_of_meshes_is_read(tmp_path):
    path = write(tmp_path, mesh(MATRIX), "</MeshGroup><MeshGroup>", mesh(MATRIX))
    assert len(read_meshlab_project(path)) == 1


@pytest.mark.parametrize(
    "meshes",
    [[], ["<MLMesh/>"], ["<MLMesh"], [mesh("1 " * 15)], [mesh("a " * 16)], [mesh("nan " * 16)], [mesh("", "")]],
)
def test_malformed_projects_are_refused(tmp_path, meshes):
    path = write(tmp_path, *meshes)
    with check_error():
        read_meshlab_project(path)


def test_other_files_are_refused(tmp_path):
    with check_error():
        read_meshlab_project(tmp_path / "missing.mlp")
    for content in (b"", b"<a/>", b"ply\n", b"\xff\xfe\0"):
        (tmp_path / "other.mlp").write_bytes(content)
        with check_error():
            read_meshlab_project(tmp_path / "other.mlp")
    entities = '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]>'
    with check_error():
        read_meshlab_project(write(tmp_path, mesh("&c;"), before=entities))
