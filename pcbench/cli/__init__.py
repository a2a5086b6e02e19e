"""The command line: arguments become calls, errors become one line. Heavy imports stand inside the commands."""

from __future__ import annotations

import io
import math
import os
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from pcbench import __version__
from pcbench.errors import InputError, PcbenchError

if TYPE_CHECKING:
    from pcbench.geometry.cloud import Cloud
    from pcbench.measure.comparison import Comparison
    from pcbench.report.compare_files import Job
    from pcbench.studies.bench.runs import BenchJob

_Number = TypeVar("_Number", int, float)

_FILE = click.Path(path_type=Path)
_REGISTER_HELP = (
    "icp, icp-point, similarity (ICP with scale), global or global-similarity (the same from any pose), points:FILE,"
    " matrix:FILE or none."
)
_CROP_HELP = "none, box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, polygon:FILE, reference or quantile:0.99."


class _Positive(click.FloatRange):
    """A finite number in a range; nan is in every range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


register_option = click.option("--register", default="icp", show_default=True, metavar="HOW", help=_REGISTER_HELP)
cameras_option = click.option(
    "--cameras",
    default="auto",
    show_default=True,
    metavar="WHICH",
    help="auto, none, or a file or folder with cameras.",
)
masks_option = click.option("--masks", type=_FILE, help="Folder of masks; black is left out.  [default: masks/]")
image_scale_option = click.option(
    "--image-scale", default=1.0, show_default=True, type=float, help="Work with images of this scale, up to 1."
)
write_cameras_option = click.option(
    "--write-cameras", type=_FILE, metavar="OUT", help="OUT.json (transforms.json), or a COLMAP model's folder."
)
quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors.")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="pcbench")
def app() -> None:
    """How far is this point cloud from that one, where, why, and which numbers can be trusted?"""


@app.command(short_help="Measure candidate clouds against a reference.")
@click.argument("reference", type=_FILE, required=False)
@click.argument("candidates", type=_FILE, nargs=-1)
@click.option("--out", type=_FILE, help="Folder for the report.")
@register_option
@click.option("--crop", default="none", show_default=True, metavar="REGION", help=_CROP_HELP)
@click.option("--thresholds", metavar="T,T,...", help="Of the F-score.  [default: 1, 2, 5 x the reference's spacing]")
@click.option(
    "--preset", "presets", multiple=True, metavar="NAME", help="open3d, pdal or tnt; gao2025 and mpeg always."
)
@click.option("--map", "maps", multiple=True, metavar="NAME", help="Deviation maps to add: poisson or m3c2.")
@click.option("--classes", metavar="N,N,...", help="Only these classes of LAS files, such as 2,6.")
@click.option("--returns", metavar="WHICH", help="Only these returns of LAS files: first, last or numbers.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of the bootstrap.")
@click.option("--settings", "settings_file", type=_FILE, help="Repeat the comparison of a report's settings.json.")
@click.option("--json", "json_file", metavar="FILE", help="Write comparison.json to FILE; - for standard output.")
@click.option("--no-figures", is_flag=True, help="Leave the pictures out.")
@quiet_option
@click.pass_context
def compare(
    context: click.Context,
    reference: Path | None,
    candidates: tuple[Path, ...],
    out: Path | None,
    register: str,
    crop: str,
    thresholds: str | None,
    presets: tuple[str, ...],
    maps: tuple[str, ...],
    classes: str | None,
    returns: str | None,
    seed: int,
    settings_file: Path | None,
    json_file: str | None,
    no_figures: bool,
    quiet: bool,
) -> None:
    """Measure how far CANDIDATES are from REFERENCE, both ways.

    \b
    Example: pcbench compare ref.ply a.ply b.ply --out report/
    """
    _multiply_on_one_thread()
    from pcbench.measure.comparison import Settings
    from pcbench.report.compare_files import Job

    if settings_file is not None:
        options = ("register", "crop", "thresholds", "presets", "maps", "classes", "returns", "seed")
        if reference is not None or any(_given(context, name) for name in options):
            raise click.UsageError("--settings already names the files and the settings: give nothing else but outputs")
        job = Job.recorded(settings_file)
    else:
        if reference is None or not candidates:
            raise click.UsageError("expected a reference and at least one candidate: pcbench compare ref.ply a.ply")
        settings = Settings(
            register=register,
            crop=crop,
            thresholds=_numbers("--thresholds", thresholds, float),
            presets=_words(presets),
            maps=_words(maps),
            seed=seed,
            classes=_numbers("--classes", classes, int),
            returns=_returns(returns),
        )
        job = Job.of(reference, candidates, settings)
    _compare(job, out, json_file, figures=not no_figures, quiet=quiet)


@app.command(short_help="Make small cities with exact truth, compare clouds of one and bench SfM on the other.")
@click.option("--out", type=_FILE, default=Path("demo"), show_default=True, help="Folder for clouds and report.")
@click.option(
    "--points",
    default=1_270_820,
    show_default=True,
    type=click.IntRange(20_000, 100_000_000),
    help="Of the reference; candidates in proportion.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of the cities and their noise.")
@click.option("--no-figures", is_flag=True, help="Leave the pictures out.")
@click.option("--no-bench", is_flag=True, help="Compare only.")
@quiet_option
def demo(out: Path, points: int, seed: int, no_figures: bool, no_bench: bool, quiet: bool) -> None:
    """Make a small city whose geometry is known exactly, a dense reference of it, a sparse and a densified candidate
    with noise, outliers and a rigid offset (the second also gently bent), and compare them. Then photograph another
    city and bench sparse SfM on it, at two image scales with finer and coarser features (needs the extras plot, sfm).
    """
    from pcbench.io import write_cloud
    from pcbench.measure.comparison import Settings
    from pcbench.report.compare_files import Job
    from pcbench.scenes.synthetic import demo as make_demo

    mark = out / ".demo"
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for the demo, got a file")
    if out.is_dir() and any(out.iterdir()) and not mark.is_file():
        raise InputError(f"{out}: the folder is not empty and holds no demo: choose another one, or empty it")
    with _steps(quiet) as step:
        step("making the city")
        scene = make_demo(points, seed)
        clouds = out / "clouds"
        clouds.mkdir(parents=True, exist_ok=True)
        mark.touch()
        paths = {name: clouds / f"{name}.ply" for name in ("reference", *scene.candidates)}
        for name, path in paths.items():
            write_cloud(path, scene.reference if name == "reference" else scene.candidates[name])
    reference = paths.pop("reference")
    job = Job(reference, paths, Settings(seed=seed), {})
    comparison = _compare(job, out / "report", None, figures=not no_figures, quiet=quiet)
    if not quiet:
        import numpy as np

        for candidate in comparison.candidates:
            points_ = scene.candidates[candidate.name].points
            found = candidate.registration.T_reference_candidate.apply(points_)
            truth = scene.T_reference_candidate[candidate.name].apply(points_)
            error = float(np.sqrt(np.mean(np.square(found - truth).sum(axis=1))))
            bend = scene.bend_rms[candidate.name]
            note = f" (it is bent by {1000 * bend:.0f} mm RMS, which no rigid motion undoes)" if bend else ""
            click.echo(f"truth: {candidate.name} was registered to {1000 * error:.1f} mm RMS{note}")
        click.echo(f"again: pcbench compare {reference} {' '.join(str(p) for p in paths.values())} --out REPORT")
    if not no_bench:
        _demo_bench(out, seed, figures=not no_figures, quiet=quiet)


def _demo_bench(out: Path, seed: int, *, figures: bool, quiet: bool) -> None:
    from pcbench.studies.bench.demo import demo_job, why_not

    if reason := why_not():
        if not quiet:
            click.echo(f"bench skipped: {reason}")
        return
    with _steps(quiet) as step:
        bench_job = demo_job(out / "city", seed, step)
    if not quiet:
        click.echo(f"\nbench: sparse SfM on {out / 'city'}, whose truth is known")
    _bench(bench_job, out / "bench", figures=figures, quiet=quiet)


@app.command(short_help="Cut a cloud to a region.")
@click.argument("cloud", type=_FILE)
@click.argument("out", type=_FILE)
@click.option("--crop", required=True, metavar="REGION", help=_CROP_HELP)
@quiet_option
def crop(cloud: Path, out: Path, crop: str, quiet: bool) -> None:
    """Write the points of CLOUD inside a region to OUT, with normals, colours and attributes."""
    from pcbench.geometry.regions import parse_region
    from pcbench.io import write_cloud
    from pcbench.io.files import check_output

    check_output(out, (cloud,))
    data = _read(cloud, quiet)
    region = parse_region(crop, data)
    inside = data if region is None else None
    if region is not None:
        mask = region.contains(data.points)
        if not mask.any():
            raise InputError(f"{cloud}: the crop {crop!r} leaves none of its {len(data)} points")
        inside = data.select(mask)
    assert inside is not None
    write_cloud(out, inside)
    if not quiet:
        click.echo(f"{out}: {len(inside):,} of {len(data):,} points")


@app.command(short_help="Align a cloud to a reference.")
@click.argument("reference", type=_FILE)
@click.argument("candidate", type=_FILE)
@click.option("--out", type=_FILE, help="Write the aligned candidate.")
@click.option("--matrix", type=_FILE, help="Write the 4x4 matrix candidate -> reference.")
@register_option
@quiet_option
def register(
    reference: Path, candidate: Path, out: Path | None, matrix: Path | None, register: str, quiet: bool
) -> None:
    """Align CANDIDATE to REFERENCE and say how well that is determined. Prints the 4x4 matrix."""
    from pcbench.geometry.transform import format_matrix
    from pcbench.io import write_cloud
    from pcbench.io.files import atomic_write, check_output
    from pcbench.registration import register as register_clouds

    for path in filter(None, (out, matrix)):
        check_output(path, (reference, candidate))
    truth, cloud = _read(reference, quiet), _read(candidate, quiet)
    with _steps(quiet) as step:
        step("registering")
        result = register_clouds(truth, cloud, register)
    text = format_matrix(result.T_reference_candidate)
    if out is not None:
        aligned = cloud.transformed(result.T_reference_candidate)
        if lost := set(cloud.attributes) - set(aligned.attributes):
            _warn(f"{out}: left out {len(lost)} attributes that a change of frame makes wrong, such as {min(lost)!r}")
        write_cloud(out, aligned)
    if matrix is not None:
        with atomic_write(matrix) as file:
            file.write(text.encode())
    for warning in result.warnings:
        _warn(str(warning))
    if not quiet:
        click.echo(text, nl=False)
        sigma = "not fixed" if result.weakest_sigma is None else f"{result.weakest_sigma:.3g}"
        state = {True: "converged", False: "NOT converged", None: "not iterated"}[result.converged]
        click.echo(
            f"# {result.method}: rmse {result.rmse:.4g}, overlap {result.overlap:.1%}, {result.iterations} iterations,"
            f" {state}, scale {result.T_reference_candidate.scale:.8g}, weakest direction's sigma {sigma}"
        )
        for point in result.check_points:
            click.echo(f"# check point {point.name}: {point.error:.4g}")


@app.command(short_help="Say whether a cloud is deformed against a reference.")
@click.argument("reference", type=_FILE)
@click.argument("candidate", type=_FILE)
@click.option("--out", type=_FILE, help="Folder for deformation.json, the displacement field and pictures.")
@register_option
@click.option("--crop", default="none", show_default=True, metavar="REGION", help=_CROP_HELP)
@click.option("--no-figures", is_flag=True, help="Leave the pictures out.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of the bootstrap.")
@quiet_option
def deform(
    reference: Path,
    candidate: Path,
    out: Path | None,
    register: str,
    crop: str,
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Register CANDIDATE to REFERENCE and say whether it is bent beyond that, by how much, and where.

    \b
    Example: pcbench deform ref.ply a.ply --out bend/
    """
    _multiply_on_one_thread()
    from pcbench.report import deformation_words
    from pcbench.report.deform_files import deform_files

    with _steps(quiet) as step:
        outcome = deform_files(reference, candidate, register, crop, seed, out, figures=not no_figures, step=step)
    values = outcome.deformation.values
    if not quiet:
        for warning in outcome.warnings:
            _warn(warning)
        click.echo(deformation_words(values, candidate.name, outcome.unit or ""))
        if values["verdict"] != "undecided":
            for warning in values["warnings"]:
                _warn(warning)
        for rung in values["rungs"]:
            mark = "*" if rung["model"] == values["model"] else " "
            score, error = rung["cv_score"] ** 0.5, rung["cv_se"] / (2 * rung["cv_score"] ** 0.5 or 1.0)
            click.echo(f" {mark} {rung['model']:10} cross-validated residual {score:.4g} ± {error:.2g}")
        if noise := values["noise"]:
            click.echo(
                f"noise: white {noise['sigma_white']:.3g}, correlated {noise['sigma_correlated']:.3g} over"
                f" {noise['correlation_length']:.3g}; {values['pairs']:,} pairs are worth {noise['n_eff']:,.0f}"
            )
            local = values["local"]
            click.echo(f"local changes: {local['tiles_changed']} of {local['tiles_tested']} tiles")
        if out is not None:
            click.echo(f"report: {out}")
    if outcome.without_figures:
        _warn(outcome.without_figures)


