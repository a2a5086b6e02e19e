"""Commands for photographs and for scenes and deformations whose truth is known: scene, synth city, synth warp."""

from __future__ import annotations

from pathlib import Path

import click

from pcbench.cli.messages import steps, warn_unless
from pcbench.cli.options import (
    FILE,
    FiniteRange,
    cameras_option,
    image_scale_option,
    image_size,
    masks_option,
    numbers,
    quiet_option,
    seed_option,
    size_option,
    triple,
    wgs84_option,
    write_cameras_option,
)
from pcbench.errors import InputError


@click.command(short_help="Say what is in a scene: images, cameras, GPS, masks.")
@click.argument("scene", type=FILE)
@cameras_option()
@masks_option
@image_scale_option
@click.option("--figure", type=FILE, help="Draw the cameras, or GPS positions, into this PNG.")
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
    """Say what is in SCENE, a folder of photographs with, perhaps, cameras: a COLMAP model, transforms.json, Strecha's
    .camera files or an Earth Studio export.
    """
    from pcbench.io.files import check_output
    from pcbench.scenes import read_scene

    if write_cameras is not None:
        from pcbench.scenes.write import check_cameras_kept

        check_cameras_kept(write_cameras, scene, None if cameras in ("auto", "none") else Path(cameras))
    say = warn_unless(quiet)
    told = (lambda text: None if "--wgs84" in text else say(text)) if wgs84 else say
    with steps(quiet) as step:
        step(f"reading {scene}")
        data = read_scene(scene, cameras=cameras, masks=masks, image_scale=image_scale, on_warning=told)
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


@click.group(short_help="Scenes and deformations whose truth is known.")
def synth() -> None:
    """Make images of a city whose geometry is known exactly, or bend a cloud by a known amount."""


@synth.command(short_help="Make a city, photographs of it, and their truth.")
@click.option("--out", type=FILE, required=True, help="Folder for the scene: a new or an empty one.")
@click.option("--images", default=40, show_default=True, type=click.IntRange(1, 9999), help="How many.")
@size_option("960x540")
@click.option("--fov", default=40.0, show_default=True, type=click.FloatRange(1, 120), help="Vertical, in degrees.")
@click.option("--rig", default="circles", show_default=True, help="circles, grid, oblique, drone or orbit.")
@click.option("--distortion", default="0,0,0,0", show_default=True, metavar="K1,K2,P1,P2", help="Of the lens.")
@click.option("--gps", type=FiniteRange(min=0), help="Write gps.txt with errors of so many metres.")
@click.option("--extent", default=400.0, show_default=True, help="Side of the city in metres.")
@click.option("--density", default=0.85, show_default=True, help="Share of the lots that are built on.")
@click.option("--height", default=9.0, show_default=True, help="Median height of its houses in metres.")
@click.option("--relief", default=2.0, show_default=True, help="RMS of the terrain's waves in metres.")
@click.option("--texture", default=1.0, show_default=True, help="1 is rich, 0 leaves blank walls and plain ground.")
@click.option("--water", is_flag=True, help="Make some blocks lakes.")
@click.option("--repeated", is_flag=True, help="Give all buildings one facade.")
@click.option("--symmetric", is_flag=True, help="Make the city look the same after half a turn.")
@click.option("--hard", is_flag=True, help="Short for --texture 0.1 --water --repeated.")
@click.option("--reflections", is_flag=True, help="Let glass and water mirror what is around them.")
@click.option("--vignetting", is_flag=True, help="Darken images towards their corners, by the cosine's fourth power.")
@click.option("--points", default=1_000_000, show_default=True, type=click.IntRange(1000), help="Of the true cloud.")
@seed_option("Of everything.")
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
    """Make a city and photograph it: images, cameras (COLMAP, transforms.json), and in truth/ its mesh, a cloud of its
    surface and a depth map for each image. The same settings give the same bytes.
    """
    from dataclasses import replace

    from pcbench.geometry.cameras import Intrinsics
    from pcbench.scenes.synthetic.files import SceneSettings, write_scene
    from pcbench.scenes.synthetic.plan import CitySettings
    from pcbench.scenes.synthetic.render import Optics

    pixels, coefficients = image_size(size), numbers("--distortion", distortion, float)
    if coefficients is None or len(coefficients) != 4:
        raise InputError(f"expected --distortion as four numbers k1,k2,p1,p2, got {distortion!r}")
    intrinsics = replace(Intrinsics.from_fov(*pixels, fov), distortion=coefficients)
    town = CitySettings(extent, density, height, relief, texture, water, repeated, symmetric, seed)
    town = town.hard() if hard else town
    optics = Optics(vignetting=1.0 if vignetting else 0.0)
    settings = SceneSettings(town, images, intrinsics, rig, optics, reflections, points, gps)
    with steps(quiet) as step:
        write_scene(out, settings, step)
    if not quiet:
        click.echo(f"{out}: {images} images of {pixels[0]} x {pixels[1]}, their cameras and their truth")


@synth.command(short_help="Bend a cloud by a known amount.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@click.option("--kind", required=True, help="dome, bowl, shear, twist, subsidence or drift.")
@click.option("--rms", required=True, type=float, help="What no affine map explains, in the cloud's unit.")
@click.option("--rotate", default="0,0,0", show_default=True, metavar="X,Y,Z", help="Degrees about each axis, after.")
@click.option("--shift", default="0,0,0", show_default=True, metavar="X,Y,Z", help="In the cloud's unit, after.")
@click.option("--scale", default=1.0, show_default=True, help="After.")
@click.option(
    "--about",
    default="centre",
    show_default=True,
    metavar="PLACE",
    help="What is turned and scaled about: centre (of the cloud's bounding box), origin, or X,Y,Z.",
)
@quiet_option
def warp(
    cloud: Path, out: Path, kind: str, rms: float, rotate: str, shift: str, scale: float, about: str, quiet: bool
) -> None:
    """Write CLOUD to OUT deformed in a known way, and what was done to it beside, as JSON (OUT with .json added).

    dome and bowl bend it over its horizontal extent; shear leans over with the square of the height; twist turns with
    height; subsidence is a local basin; drift bends the longest axis. A rotation and a scale about the cloud's centre,
    and a shift, follow.
    """
    from pcbench.io import read_cloud
    from pcbench.io.files import check_output
    from pcbench.scenes.synthetic.warp import record_path, turn, warp_of, write_warped

    for path in (out, record_path(out)):
        check_output(path, (cloud,))
    angles, offset = triple("--rotate", rotate), triple("--shift", shift)
    if about not in ("centre", "origin") and about.count(",") != 2:
        raise InputError(f"expected --about as centre, origin or three numbers x,y,z, got {about!r}")
    given = None if about in ("centre", "origin") else triple("--about", about)
    with steps(quiet) as step:
        step(f"reading {cloud}")
        data = read_cloud(cloud, on_warning=warn_unless(quiet))
        lower, upper = data.bounds
        place = given or ((lower + upper) / 2 if about == "centre" else (0.0, 0.0, 0.0))
        after = turn(angles, offset, scale, place)
        step(f"bending it, and writing {out}")
        record = write_warped(out, data, warp_of(kind, data.points, rms, after))
    if not quiet:
        click.echo(f"{out}: {len(data):,} points, {kind} of {record['rms_beyond_affine']:.6g} RMS beyond affine")
