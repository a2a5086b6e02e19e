"""Commands that read clouds: info, crop, register."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.messages import report_error, steps, warn, warn_unless
from pcbench.cli.options import (
    FILE,
    color_depth_option,
    quiet_option,
    register_option,
    required_crop_option,
    vertices_option,
)

if TYPE_CHECKING:
    from pcbench.geometry.arrays import FloatArray
    from pcbench.geometry.cloud import Cloud
    from pcbench.registration import Registration


@command(short_help="Crop a cloud to a region.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@required_crop_option
@color_depth_option
@quiet_option
def crop(cloud: Path, out: Path, crop: str, color_depth: int | None, quiet: bool) -> None:
    """Write the points of CLOUD inside a region to OUT, with normals, colours and attributes."""
    from pcbench.errors import InputError
    from pcbench.geometry.region_text import region_file
    from pcbench.io import write_cloud
    from pcbench.io.crop import crop as crop_cloud
    from pcbench.io.outputs import check_output
    from pcbench.io.source import Source
    from pcbench.progress import ProgressPlan

    if crop.strip().lower() in ("none", "reference"):
        expected = "box:xmin,ymin,zmin,xmax,ymax,zmax, sphere:x,y,z,r, polygon:FILE or quantile:q"
        raise InputError(f"expected --crop {expected}, got {crop!r}")
    source = Source.open(cloud)
    check_output(out, [*source.files, *filter(None, [region_file(crop)])])
    with steps(quiet) as show:
        reading = source.reading_seconds
        step = ProgressPlan(show, [reading, 0.5 * reading, reading])
        step(f"reading {cloud}")
        data = source.read_cloud(warn_unless(quiet), color_depth=color_depth)
        step("cropping")
        try:
            inside = crop_cloud(data, crop)
        except InputError as error:
            raise InputError(f"{cloud}: {error}") from error
        step(f"writing {out}")
        write_cloud(out, inside, on_warning=warn_unless(quiet))
    if not quiet:
        click.echo(f"{out}: {len(inside):,} of {len(data):,} points")


@command(short_help="Align a cloud with a reference.")
@click.argument("reference", type=FILE)
@click.argument("candidate", type=FILE)
@option("--out", type=FILE, metavar="FILE", help="File for the aligned candidate.")
@option("--matrix", type=FILE, metavar="FILE", help="File for the 4x4 matrix from candidate to reference.")
@register_option()
@vertices_option
@json_option("the pose and its precision")
@quiet_option
def register(
    reference: Path,
    candidate: Path,
    out: Path | None,
    matrix: Path | None,
    register: str,
    vertices: bool,
    json_file: str | None,
    quiet: bool,
) -> None:
    """Align CANDIDATE with REFERENCE, and print the motion and its precision.

    Comment lines (#) give the shift of the candidate's centroid, the rotation angle and axis, the scale, whether the
    pose can be trusted, and the residuals of control and check points. The 4x4 matrix follows, so that the output is a
    file for --register matrix:FILE. A mesh stays a mesh in a .ply file.
    """
    from pcbench.geometry.crs import check_lengths
    from pcbench.geometry.datums import StatedSystem
    from pcbench.geometry.mesh import Mesh
    from pcbench.geometry.mesh_samples import sample_candidate
    from pcbench.geometry.transform import format_matrix
    from pcbench.io import write_cloud
    from pcbench.io.outputs import check_output
    from pcbench.io.ply import write_ply_mesh
    from pcbench.io.source import Source
    from pcbench.progress import ProgressPlan
    from pcbench.registration import parse_method
    from pcbench.registration import register as register_clouds
    from pcbench.report.document import registration_document
    from pcbench.report.inputs import InputFile
    from pcbench.scratch import atomic_write

    output = JsonOutput(json_file)
    sources = Source.open(reference), Source.open(candidate, vertices=vertices)
    method = parse_method(register)
    inputs = [*sources[0].files, *sources[1].files, *method.files]
    for path, other in ((out, matrix), (matrix, out)):
        if path is not None:
            check_output(path, inputs, [*filter(None, [other])])
    output.check(inputs, [*filter(None, [out, matrix])])
    shapes, files = [], []
    with steps(quiet) as show:
        reading = [source.reading_seconds for source in sources]
        step = ProgressPlan(show, [*reading, 0.5 + 15 * sum(reading)])
        for source in sources:
            step(f"reading {source.path}")
            texts: list[str] = []
            shape, sha256 = source.read_with_digest(texts.append)
            for text in texts:
                warn_unless(quiet)(text)
            check_lengths(shape, str(source.path))
            shapes.append(shape)
            files.append(InputFile(str(source.path), sha256, tuple(texts), StatedSystem.of(shape.crs, shape.unit)))
        fixed, moved = shapes
        step("registering")
        result = register_clouds(fixed, moved, method)
        cloud = sample_candidate(moved, fixed)
    text = format_matrix(result.T_reference_candidate)
    if out is not None and isinstance(moved, Mesh) and out.suffix.lower() == ".ply":
        write_ply_mesh(out, moved.transformed(result.T_reference_candidate))
    elif out is not None:
        aligned = cloud.transformed(result.T_reference_candidate)
        if lost := set(cloud.attributes) - set(aligned.attributes):
            warn_unless(quiet)(
                f"{out}: removed {len(lost)} attributes that are invalid in the new frame, such as {min(lost)!r}"
            )
        if isinstance(moved, Mesh):
            warn_unless(quiet)(f"{out}: {len(cloud):,} points sampled on the mesh; a .ply file keeps its faces")
        write_cloud(out, aligned, on_warning=warn_unless(quiet))
    if matrix is not None:
        with atomic_write(matrix) as file:
            file.write(text.encode())
    for warning in result.warnings:
        warn_unless(quiet)(str(warning))
    centroid, unit = cloud.points.mean(axis=0), fixed.unit or cloud.unit
    if json_file is not None:
        output.write(registration_document(result, files[0], files[1], centroid, unit))
    if not quiet and not output.on_stdout:
        for line in _motion_lines(result, centroid, unit):
            click.echo(f"# {line}")
        click.echo(text, nl=False)


def _motion_lines(result: Registration, centroid: FloatArray, unit: str | None) -> Iterator[str]:
    """Yield lines on the motion of a registration and its precision."""
    from pcbench.report.moved import motion_clause
    from pcbench.report.pose import pose_sentence

    motion = result.T_reference_candidate.motion_at(centroid)
    unit_text = f" {unit}" if unit else ""
    shift = motion.shift * (abs(motion.shift) > 1e-14 * abs(centroid).max())  # smaller shifts are rounding errors
    components = ", ".join(f"{x:+.4g}" for x in shift)
    yield f"shift at the centroid: {float(sum(shift**2)) ** 0.5:.4g}{unit_text} ({components})"
    axis = "" if motion.axis is None else f" about ({', '.join(f'{x:+.4f}' for x in motion.axis)})"
    yield f"rotation: {motion.angle_deg:.4g} degrees{axis}"
    fixed = " (not estimated)" if motion.scale == 1 and not result.solved_scale else ""
    yield f"scale: {motion.scale:.8g}{fixed}"
    sigma = "unconstrained" if result.weakest_sigma is None else f"{result.weakest_sigma:.3g}{unit_text}"
    if (removed := result.motion) is not None:
        yield f"{motion_clause(result, removed, 'the candidate', unit)}, at the centre of the overlap"
    state = "" if result.converged is None else "converged, " if result.converged else "NOT converged, "
    steps = f"{result.iterations} iterations, {state}" if result.iterations else ""
    yield (
        f"{result.method}: {'the pose is DOUBTFUL, ' if result.doubtful else ''}rmse {result.rmse:.4g}{unit_text},"
        f" overlap {result.overlap:.1%}, {steps}standard error in the weakest direction {sigma}"
    )
    yield pose_sentence(result, "the candidate", unit)
    yield from result.residuals.point_lines(unit)
    yield from result.residuals.rmse_lines(unit)
    yield "matrix candidate -> reference:"


@command(short_help="Describe a cloud.")
@click.argument("clouds", type=FILE, nargs=-1, required=True)
def info(clouds: tuple[Path, ...]) -> None:
    """Print points, extent, spacing, normals, colours and attributes of CLOUDS.

    Faces of meshes and Gaussian splats are described too.
    """
    from pcbench.errors import PcbenchError, reason_of

    failed = False
    for path in clouds:
        try:
            _print_info(path)
        except (PcbenchError, PermissionError) as error:  # the other files can still be described
            failed = True
            report_error(str(error) if isinstance(error, PcbenchError) else f"{path}: {reason_of(error)}")
    if failed:
        sys.exit(2)


def _print_info(path: Path) -> None:
    from pcbench.errors import InputError
    from pcbench.geometry.crs import axis_units, crs_label, is_in_degrees, projection_command
    from pcbench.geometry.datums import StatedSystem
    from pcbench.geometry.mesh_samples import vertex_cloud
    from pcbench.geometry.neighbors import Index
    from pcbench.geometry.sampling import sampling_of
    from pcbench.geometry.splats import is_splat_attribute, splat_model, spread
    from pcbench.io.source import Source
    from pcbench.measure.wording import pluralize
    from pcbench.progress import ProgressPlan
    from pcbench.report.words import printable

    mesh = sampling = None
    with steps(quiet=False) as show:
        source = Source.open(path)
        step = ProgressPlan(show, [source.reading_seconds, 10 * source.reading_seconds])
        step(f"reading {path}")
        if source.is_mesh_only:
            mesh = source.read_mesh(warn)
            cloud = vertex_cloud(mesh)
        elif source.holds_mesh:
            lines: list[str] = []
            cloud = source.read_vertices(lines.append)
            try:
                mesh = source.read_mesh(lines.append)
            except InputError as error:  # its points can still be described
                lines.append(str(error))
            for line in dict.fromkeys(lines):  # both readers say what they leave out
                warn(line)
        else:
            cloud = source.read_cloud(warn)
        lower, upper = cloud.bounds
        if in_degrees := is_in_degrees(cloud.crs, cloud.unit):
            warn(f"{path}: degrees are no lengths: to measure, {projection_command(cloud.crs, *cloud.centre)}")
        units = axis_units(cloud.crs)
        is_mixed = units is not None and units.are_mixed and cloud.unit is None
        if len(cloud) > 1 and not in_degrees and not is_mixed:
            step("measuring the spacing")
            index = Index(cloud.points - lower)  # small coordinates lose less to rounding
            sampling = sampling_of(index, index.nearest_other())  # over all points, as in a comparison
    count = pluralize(len(cloud), "point") if mesh is None else f"{len(cloud):,} vertices"
    click.echo(f"{path}: {count}")
    if mesh is not None:
        closed = mesh.closure.describe(mesh.unit)
        click.echo(f"  mesh   {pluralize(len(mesh), 'face')} of area {mesh.area:.6g}, {closed}")
    for name, values in (("from", lower), ("to", upper), ("size", upper - lower)):
        click.echo(f"  {name:6} {_triple(values, cloud)}")
    if sampling is not None:
        unit = f" {cloud.unit}" if cloud.unit else ""
        click.echo(f"  spacing {sampling.spacing:.4g}{unit} ({sampling.definition})")
    if mesh is None:
        click.echo(f"  step    {_steps(cloud.quantisation.steps, cloud)}")
    click.echo(f"  normals {'yes' if cloud.normals is not None else 'no'}", nl=False)
    depth = cloud.stored and cloud.stored.color_depth
    colours = "no" if cloud.colors is None else f"yes (stored with {depth} bits)" if depth else "yes"
    click.echo(f", colours {colours}", nl=False)
    click.echo(f", crs {crs_label(cloud.crs) if cloud.crs else 'unknown'}")
    if cloud.crs is not None:
        click.echo(f"  {StatedSystem.of(cloud.crs, cloud.unit).describe_datums()}")
    attributes = list(cloud.attributes)
    if (splats := splat_model(cloud)) is not None:
        degree = "unknown" if splats.sh_degree is None else splats.sh_degree
        click.echo(f"  {splats.dimensions}D Gaussian splat model, {len(cloud):,} splats, SH degree {degree}")
        click.echo(f"    opacity {spread(splats.opacities)}; largest axis {spread(splats.largest_axes)}")
        attributes = [name for name in attributes if not is_splat_attribute(name)]
    if attributes:
        click.echo(f"  attributes {', '.join(map(printable, attributes))}")


def _steps(steps: FloatArray, cloud: Cloud) -> str:
    """Return the steps in which x, y and z are stored, in words."""
    from pcbench.geometry.crs import is_in_degrees

    if not steps.any():
        return "none visible (in which x, y and z are rounded)"
    different = steps[:1] if (steps == steps[0]).all() else steps
    words = "  ".join(f"{step:.3g}" if step else "none" for step in different)
    unit = f" {cloud.unit}" if cloud.unit and not is_in_degrees(cloud.crs, cloud.unit) else ""  # z may have another one
    return f"{words}{unit} (in which x, y and z are rounded)"


def _triple(values: FloatArray, cloud: Cloud) -> str:
    """Return x, y and z as text, with the unit that each is known to have."""
    from pcbench.geometry.crs import axis_units, is_in_degrees

    units, in_degrees = axis_units(cloud.crs), is_in_degrees(cloud.crs, cloud.unit)
    height = units.height if units is not None else None
    if in_degrees:
        return f"{values[0]:.8f}  {values[1]:.8f} deg  {values[2]:.3f} {height or ''}".rstrip()
    if units is not None and units.are_mixed and cloud.unit is None:
        return f"{values[0]:.3f}  {values[1]:.3f} {units.horizontal}  {values[2]:.3f} {height}"
    return f"{'  '.join(f'{value:.3f}' for value in values)} {cloud.unit or ''}".rstrip()