@app.command(short_help="Draw a report's pictures again.")
@click.argument("report", type=_FILE)
@click.argument("names", nargs=-1)
@quiet_option
def plot(report: Path, names: tuple[str, ...], quiet: bool) -> None:
    """Draw the pictures of the folder REPORT into REPORT/figures, or those of NAMES (such as reference, distribution,
    a_distance, a_plane_distance; of a bench speed, accuracy_completeness). Needs no display.
    """
    from pcbench.report.plot import draw

    with _steps(quiet) as step:
        step("drawing")
        written = draw(report, names)
    if not quiet:
        for path in written:
            click.echo(path)


@app.command(short_help="Write a cloud in another format.")
@click.argument("cloud", type=_FILE)
@click.argument("out", type=_FILE)
@click.option("--classes", metavar="N,N,...", help="Only these classes of a LAS file, such as 2,6.")
@click.option("--returns", metavar="WHICH", help="Only these returns of a LAS file: first, last or numbers.")
@quiet_option
def convert(cloud: Path, out: Path, classes: str | None, returns: str | None, quiet: bool) -> None:
    """Write CLOUD to OUT in the format that OUT's ending names, with normals, colours and attributes."""
    from pcbench.io import read_cloud, write_cloud
    from pcbench.io.files import check_output

    check_output(out, (cloud,))
    warn = (lambda _: None) if quiet else _warn
    data = read_cloud(cloud, on_warning=warn, classes=_numbers("--classes", classes, int), returns=_returns(returns))
    write_cloud(out, data)
    if not quiet:
        click.echo(f"{out}: {len(data):,} points")


