"""Commands for photographs, and for scenes and deformations with exact truth: scene, synth city, synth warp."""

from __future__ import annotations

from pathlib import Path

import click

from pcbench.cli.help import GroupOfCommands, command, option
from pcbench.cli.messages import steps, warn_unless
from pcbench.cli.options import (
    FILE,
    FiniteRange,
    cameras_option,
    image_scale_option,
    image_size,
    masks_option,
    quiet_option,
    seed_option,
    size_option,
    triple,
    wgs84_option,
    write_cameras_option,
)
from pcbench.errors import InputError
from pcbench.options import OptionGroup, parse_numbers


@command(short_help="Describe a scene: images, cameras, GPS, masks.")
@click.argument("scene", type=FILE)
@cameras_option()
@masks_option
@image_scale_option
@option(
    "--figure",
    type=FILE,
    metavar="FILE",
    help="File for a PNG picture of the cameras, or of GPS positions.",
    group=OptionGroup.OUTPUT,
)
@wgs84_option("the cameras")
@write_cameras_option
@quiet_option
def scene(
    scene: Path,
    cameras: str,
    masks: Path | None,
    image_scale: float,
    figure: Path | None,
    wgs84: bool,
    write_cameras: Path | None,
    quiet: bool,
) -> None:
    """Describe SCENE, a folder of photographs, with or without cameras.

    Cameras are read from a COLMAP model, transforms.json, Strecha's .camera files, an OpenMVS scene, an Earth Studio
    export, the cameras.json of Gaussian splats or Metashape's XML.
    Intrinsics alone may come from K.txt.
    """
    from pcbench.io.outputs import check_output
    from pcbench.scenes import read_scene

    if write_cameras is not None:
        from pcbench.scenes.write import check_cameras_not_replaced

        check_cameras_not_replaced(write_cameras, scene, None if cameras in ("auto", "none") else Path(cameras))
    warn = warn_unless(quiet)
    on_warning = (lambda text: None if "--wgs84" in text else warn(text)) if wgs84 else warn
    with steps(quiet) as step:
        step(f"reading {scene}")
        data = read_scene(scene, cameras=cameras, masks=masks, image_scale=image_scale, on_warning=on_warning)
        if wgs84:
            data = data.in_wgs84()
        if figure is not None:
            from pcbench.report.plot.cameras import draw_cameras

            check_output(figure, [*(data.folder / name for name in data.images), *data.masks.values()])
            step(f"drawing {figure}")
            draw_cameras(data, figure)
        if write_cameras is not None:
            from pcbench.scenes import write_cameras as write

            step(f"writing {write_cameras}")
            write(write_cameras, data.cameras, data.folder, data.points)
    if not quiet:
        for line in data.describe():
            click.echo(line)


@click.group(cls=GroupOfCommands, short_help="Scenes and deformations with exact truth.")
def synth() -> None:
    """Render images of a city with exact truth, or deform a cloud by a known amount."""


