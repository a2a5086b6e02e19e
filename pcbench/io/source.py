"""A path is resolved once into a `Source`, which answers all questions about the cloud or mesh and reads it.

    source = Source.open("tiles/")
    cloud = source.read(print)

`Source.pieces` describes the same points for reading piece by piece.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import degrees_hint
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import vertex_cloud
from pcbench.geometry.splats import filter_splats
from pcbench.io.colmap import model_file
from pcbench.io.contents import (
    FILES_PREFIX,
    FileState,
    FileStatus,
    changed_error,
    combined_digest,
    file_states,
    status_of,
)
from pcbench.io.files import Look, Warn, as_path, check_readable, errors_named, finite_cloud
from pcbench.io.formats import CLOUDS, FILTERABLE_EXTENSIONS, MESHES, MeshFormat
from pcbench.io.gltf import external_files
from pcbench.io.las_records import NO_FILTERS, LasFilters
from pcbench.io.nodata import CoordinateCounts, Nodata, nodata_warning, without_nodata
from pcbench.io.paths import EPT, TileFiles, find_tiles, is_pattern, is_tiled
from pcbench.io.pieces.opening import PIECE_POINTS, describe_pieces
from pcbench.io.pieces.types import CloudOnDisk
from pcbench.io.reading import read_one, read_tiles
from pcbench.regular_files import has_entry

_MESHES_OF_FOLDERS = (".ply", ".obj", ".glb", ".gltf")  # grids of heights are also clouds


@dataclass(frozen=True)
class Source:
    """A cloud or a mesh in a file, or a cloud in several files.

    Attributes:
        path: the path as the user named it: a file, a folder of tiles, a pattern, a `.vpc` index, a folder or ept.json
            of Entwine Point Tiles, or a folder with a COLMAP model.
        file: the points file of the COLMAP model or the ept.json in that folder, otherwise `path`; most messages start
            with it.
        tiles: the files of a folder, a pattern or an index; None: there is one file.
        notes: warnings about the choice of `file`, without the path.
        status: size and times of `file` when it was opened, if it is the only file.
        filters: classes and returns to keep.
        vertices: whether a mesh is read as its vertices.
    """

    path: Path
    file: Path
    tiles: TileFiles | None
    notes: tuple[str, ...]
    status: FileStatus | None
    filters: LasFilters
    vertices: bool

    @classmethod
    def open(cls, path: str | os.PathLike[str], filters: LasFilters = NO_FILTERS, *, vertices: bool = False) -> Source:
        """Find the files of a path; only a `.vpc` index is read, and the headers of possible meshes in a folder.

        Args:
            path: the path.
            filters: classes and returns to keep, which files without these refuse when they are read; see `filtered`.
            vertices: whether a mesh is read as its vertices.

        Raises:
            InputError: there is no such file, or it is empty or no regular file; or an index is damaged. The message
                starts with the path.
        """
        named, notes = as_path(path), list[str]()
        file = model_file(named, notes.append)
        if file == named and named.is_dir() and has_entry(named / EPT):
            file = named / EPT
        tiles = status = None
        with errors_named(file):
            if is_pattern(file) or (is_tiled(file) and not _stores_only_meshes(file)):
                tiles = find_tiles(file, CLOUDS)
                tiles = _without_meshes(tiles) if file.is_dir() else tiles
            else:
                check_readable(file)
                status = status_of(file)
        return cls(named, file, tiles, tuple(notes), status, filters, vertices)

    def filtered(self, filters: LasFilters) -> Source:
        """Return the source with filters if all its files have classes and returns, otherwise the same source."""
        return replace(self, filters=filters) if self.has_classes else self

    @property
    def has_classes(self) -> bool:
        """Return whether all files have classes and returns, by which points can be filtered."""
        return all(
            file.name in FILTERABLE_EXTENSIONS or file.suffix.lower() in FILTERABLE_EXTENSIONS
            for file in self.point_files
        )

    @property
    def kind(self) -> Literal["cloud", "mesh"]:
        """Kind of shape that `read` returns."""
        return "mesh" if self.holds_mesh and not self.vertices else "cloud"

    @property
    def holds_mesh(self) -> bool:
        """Return whether the file is a mesh by its extension, or by its faces if it is PLY or OBJ."""
        return self._look.holds_mesh

    @property
    def is_mesh_only(self) -> bool:
        """Return whether the file's format stores meshes but not clouds."""
        return self.tiles is None and _stores_only_meshes(self.file)

    @property
    def point_files(self) -> tuple[Path, ...]:
        """The files of its points, in their order; of Entwine Point Tiles only ept.json."""
        return (self.file,) if self.tiles is None else self.tiles.paths

    @property
    def files(self) -> tuple[Path, ...]:
        """The named file, index or folder, and all files that are read; no output may replace them or a file within."""
        named = () if is_pattern(self.path) else (self.path,)
        return tuple(dict.fromkeys((*named, *self.point_files)))

    @property
    def nbytes(self) -> int:
        """Size of all files that have its content, in bytes."""
        return sum(file.stat().st_size for file in self.content_files() if file.is_file())

    @property
    def reading_seconds(self) -> float:
        """Estimated seconds that reading takes, for progress bars."""
        return sum(_reading_seconds(file) for file in self.content_files() if file.is_file())

    def read(self, on_warning: Warn) -> Cloud | Mesh:
        """Read a mesh if the file holds one and its vertices are not wanted, otherwise a cloud.

        Args:
            on_warning: callback, called with one line per warning.

        Raises:
            InputError: a file cannot be read. The message starts with its path.
            MissingExtra: an optional library is needed.
        """
        if not self.holds_mesh:
            return self.read_cloud(on_warning)
        return self.read_vertices(on_warning) if self.vertices else self.read_mesh(on_warning)

    def read_cloud(
        self,
        on_warning: Warn,
        *,
        min_opacity: float | None = None,
        max_axis: float | None = None,
        color_depth: int | None = None,
        drop_nodata: bool = False,
    ) -> Cloud:
        """Read the points; arguments and errors are those of `pcbench.read_cloud`."""
        lines = [f"{self.path}: {note}" for note in self.notes]
        if self.tiles is None:
            fields = read_one(self.file, self.filters, color_depth, lines.append, self._look)
        else:
            fields = read_tiles(self.file, self.tiles, self.filters, color_depth, lines.append)
        with self._reporting(lines.append) as warn:
            cloud = finite_cloud(fields, warn)
            if drop_nodata:
                cloud = without_nodata(cloud, warn)
            elif line := nodata_warning(Nodata.of(CoordinateCounts.of(cloud.points))):
                warn(line)
            if cloud.crs is None and cloud.unit is None and (line := degrees_hint(*cloud.bounds)):
                warn(line)
            cloud = filter_splats(cloud, min_opacity, max_axis)
        for line in lines:
            on_warning(line)
        return cloud

    def read_mesh(self, on_warning: Warn) -> Mesh:
        """Read the mesh; errors are those of `pcbench.read_mesh`."""
        with self._reporting(on_warning) as warn:
            return self._mesh_format.read(self.file, warn, **self._look.options)

    def read_vertices(self, on_warning: Warn) -> Cloud:
        """Read the vertices of a mesh; those of PLY and OBJ have normals, colours and attributes."""
        with self._reporting(on_warning) as warn:
            form, options = self._mesh_format, self._look.options
            if form.read_vertices is None:
                return vertex_cloud(form.read(self.file, warn, **options))
            return finite_cloud(form.read_vertices(self.file, warn, **options), warn)

    def pieces(self, piece_points: int = PIECE_POINTS, *, skip_bad: bool = False) -> CloudOnDisk:
        """Describe the cloud from the headers of its files; points are only read from formats without such a header.

        Args:
            piece_points: largest number of points of a piece, if the format allows it: a LAZ chunk, an EPT node, an E57
                scan and a text file are never divided.
            skip_bad: whether damaged and missing files are left out and listed in `left_out`.

        Raises:
            InputError: a file is damaged or missing, or no file is left; files have different coordinate reference
                systems or units; or a filter is not available for a format. The message names the file.
            MissingExtra: an optional library is needed for a file.
        """
        notes = [(self.path, note) for note in self.notes]
        notes += [(self.file, line) for line in (() if self.tiles is None else self.tiles.warnings)]
        return describe_pieces(
            self.file, self.point_files, self.filters, piece_points, skip_bad=skip_bad, notes=notes, look=self._look
        )

    def content_files(self) -> list[Path]:
        """Return all files that have its content at present, with those of EPT nodes and of glTF buffers."""
        if self.file.name == EPT:
            return [file for file in self.file.parent.rglob("*") if file.is_file()]
        if self.tiles is None:
            return [self.file, *external_files(self.file)]
        return [*([self.file] if self.file.is_file() else []), *self.tiles.paths]

    def contents(self) -> dict[Path, FileState]:
        """Read all existing files, by several threads, and return the state of each.

        Raises:
            PcbenchError: a file changes meanwhile.
            OSError: a file cannot be read.
        """
        return file_states(self.content_files())

    def digest(self, contents: Mapping[Path, FileState] | None = None) -> str:
        """Return the SHA-256 of the file; of several files that of names and contents, after `FILES_PREFIX`.

        Args:
            contents: states of the files, such as `contents()`; by default they are read.
        """
        contents = self.contents() if contents is None else contents
        digests = {file: contents[file].sha256 for file in self.content_files() if file in contents}
        if self.tiles is None and not self.path.is_dir() and len(digests) == 1:
            return next(iter(digests.values()))
        return FILES_PREFIX + combined_digest(digests)

    def read_with_digest(self, on_warning: Warn) -> tuple[Cloud | Mesh, str]:
        """Read the cloud or mesh, and return it with its digest.

        Raises:
            InputError, MissingExtra: as `read`.
            PcbenchError: a file changed since it was opened or while it was read.
        """
        before = {file: status_of(file) for file in self.content_files() if file.is_file()}
        if self.status is not None:
            before[self.file] = self.status
        shape, contents = self.read(on_warning), self.contents()
        for file in before | contents:
            if file not in before or file not in contents or contents[file].status != before[file]:
                raise changed_error(file)
        return shape, self.digest(contents)

    @contextmanager
    def _reporting(self, on_warning: Warn) -> Iterator[Warn]:
        """Yield a callback for warnings, which are reported if the block succeeds; they and errors name the file."""
        lines: list[str] = []
        with errors_named(self.file):
            yield lines.append
        for line in lines:
            on_warning(f"{self.file}: {line}")

    @cached_property
    def _look(self) -> Look:
        """The result of one look at the file."""
        return _look_at(self.file) if self.tiles is None else Look(holds_mesh=False)

    @property
    def _mesh_format(self) -> MeshFormat:
        extension = self.file.suffix.lower()
        if extension not in MESHES:
            extensions = ", ".join(MESHES)
            raise InputError(f"expected a mesh file with extension {extensions}; got {extension or 'no extension'!r}")
        return MESHES[extension]


