"""Write small clouds and meshes with other programs. The files are kept in this folder, so tests need none of them.

    python tests/foreign/make.py

needs laspy, lazrs, plyfile, pypcd4, meshio, trimesh, pandas, open3d, pye57, pycolmap, pymeshlab and ply2splat in the
environment, Debian's cloudcompare and xvfb, and node with the packages @playcanvas/splat-transform,
@mkkellogg/gaussian-splats-3d and three in the folder NODE_FOLDER/node_modules. A program that is missing is named, and
its files stay as they are.
"""

import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
SURFACES, SPLATS_FOLDER = HERE / "surfaces", HERE / "splats"
NODE = Path(os.environ.get("NODE_FOLDER", ".")) / "node_modules"

# Exact in float32 and in three decimals, so that no writer rounds them.
POINTS = np.array(
    [[0, 0, 0.5], [1, 0, 0.25], [2.5, 0.125, 0], [0, 1, 1], [1.5, 1, 0.75], [2, 1.25, -1], [0.25, 2, 0], [1, 2.5, 2]]
)
COLORS = np.array(
    [[255, 0, 0], [0, 255, 0], [0, 0, 255], [12, 34, 56], [200, 100, 50], [1, 2, 3], [255, 255, 255], [128, 64, 32]],
    dtype=np.uint8,
)
NORMALS = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, 0]], float)
INTENSITY = np.array([1, 5, 10, 50, 100, 500, 1000, 4000])
CLASSES = np.array([2, 2, 6, 6, 5, 2, 9, 1])

# A box of 1 x 2 x 3 with outward triangles: area 22, volume 6.
VERTICES = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
TRIANGLES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    + [[1, 5, 7], [1, 7, 3]]
)
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])

# Splats at the points, with harmonics of degree 1, under the names of Kerbl et al. 2023.
SPLATS = dict(zip("xyz", POINTS.T, strict=True)) | dict.fromkeys(("nx", "ny", "nz"), np.zeros(8))
SPLATS |= {f"f_dc_{k}": (COLORS[:, k] / 255 - 0.5) / 0.28209479177387814 for k in range(3)}
SPLATS |= {f"f_rest_{k}": np.linspace(-0.5, 0.5, 8) * (1 - k / 5) for k in range(9)}
SPLATS |= {"opacity": np.linspace(-3, 3, 8)} | {f"scale_{k}": np.linspace(-5, -1, 8) - k for k in range(3)}
SPLATS |= dict(zip(("rot_0", "rot_1", "rot_2", "rot_3"), np.array(
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1], [0.5, 0.5, 0.5, 0.5], [-0.1, 0.3, -0.5, 0.806225775],
     [0.8, 0, -0.6, 0], [0.6, -0.64, 0.48, 0]]
).T, strict=True))  # fmt: skip

# GaussianSplats3D is made for browsers, whose objects it asks for when it is loaded.
KSPLAT = """
import fs from 'fs';
Object.assign(globalThis, {window: {}, self: globalThis, document: {createElement: () => ({getContext: () => null})}});
const [node, source, target, level] = process.argv.slice(1);
const {PlyParser, SplatBufferGenerator} = await import(`${node}/@mkkellogg/gaussian-splats-3d/build/` +
    'gaussian-splats-3d.module.js');
const {Vector3} = await import(`${node}/three/build/three.module.js`);
const data = fs.readFileSync(source);
const splats = PlyParser.parseToUncompressedSplatArray(data.buffer.slice(data.byteOffset,
    data.byteOffset + data.byteLength), 1);
const generator = SplatBufferGenerator.getStandardGenerator(1, Number(level), 0, new Vector3(), 5.0, 4);
fs.writeFileSync(target, Buffer.from(generator.generateFromUncompressedSplatArray(splats).bufferData));
"""


def by_laspy() -> None:
    import laspy

    for name, point_format, version in (("laspy_format_3.las", 3, "1.2"), ("laspy_format_7.laz", 7, "1.4")):
        header = laspy.LasHeader(point_format=point_format, version=version)
        header.scales, header.offsets = [0.001] * 3, [0.0] * 3
        if point_format == 7:
            header.add_extra_dim(laspy.ExtraBytesParams("amplitude", np.float32))
        las = laspy.LasData(header)
        las.x, las.y, las.z = POINTS.T
        las.red, las.green, las.blue = COLORS.T.astype(np.uint16) * 257
        las.intensity, las.classification = INTENSITY, CLASSES
        if point_format == 7:
            las.amplitude = INTENSITY / 8
        las.write(HERE / name)