@app.group(short_help="Scenes and deformations whose truth is known.")
def synth() -> None:
    """Make images of a city whose geometry is known exactly, or bend a cloud by a known amount."""


@synth.command(short_help="Make a city, photographs of it, and their truth.")
@click.option("--out", type=_FILE, required=True, help="Folder for the scene: a new or an empty one.")
@click.option("--images", default=40, show_default=True, type=click.IntRange(1, 9999), help="How many.")
@click.option("--size", default="960x540", show_default=True, metavar="WxH", help="Of an image, in pixels.")
@click.option("--fov", default=40.0, show_default=True, type=click.FloatRange(1, 120), help="Vertical, in degrees.")
@click.option("--rig", default="circles", show_default=True, help="circles, grid, oblique, drone or orbit.")
@click.option("--distortion", default="0,0,0,0", show_default=True, metavar="K1,K2,P1,P2", help="Of the lens.")
@click.option("--gps", type=_Positive(min=0), help="Write gps.txt with errors of so many metres.")
@click.option("--extent", default=400.0, show_default=True, help="Side of the city in metres.")
@click.option("--density", default=0.85, show_default=True, help="Share of the lots that are built on.")
@click.option("--height", default=9.0, show_default=True, help="Median height of its houses in metres.")
@click.option("--relief", default=2.0, show_default=True, help="RMS of the terrain's waves in metres.")
@click.option("--texture", default=1.0, show_default=True, help="1 is rich, 0 leaves blank walls and plain ground.")
@click.option("--water", is_flag=True, help="Make some blocks lakes.")
@click.option("--repeated", is_flag=True, help="Give all buildings one facade.")
@click.option("--symmetric", is_flag=True, help="Make the city look the same after half a turn.")
@click.option("--hard", is_flag=True, help="Short for --texture 0.1 --water --repeated.")
@click.option("--points", default=1_000_000, show_default=True, type=click.IntRange(1000), help="Of the true cloud.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of everything.")
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

    pixels, lens = _size(size), _numbers("--distortion", distortion, float)
    if lens is None or len(lens) != 4:
        raise InputError(f"expected --distortion as four numbers k1,k2,p1,p2, got {distortion!r}")
    intrinsics = replace(Intrinsics.from_fov(*pixels, fov), distortion=lens)
    town = CitySettings(extent, density, height, relief, texture, water, repeated, symmetric, seed)
    town = town.hard() if hard else town
    settings = SceneSettings(town, images, intrinsics, rig, points=points, gps=gps)
    with _steps(quiet) as step:
        write_scene(out, settings, step)
    if not quiet:
        click.echo(f"{out}: {images} images of {pixels[0]} x {pixels[1]}, their cameras and their truth")