def _without_meshes(tiles: TileFiles) -> TileFiles:
    """Return the files of a folder without buffers of glTF, and without meshes if some are clouds."""
    buffers = {buffer.resolve() for path in tiles.paths for buffer in external_files(path)}
    paths = [path for path in tiles.paths if path.resolve() not in buffers] if buffers else list(tiles.paths)
    meshes = [path for path in paths if path.suffix.lower() in _MESHES_OF_FOLDERS and _look_at(path).holds_mesh]
    if not meshes or len(meshes) == len(paths):
        return TileFiles(tuple(paths), tiles.warnings)
    line = (
        f"left out {len(meshes)} mesh{'es' * (len(meshes) > 1)} beside clouds, such as {meshes[0].name}: name a mesh"
        " itself to read it"
    )
    return TileFiles(tuple(path for path in paths if path not in meshes), (*tiles.warnings, line))


def _look_at(path: Path) -> Look:
    """Return the result of one look at a file; if it is damaged, its reader says so."""
    form = MESHES.get(path.suffix.lower())
    if form is None or form.look is None:
        return Look(holds_mesh=form is not None)
    try:
        return form.look(path)
    except (InputError, OSError):
        return Look(holds_mesh=False)


def _stores_only_meshes(path: Path) -> bool:
    form = MESHES.get(path.suffix.lower())
    return form is not None and form.look is None


def _reading_seconds(file: Path) -> float:
    is_slow = file.suffix.lower().startswith((".laz", ".txt", ".xyz", ".csv", ".pts", ".asc", ".ptx"))
    return 0.02 + file.stat().st_size / (20e6 if is_slow else 200e6)