def by_plyfile() -> None:
    from plyfile import PlyData, PlyElement

    xyz = [("x", "f8"), ("y", "f8"), ("z", "f8")]
    vertex = np.empty(len(POINTS), [*xyz, ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("intensity", "f4")])
    for name, column in zip(vertex.dtype.names, [*POINTS.T, *COLORS.T, INTENSITY], strict=True):
        vertex[name] = column
    for name, text, order in (("ascii", True, "="), ("little", False, "<"), ("big", False, ">")):
        PlyData([PlyElement.describe(vertex, "vertex")], text=text, byte_order=order).write(
            HERE / f"plyfile_{name}.ply"
        )
    # 16-bit colours and alternative names of normals.
    names = ["x", "y", "z", "normalx", "normaly", "normalz", "diffuse_red", "diffuse_green", "diffuse_blue"]
    other = np.empty(len(POINTS), [(name, "u2" if "diffuse" in name else "f4") for name in names])
    for name, column in zip(names, [*POINTS.T, *NORMALS.T, *(COLORS.T.astype(int) * 257)], strict=True):
        other[name] = column
    PlyData([PlyElement.describe(other, "vertex")]).write(HERE / "plyfile_16_bit.ply")
    corners = np.array([tuple(v) for v in VERTICES], xyz)
    faces = np.empty(len(QUADS), [("vertex_indices", "i4", (4,))])
    faces["vertex_indices"] = QUADS
    mesh = [PlyElement.describe(corners, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(mesh, text=True).write(SURFACES / "plyfile_quads.ply")


def by_pypcd4() -> None:
    from pypcd4 import Encoding, PointCloud

    for encoding in (Encoding.BINARY, Encoding.BINARY_COMPRESSED):  # in ascii it rounds packed colours to zero
        packed = PointCloud.encode_rgb(COLORS)
        cloud = PointCloud.from_xyzrgb_points(np.column_stack([POINTS, packed]).astype(np.float32))
        cloud.save(HERE / f"pypcd4_{encoding.value.lower()}.pcd", encoding)
    cloud = PointCloud.from_xyzi_points(np.column_stack([POINTS, INTENSITY]).astype(np.float32))
    cloud.save(HERE / "pypcd4_ascii.pcd", Encoding.ASCII)


def by_open3d() -> None:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    cloud.colors = open3d.utility.Vector3dVector(COLORS / 255)
    cloud.normals = open3d.utility.Vector3dVector(NORMALS)
    write = open3d.io.write_point_cloud
    write(str(HERE / "open3d_ascii.ply"), cloud, write_ascii=True)
    write(str(HERE / "open3d_binary.ply"), cloud)
    write(str(HERE / "open3d_ascii.pcd"), cloud, write_ascii=True)
    write(str(HERE / "open3d_binary.pcd"), cloud)
    write(str(HERE / "open3d_compressed.pcd"), cloud, compressed=True)
    write(str(HERE / "open3d.pts"), cloud)
    write(str(HERE / "open3d.xyz"), cloud)
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(VERTICES), open3d.utility.Vector3iVector(TRIANGLES)
    )
    mesh.compute_vertex_normals()
    for extension in ("ply", "obj", "off", "stl", "glb"):
        open3d.io.write_triangle_mesh(str(SURFACES / f"open3d.{extension}"), mesh)


def by_trimesh() -> None:
    import trimesh

    cloud = trimesh.PointCloud(POINTS, colors=np.column_stack([COLORS, np.full(len(COLORS), 255, np.uint8)]))
    cloud.export(HERE / "trimesh.ply")
    cloud.export(HERE / "trimesh.xyz")
    mesh = trimesh.Trimesh(VERTICES, TRIANGLES, process=False)
    for extension in ("ply", "obj", "off", "stl", "glb"):
        mesh.export(SURFACES / f"trimesh.{extension}")


def by_meshio() -> None:
    import meshio

    mesh = meshio.Mesh(VERTICES, [("triangle", TRIANGLES)])
    for extension in ("ply", "obj", "off", "stl"):
        mesh.write(SURFACES / f"meshio.{extension}")
    meshio.Mesh(VERTICES, [("quad", QUADS)]).write(SURFACES / "meshio_quads.ply")


def by_pymeshlab() -> None:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    colors = np.column_stack([COLORS / 255, np.ones(len(COLORS))])
    meshes.add_mesh(pymeshlab.Mesh(POINTS, v_normals_matrix=NORMALS, v_color_matrix=colors))
    meshes.save_current_mesh(str(HERE / "meshlab.ply"))
    meshes.save_current_mesh(str(HERE / "meshlab.xyz"))
    meshes.save_current_mesh(str(HERE / "meshlab.obj"))
    meshes.add_mesh(pymeshlab.Mesh(VERTICES, TRIANGLES))
    for extension in ("ply", "obj", "off", "stl"):
        meshes.save_current_mesh(str(SURFACES / f"meshlab.{extension}"))


def by_pye57() -> None:
    import pye57

    (HERE / "pye57.e57").unlink(missing_ok=True)
    file = pye57.E57(str(HERE / "pye57.e57"), mode="w")
    x, y, z = POINTS.T
    red, green, blue = COLORS.T
    data = {"cartesianX": x, "cartesianY": y, "cartesianZ": z, "intensity": INTENSITY.astype(float)}
    file.write_scan_raw({**data, "colorRed": red, "colorGreen": green, "colorBlue": blue})
    file.close()


def by_numpy_and_pandas() -> None:
    import pandas

    np.savetxt(HERE / "numpy.txt", np.column_stack([POINTS, COLORS]))
    np.save(HERE / "numpy.npy", POINTS)
    np.savez_compressed(HERE / "numpy.npz", points=POINTS, colors=COLORS)
    table = pandas.DataFrame({"X": POINTS[:, 0], "Y": POINTS[:, 1], "Z": POINTS[:, 2], "Intensity": INTENSITY})
    table.to_csv(HERE / "pandas.csv", index=False)
    table.to_csv(HERE / "pandas_index.csv")  # the index has no name


def by_pycolmap() -> None:
    import pycolmap

    model = pycolmap.Reconstruction()
    for point, color in zip(POINTS, COLORS, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    for kind, write in (("txt", model.write_text), ("bin", model.write_binary)):
        folder = HERE / f"pycolmap_{kind}"
        folder.mkdir(exist_ok=True)
        write(folder)


def by_cloudcompare() -> None:
    with tempfile.TemporaryDirectory() as folder:
        source, surface = Path(folder) / "cloud.txt", Path(folder) / "box.stl"
        np.savetxt(source, np.column_stack([POINTS, COLORS]), fmt=["%.3f"] * 3 + ["%d"] * 3)
        triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *VERTICES[t].ravel(), 0) for t in TRIANGLES)
        surface.write_bytes(bytes(80) + struct.pack("<I", len(TRIANGLES)) + triangles)
        start = ["xvfb-run", "-a", "CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF"]
        for name, options in {
            "cloudcompare.asc": ["ASC", "-PREC", "6", "-ADD_HEADER", "-ADD_PTS_COUNT"],
            "cloudcompare.las": ["LAS"],
            "cloudcompare.pcd": ["PCD"],
            "cloudcompare.ply": ["PLY", "-PLY_EXPORT_FMT", "BINARY_LE"],
            "cloudcompare_ascii.ply": ["PLY", "-PLY_EXPORT_FMT", "ASCII"],
        }.items():
            run = [*start, "-O", source, "-C_EXPORT_FMT", *options, "-SAVE_CLOUDS", "FILE", HERE / name]
            subprocess.run(run, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=60)
        for extension in ("obj", "ply", "stl", "off"):
            target = SURFACES / f"cloudcompare.{extension}"
            run = [*start, "-O", surface, "-M_EXPORT_FMT", extension.upper(), "-SAVE_MESHES", "FILE", target]
            subprocess.run(run, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=60)