@synth.command(short_help="Bend a cloud by a known amount.")
@click.argument("cloud", type=_FILE)
@click.argument("out", type=_FILE)
@click.option("--kind", required=True, help="dome, bowl, shear, twist, subsidence or drift.")
@click.option("--rms", required=True, type=float, help="What no affine map explains, in the cloud's unit.")
@click.option("--rotate", default="0,0,0", show_default=True, metavar="X,Y,Z", help="Degrees about each axis, after.")
@click.option("--shift", default="0,0,0", show_default=True, metavar="X,Y,Z", help="In the cloud's unit, after.")
@click.option("--scale", default=1.0, show_default=True, help="About the origin, after.")
@quiet_option
def warp(cloud: Path, out: Path, kind: str, rms: float, rotate: str, shift: str, scale: float, quiet: bool) -> None:
    """Write CLOUD to OUT deformed in a known way, and what was done to it beside, as JSON (OUT with .json added).

    dome and bowl bend it over its horizontal extent; shear leans over with the square of the height; twist turns with
    height; subsidence is a local basin; drift bends the longest axis. A rotation, a scale and a shift follow.
    """
    import json

    from pcbench.io import write_cloud
    from pcbench.io.files import atomic_write, check_output
    from pcbench.scenes.synthetic.warp import turn, warp_of

    beside = out.with_name(f"{out.name}.json")
    for path in (out, beside):
        check_output(path, (cloud,))
    angles, move = _numbers("--rotate", rotate, float), _numbers("--shift", shift, float)
    for option, text, values in (("--rotate", rotate, angles), ("--shift", shift, move)):
        if values is None or len(values) != 3:
            raise InputError(f"expected {option} as three numbers x,y,z, got {text!r}")
    assert angles is not None and move is not None
    data = _read(cloud, quiet)
    bend = warp_of(kind, data.points, rms, turn(angles, move, scale))  # type: ignore[arg-type]
    record = bend.record(data.points)
    write_cloud(out, bend.apply_cloud(data))
    with atomic_write(beside) as file:
        file.write((json.dumps(record, indent=1) + "\n").encode())
    if not quiet:
        click.echo(f"{out}: {len(data):,} points, {kind} of {record['rms_beyond_affine']:.6g} RMS beyond affine")