@synth.command(short_help="Build a city, render photographs of it, and write the exact truth.")
@option("--out", type=FILE, metavar="FOLDER", required=True, help="Folder for the scene, new or empty.")
@option("--images", default=40, show_default=True, type=click.IntRange(1, 9999), help="Number of images.")
@size_option("960x540")
@option(
    "--fov",
    default=40.0,
    show_default=True,
    type=click.FloatRange(1, 120),
    help="Vertical field of view in degrees.",
    group=OptionGroup.PHOTOGRAPHS,
)
@option(
    "--rig",
    default="circles",
    show_default=True,
    help="Flight: circles (seven, as in Gao et al.), grid (vertical), oblique, drone or orbit (one circle).",
    values=("circles", "grid", "oblique", "drone", "orbit"),
)
@option(
    "--distortion",
    default="0,0,0,0",
    show_default=True,
    metavar="K1,K2,P1,P2",
    help="Lens distortion.",
    group=OptionGroup.PHOTOGRAPHS,
)
@option(
    "--gps",
    type=FiniteRange(min=0),
    help="Write gps.txt with errors of this standard deviation in metres, twice that in height.",
    group=OptionGroup.PHOTOGRAPHS,
)
@option("--extent", default=400.0, show_default=True, help="Side of the city in metres.", group=OptionGroup.CITY)
@option("--density", default=0.85, show_default=True, help="Share of the lots with a building.", group=OptionGroup.CITY)
@option(
    "--height", default=9.0, show_default=True, help="Median height of the houses in metres.", group=OptionGroup.CITY
)
@option("--relief", default=2.0, show_default=True, help="RMS height of the terrain in metres.", group=OptionGroup.CITY)
@option(
    "--texture",
    default=1.0,
    show_default=True,
    help="Texture from 1 (rich) to 0 (blank walls and plain ground).",
    group=OptionGroup.CITY,
)
@option("--water", is_flag=True, help="Turn some blocks into lakes.", group=OptionGroup.CITY)
@option("--repeated", is_flag=True, help="Give all buildings the same facade and roof.", group=OptionGroup.CITY)
@option(
    "--symmetric",
    is_flag=True,
    help="Make the city the same after a half turn about its centre.",
    group=OptionGroup.CITY,
)
@option("--hard", is_flag=True, help="Short for --texture 0.1 --water --repeated.", group=OptionGroup.CITY)
@option("--reflections", is_flag=True, help="Render reflections in glass and water.", group=OptionGroup.PHOTOGRAPHS)
@option(
    "--vignetting",
    is_flag=True,
    help="Darken images towards the corners (natural vignetting, cos^4 law).",
    group=OptionGroup.PHOTOGRAPHS,
)
@option(
    "--points",
    default=1_000_000,
    show_default=True,
    type=click.IntRange(1000),
    help="Number of points of the cloud in truth/.",
)
@seed_option()
@quiet_option
def city(
    out: Path,
    images: int,
    size: str,
    fov: float,
    rig: str,
    distortion: str,
    gps: float | None,
    extent: float,
    density: float,
    height: float,
    relief: float,
    texture: float,
    water: bool,
    repeated: bool,
    symmetric: bool,
    hard: bool,
    reflections: bool,
    vignetting: bool,
    points: int,
    seed: int,
    quiet: bool,
) -> None:
    """Build a city and render photographs of it.

    Writes images, cameras (COLMAP, transforms.json), and in truth/ the mesh, a cloud of its surface and a depth map for
    each image. The same settings give the same bytes on the same machine.
    """
    from dataclasses import replace

    from pcbench.geometry.cameras import Intrinsics
    from pcbench.scenes.synthetic.files import SceneSettings, write_scene
    from pcbench.scenes.synthetic.plan import CitySettings
    from pcbench.scenes.synthetic.render import Optics

    pixels, coefficients = image_size(size), parse_numbers("--distortion", distortion, float)
    if len(coefficients) != 4:
        raise InputError(f"expected --distortion as four numbers k1,k2,p1,p2, got {distortion!r}")
    intrinsics = replace(Intrinsics.from_fov(*pixels, fov), distortion=coefficients)
    town = CitySettings(extent, density, height, relief, texture, water, repeated, symmetric, seed)
    town = town.hard() if hard else town
    optics = Optics(vignetting=1.0 if vignetting else 0.0)
    settings = SceneSettings(town, images, intrinsics, rig, optics, reflections, points, gps)
    with steps(quiet) as step:
        write_scene(out, settings, step)
    if not quiet:
        click.echo(f"{out}: {images} images of {pixels[0]} x {pixels[1]}, with cameras and exact truth")


@synth.command(short_help="Deform a cloud by a known amount.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@option(
    "--kind",
    required=True,
    help="Kind of deformation: dome, bowl, shear, twist, subsidence or drift.",
    values=("dome", "bowl", "shear", "twist", "subsidence", "drift"),
)
@option("--rms", required=True, type=float, help="RMS displacement that no affine map explains, in the cloud's unit.")
@option(
    "--rotate",
    default="0,0,0",
    show_default=True,
    metavar="X,Y,Z",
    help="Rotation about each axis in degrees, after the deformation.",
)
@option(
    "--shift",
    default="0,0,0",
    show_default=True,
    metavar="X,Y,Z",
    help="Translation in the cloud's unit, after the rotation.",
)
@option("--scale", default=1.0, show_default=True, help="Scale, after the deformation.")
@option(
    "--about",
    default="centre",
    show_default=True,
    metavar="PLACE",
    help="Centre of rotation and scale: centre (of the cloud's bounding box), origin, or X,Y,Z.",
    values=("centre", "origin"),
)
@quiet_option
def warp(
    cloud: Path, out: Path, kind: str, rms: float, rotate: str, shift: str, scale: float, about: str, quiet: bool
) -> None:
    """Write a deformed CLOUD to OUT, and the deformation as JSON (OUT with .json added).

    dome lowers and bowl raises the edges relative to the centre; shear displaces horizontally with the square of the
    height; twist rotates with height; subsidence is a local basin; drift bends the longest axis. Then the cloud is
    rotated and scaled about --about, and shifted.
    """
    from pcbench.geometry.crs import check_lengths
    from pcbench.io import read_cloud
    from pcbench.io.outputs import check_output
    from pcbench.scenes.synthetic.warp import make_warp, record_path, similarity_from_angles, write_warped

    for path in (out, record_path(out)):
        check_output(path, (cloud,))
    angles, offset = triple("--rotate", rotate), triple("--shift", shift)
    if about not in ("centre", "origin") and about.count(",") != 2:
        raise InputError(f"expected --about as centre, origin or three numbers x,y,z, got {about!r}")
    center = None if about in ("centre", "origin") else triple("--about", about)
    with steps(quiet) as step:
        step(f"reading {cloud}")
        data = read_cloud(cloud, on_warning=warn_unless(quiet))
        check_lengths(data, str(cloud))
        lower, upper = data.bounds
        pivot = center or ((lower + upper) / 2 if about == "centre" else (0.0, 0.0, 0.0))
        motion = similarity_from_angles(angles, offset, scale, pivot)
        step(f"deforming, writing {out}")
        unit = f" {data.unit}" if data.unit else ""
        record = write_warped(out, data, make_warp(kind, data.points, rms, motion))
    if not quiet:
        click.echo(f"{out}: {len(data):,} points, {kind} of {record['rms_beyond_affine']:.6g}{unit} RMS beyond affine")