def by_splat_programs() -> None:
    import ply2splat

    SPLATS_FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "splats.ply"
        properties = "".join(f"property float {name}\n" for name in SPLATS)
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(POINTS)}\n{properties}end_header\n"
        source.write_bytes(header.encode() + np.column_stack(list(SPLATS.values())).astype("<f4").tobytes())
        ply2splat.convert(str(source), str(SPLATS_FOLDER / "ply2splat.splat"), sort=False)
        transform = [str(NODE / ".bin" / "splat-transform"), "-w", str(source)]
        for name, options in {
            "playcanvas.compressed.ply": [],
            "playcanvas_3.spz": ["--spz-version", "3"],
            "playcanvas_4.spz": ["--spz-version", "4"],
        }.items():
            subprocess.run([*transform, *options, str(SPLATS_FOLDER / name)], check=True, stdout=subprocess.DEVNULL)
        for level in "012":
            target = str(SPLATS_FOLDER / f"mkkellogg_{level}.ksplat")
            script = ["node", "--input-type=module", "-e", KSPLAT, str(NODE.absolute()), str(source), target, level]
            subprocess.run(script, check=True, stdout=subprocess.DEVNULL)


PROGRAMS: tuple[Callable[[], None], ...] = (
    by_laspy,
    by_plyfile,
    by_pypcd4,
    by_open3d,
    by_trimesh,
    by_meshio,
    by_pymeshlab,
    by_pye57,
    by_numpy_and_pandas,
    by_pycolmap,
    by_cloudcompare,
    by_splat_programs,
)

if __name__ == "__main__":
    SURFACES.mkdir(exist_ok=True)
    for program in PROGRAMS:
        if len(sys.argv) == 1 or program.__name__ in sys.argv[1:]:
            try:
                program()
            except (ImportError, FileNotFoundError) as error:
                print(f"{program.__name__}: not run: {error}")