@app.command(short_help="Say what is in a cloud.")
@click.argument("clouds", type=_FILE, nargs=-1, required=True)
def info(clouds: tuple[Path, ...]) -> None:
    """Say what is in each of CLOUDS: points, extent, spacing, normals, colours, attributes."""
    import numpy as np

    from pcbench.geometry.neighbors import Index

    for path in clouds:
        cloud = _read(path, quiet=False)
        lower, upper = cloud.bounds
        click.echo(f"{path}: {len(cloud):,} points")
        click.echo(f"  from   {_triple(lower)}")
        click.echo(f"  to     {_triple(upper)}")
        click.echo(f"  size   {_triple(upper - lower)} {cloud.unit or ''}".rstrip())
        if len(cloud) > 1:
            points = cloud.points - lower  # small numbers search more exactly
            which = np.arange(0, len(points), max(1, len(points) // 100_000))
            spacing = float(np.median(Index(points).query(points[which], k=2).distances[:, 1]))
            click.echo(f"  median distance to the nearest other point {spacing:.4g}")
        click.echo(f"  normals {'yes' if cloud.normals is not None else 'no'}", nl=False)
        click.echo(f", colours {'yes' if cloud.colors is not None else 'no'}, crs {cloud.crs or 'unknown'}")
        if cloud.attributes:
            click.echo(f"  attributes {', '.join(cloud.attributes)}")


@app.command(short_help="Say what is in a scene: images, cameras, GPS, masks.")
@click.argument("scene", type=_FILE)
@cameras_option
@masks_option
@image_scale_option
@click.option("--figure", type=_FILE, help="Draw the cameras into this PNG.")
@write_cameras_option
@quiet_option
def scene(
    scene: Path,
    cameras: str,
    masks: Path | None,
    image_scale: float,
    figure: Path | None,
    write_cameras: Path | None,
    quiet: bool,
) -> None:
    """Say what is in SCENE, a folder of photographs with, perhaps, cameras: a COLMAP model, transforms.json, Strecha's
    .camera files or an Earth Studio export.
    """
    from pcbench.io.files import check_output
    from pcbench.scenes.scene import read_scene

    warn = (lambda _: None) if quiet else _warn
    data = read_scene(scene, cameras=cameras, masks=masks, image_scale=image_scale, on_warning=warn)
    if figure is not None:
        from pcbench.report.plot.cameras import draw_cameras

        check_output(figure, ())
        draw_cameras(data, figure)
    if write_cameras is not None:
        from pcbench.scenes.scene import write_cameras as write

        write(write_cameras, data.cameras, data.folder, data.points)
    if not quiet:
        for line in data.describe():
            click.echo(line)


@app.command(short_help="List the reconstructors, or describe some.")
@click.argument("specs", nargs=-1, metavar="[NAME | MODULE:CLASS | FILE.py:CLASS]...")
def plugins(specs: tuple[str, ...]) -> None:
    """List the installed reconstructors, or describe those given: where they come from, what they are for, whether
    they can run here, and their settings with types and defaults.
    """
    from pcbench.plugins import find_plugin, installed

    for spec in specs or installed():
        try:
            plugin = find_plugin(spec)
        except InputError as error:
            if specs:
                raise
            click.echo(f"{spec}: {error}")  # one that is broken hides no other
            continue
        click.echo(f"{spec} ({plugin.origin}): {plugin.help or 'no description'}")
        _, _, more = plugin.docstring.partition("\n\n")
        if specs and more:
            click.echo(textwrap.indent(f"\n{more}\n", "  "))
        missing = plugin.missing
        click.echo(f"  {'can run here' if missing is None else f'cannot run here: {missing}'}")
        for setting in plugin.settings:
            default = "must be given" if setting.default is None else f"default {setting.default}"
            click.echo(f"  --set {setting.name}={setting.type}  ({default})")


@app.command(short_help="Make a cloud of a scene with a reconstructor.")
@click.argument("name", metavar="NAME")
@click.argument("scene", type=_FILE)
@click.option("-o", "--out", type=_FILE, required=True, help="The cloud.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="A setting of the reconstructor.")
@cameras_option
@masks_option
@image_scale_option
@click.option("--workspace", type=_FILE, help="Folder for its files, which the next run uses.  [default: OUT.work]")
@click.option("--time-limit", type=_Positive(min=0, min_open=True), metavar="SECONDS", help="Stop it after this.")
@write_cameras_option
@quiet_option
def reconstruct(
    name: str,
    scene: Path,
    out: Path,
    settings: tuple[str, ...],
    cameras: str,
    masks: Path | None,
    image_scale: float,
    workspace: Path | None,
    time_limit: float | None,
    write_cameras: Path | None,
    quiet: bool,
) -> None:
    """Make a cloud of the photographs in SCENE with the reconstructor NAME: an installed one (`pcbench plugins`),
    MODULE:CLASS or FILE.py:CLASS. It runs in a process of its own.

    \b
    Example: pcbench reconstruct sfm photos/ -o cloud.ply --set mapping=global
    """
    from pcbench.io import check_cloud_output, write_cloud
    from pcbench.plugins.run import Job, is_workspace, run
    from pcbench.scenes.scene import check_cameras_output
    from pcbench.scenes.scene import write_cameras as write

    check_cloud_output(out)
    if write_cameras is not None:
        check_cameras_output(write_cameras)
        if write_cameras.resolve().is_relative_to(scene.resolve()):
            raise InputError(f"{write_cameras}: the cameras would be written into the scene: choose another place")
    values = dict(_key_value(text) for text in settings)
    job = Job(name, scene, values, cameras=cameras, masks=masks, image_scale=image_scale)
    with _steps(quiet) as step:
        step(f"reconstructing with {name}")
        work = workspace or out.with_suffix(".work")
        if work.is_dir() and any(work.iterdir()) and not is_workspace(work):
            raise InputError(f"{work}: the workspace is not empty and no reconstruction's: choose another, or empty it")
        result = run(job, work, time_limit)
    if not quiet:
        for warning in result.warnings:
            _warn(warning)
    made = result.required()
    write_cloud(out, made.cloud)
    if write_cameras is not None and not made.cameras:
        _warn(f"{write_cameras}: not written, {name} gave no cameras")
    elif write_cameras is not None:
        images = scene / "images"
        write(write_cameras, made.cameras, images if images.is_dir() else scene, made.cloud)
    if not quiet:
        for note in made.notes:
            click.echo(f"note: {note}")
        memory = "" if result.peak_rss_bytes is None else f", {result.peak_rss_bytes / 2**20:.0f} MiB"
        click.echo(f"{out}: {len(made.cloud):,} points, {made.gauge}, {len(made.cameras)} cameras")
        click.echo(f"{result.wall_s:.1f} s, {result.cpu_s:.1f} CPU s{memory}")


@app.command(short_help="Run reconstructors side by side: time and memory against accuracy.")
@click.argument("scene", type=_FILE)
@click.option("--reference", type=_FILE, required=True, help="Cloud or mesh in the frame of the scene's cameras.")
@click.option("--method", "methods", multiple=True, metavar="NAME", help="A reconstructor, as for `reconstruct`.")
@click.option(
    "--sweep",
    "sweeps",
    multiple=True,
    metavar="[METHOD.]KEY=V,V,...",
    help="Run with each value; of several, all combinations.",
)
@click.option("--set", "settings", multiple=True, metavar="[METHOD.]KEY=VALUE", help="Set for all that have it.")
@click.option(
    "--seeds", default=1, show_default=True, type=click.IntRange(1, 1000), help="Runs of each with seeds 0 to N-1."
)
@click.option("--out", type=_FILE, required=True, help="Folder for the bench; runs that are in it are kept.")
@click.option("--time-limit", type=_Positive(min=0, min_open=True), metavar="SECONDS", help="Stop a run after this.")
@click.option(
    "--cameras",
    default="auto",
    show_default=True,
    metavar="WHICH",
    help="What methods get: auto, none, or a file or folder. With none, those of the scene still register clouds.",
)
@masks_option
@click.option("--truth-mesh", type=_FILE, help="Of the reference's surface: says what the cameras saw of it.")
@click.option(
    "--register", default="gauge", show_default=True, metavar="HOW", help="By each cloud's gauge, or as for `compare`."
)
@click.option("--crop", default="none", show_default=True, metavar="REGION", help=_CROP_HELP)
@click.option(
    "--threshold",
    type=_Positive(min=0, min_open=True),
    help="Of the F-score.  [default: 5 x the reference's spacing]",
)
@click.option("--no-figures", is_flag=True, help="Leave the charts out.")
@quiet_option
def bench(
    scene: Path,
    reference: Path,
    methods: tuple[str, ...],
    sweeps: tuple[str, ...],
    settings: tuple[str, ...],
    seeds: int,
    out: Path,
    time_limit: float | None,
    cameras: str,
    masks: Path | None,
    truth_mesh: Path | None,
    register: str,
    crop: str,
    threshold: float | None,
    no_figures: bool,
    quiet: bool,
) -> None:
    """Make clouds of SCENE with every method at every budget, each in a process of its own, and compare them with the
    reference. KEY is image_scale or a setting of the methods. What a method does wrong is a row; what is done is kept,
    so the same command goes on where it was stopped.

    \b
    Example: pcbench bench photos/ --reference truth.ply --method sfm --method mine.py:Mine
             --sweep image_scale=0.25,0.5,1 --seeds 3 --out bench/
    """
    from pcbench.studies.bench.plan import Axis
    from pcbench.studies.bench.runs import BenchJob
    from pcbench.studies.bench.score import Rules

    axes = [*map(Axis.fixed, settings), *map(Axis.sweep, sweeps)]
    rules = Rules(register, crop, threshold)
    job = BenchJob(scene, reference, methods, axes, seeds, cameras, masks, truth_mesh, time_limit, rules)
    _bench(job, out, figures=not no_figures, quiet=quiet)


def _bench(job: BenchJob, out: Path, *, figures: bool, quiet: bool) -> None:
    from pcbench.report.plot import draw_if_possible
    from pcbench.studies.bench.runs import Done
    from pcbench.studies.bench.runs import bench as run_bench
    from pcbench.studies.bench.table import print_bench

    def say(done: Done) -> None:
        if not quiet:
            click.echo(f"{done.number}/{done.of} {done.words}")

    with _steps(quiet) as step:
        doc = run_bench(job, out, on_row=say, on_step=step, on_warning=(lambda _: None) if quiet else _warn)
        if figures:
            step("drawing the charts")
            without = draw_if_possible(out)
    if not quiet:
        click.echo()
        print_bench(doc)
        click.echo(f"bench: {out}")
    if figures and without:
        _warn(without)


@app.group(short_help="Questions answered on scenes whose truth is known.")
def experiment() -> None:
    """Answer a question on a scene whose truth is known."""


@experiment.command(short_help="Solve the same images in several ways: what bends the cloud?")
@click.argument("scene", type=_FILE, required=False)
@click.option("--out", type=_FILE, required=True, help="Folder for results; a later run goes on from what is there.")
@click.option(
    "--images", default=42, show_default=True, type=click.IntRange(12, 9999), help="Of the scene that is made."
)
@click.option("--size", default="800x600", show_default=True, metavar="WxH", help="Of an image, in pixels.")
@click.option("--no-figures", is_flag=True, help="Leave the picture out.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Of everything.")
@quiet_option
@click.pass_context
def bend(
    context: click.Context,
    scene: Path | None,
    out: Path,
    images: int,
    size: str,
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Solve the same images with the reconstructor sfm and different settings (which images; focal length and
    distortion known, solved for or ignored; control points), and measure how the clouds are bent against the truth
    and against each other. SCENE is a folder as pcbench synth city makes it; without one, a drone's survey of a city
    is made.

    \b
    Example: pcbench experiment bend --out bend/
    """
    from pcbench.report import print_columns
    from pcbench.studies.bend.bend import Experiment, run_bend
    from pcbench.studies.bend.findings import table

    if scene is not None and any(_given(context, name) for name in ("images", "size")):
        raise click.UsageError("--images and --size are those of the scene that is made where none is given")
    settings = Experiment(images, *_size(size), seed)
    with _steps(quiet) as step:
        document, without_figures = run_bend(out, scene, settings, figures=not no_figures, step=step)
    if not quiet:
        print_columns(table(document))
        for sentence in document["sentences"]:
            click.echo(sentence)
        click.echo(f"report: {out}")
    if without_figures:
        _warn(without_figures)


def _size(text: str) -> tuple[int, int]:
    pixels = _numbers("--size", text.lower().replace("x", ","), int)
    if pixels is None or len(pixels) != 2:
        raise InputError(f"expected --size as WIDTHxHEIGHT, such as 960x540, got {text!r}")
    if min(pixels) < 1:
        raise InputError(f"expected an image of at least one pixel, got {text!r}")
    return pixels[0], pixels[1]


def _key_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise InputError(f"expected --set KEY=VALUE, got {text!r}")
    return key.strip(), value.strip()


def _compare(job: Job, out: Path | None, json_file: str | None, *, figures: bool, quiet: bool) -> Comparison:
    from pcbench.report import print_table, to_json
    from pcbench.report.compare_files import Outputs, compare_files

    to_stdout = json_file == "-"
    outputs = Outputs(out, None if json_file is None or to_stdout else Path(json_file), figures)
    with _steps(quiet) as step:
        outcome = compare_files(job, outputs, step)
    if to_stdout:
        click.echo(to_json(outcome.document), nl=False)
    elif not quiet:
        print_table(outcome.document)
        if out is not None:
            click.echo(f"report: {out}")
    if outcome.without_figures:
        _warn(outcome.without_figures)
    return outcome.comparison


def _read(path: Path, quiet: bool) -> Cloud:
    from pcbench.io import read_cloud

    return read_cloud(path, on_warning=(lambda _: None) if quiet else _warn)


def _numbers(option: str, text: str | None, kind: type[_Number]) -> tuple[_Number, ...] | None:
    if text is None:
        return None
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"expected {option} as numbers with commas, got {text!r}") from None


def _words(values: tuple[str, ...]) -> tuple[str, ...]:
    """Options that may be repeated, or hold several names with commas."""
    return tuple(word for value in values for word in value.split(","))


def _returns(text: str | None) -> str | tuple[int, ...] | None:
    return text if text in (None, "first", "last") else _numbers("--returns", text, int)


def _given(context: click.Context, name: str) -> bool:
    return context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT


def _triple(values: Any) -> str:
    return "  ".join(f"{v:.3f}" for v in values)


def _warn(text: str) -> None:
    click.echo(f"warning: {text}", err=True)


@contextmanager
def _steps(quiet: bool) -> Iterator[Callable[[str], None]]:
    """A line on the terminal that says what is being done and for how long; nothing where stderr is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda text: progress.update(task, description=escape(text))


def _multiply_on_one_thread() -> None:
    """Before numpy is imported: matrices here are small, and waking threads for them costs more than it saves."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2; anything else keeps its traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without arrows still gets its table
            stream.reconfigure(errors="replace")
    for name in ("SIGTERM", "SIGHUP"):  # batch systems stop jobs by these: clean up as after Ctrl-C
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _stop)
    try:
        app(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
    except click.UsageError as error:
        help_of = error.ctx.command_path if error.ctx else "pcbench"
        _fail(f"{error.format_message()} (see {help_of} --help)")
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error))
    except MemoryError:
        _fail("not enough memory for these clouds: crop or thin them first")
    except (PcbenchError, click.ClickException) as error:
        _fail(str(error))


def _fail(message: str) -> NoReturn:
    click.echo(f"error: {' '.join(message.split())}", err=True)
    sys.exit(2)


def _stop(number: int, _: Any) -> NoReturn:
    sys.exit(128 + number)


if __name__ == "__main__":
    main()
