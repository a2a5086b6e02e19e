"""Command that writes a cloud in another format: convert."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pcbench.cli.help import command, option
from pcbench.cli.messages import steps, warn_unless
from pcbench.cli.options import (
    FILE,
    POSITIVE,
    accuracy_option,
    color_depth_option,
    las_options,
    quiet_option,
    splat_options,
)
from pcbench.options import OptionGroup, parse_integers, parse_lengths, parse_returns


@command(short_help="Write a cloud in another format.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@las_options
@splat_options
@color_depth_option
@option(
    "--crs",
    metavar="CRS",
    help="State the coordinate system that CLOUD is in, such as EPSG:32617+5703. Coordinates stay as they are.",
)
@option(
    "--to-crs",
    metavar="CRS",
    help="Transform to this coordinate system; heights too if it has some, such as EPSG:32617+5703.",
)
@accuracy_option("--to-crs")
@option(
    "--unit",
    metavar="UNIT",
    help="State the unit that x, y and z of CLOUD are in, such as ft. Coordinates stay as they are.",
)
@option(
    "--z-unit",
    metavar="UNIT",
    help="State the unit that z of CLOUD is in, if x and y have another one.",
    group=OptionGroup.COORDINATES,
)
@option("--to-unit", metavar="UNIT", help="Convert x, y and z to this unit of length, such as m or US-ft.")
@option(
    "--scale",
    type=POSITIVE,
    metavar="FACTOR",
    help="Multiply x, y and z by FACTOR, about the origin. Their unit is unknown unless --unit or --crs states it.",
    group=OptionGroup.COORDINATES,
)
@option(
    "--shift",
    metavar="X,Y,Z",
    help="Add X, Y and Z to the coordinates, last, for programs that compute in few digits. The system is left out.",
    group=OptionGroup.COORDINATES,
)
@option(
    "--drop-nodata",
    is_flag=True,
    help="Remove points that stand for missing data, such as z = -9999.",
    group=OptionGroup.INPUT,
)
@option(
    "--drop-zero", is_flag=True, help="Remove points whose x, y and z are all exactly zero.", group=OptionGroup.INPUT
)
@option(
    "--drop-duplicates",
    is_flag=True,
    help="Remove points with exactly the coordinates of an earlier point of CLOUD.",
    group=OptionGroup.INPUT,
)
@option("--sample", type=click.IntRange(min=1), metavar="N", help="Sample N points on a mesh, uniformly by area.")
@option(
    "--mirror",
    type=click.Choice(("x", "y", "z", "xy", "xz", "yz")),
    help="Undo a mirrored export: negate one axis (x, y, z), or exchange two (xy, xz, yz).",
    group=OptionGroup.COORDINATES,
)
@quiet_option
def convert(
    cloud: Path,
    out: Path,
    classes: str | None,
    returns: str | None,
    min_opacity: float | None,
    max_axis: float | None,
    color_depth: int | None,
    crs: str | None,
    to_crs: str | None,
    accuracy: float | None,
    unit: str | None,
    z_unit: str | None,
    to_unit: str | None,
    scale: float | None,
    shift: str | None,
    drop_nodata: bool,
    drop_zero: bool,
    drop_duplicates: bool,
    sample: int | None,
    mirror: str | None,
    quiet: bool,
) -> None:
    """Write CLOUD to OUT in the format of OUT's extension, with normals, colours and attributes.

    A mesh is written as its vertices, or as points sampled on its surface (--sample).

    --crs, --unit and --z-unit state what CLOUD is in, instead of its file; --to-crs and --to-unit change the
    coordinates. In this order: points are removed, --mirror, --scale, what is stated, --to-crs, --to-unit, --shift.

    \b
    Example: pcbench convert site.xyz site.laz --crs EPSG:4979 --to-crs EPSG:32617+5703
    Example: pcbench convert scan.xyz scan.ply --unit ft --to-unit m
    Example: pcbench convert model.ply model.spz --shift -448000,-5419000,-300
    """
    from pcbench.errors import InputError
    from pcbench.geometry.mesh_samples import vertex_cloud
    from pcbench.geometry.reflections import reflection
    from pcbench.geometry.removal import without_duplicates, without_zeros
    from pcbench.geometry.reprojection import project
    from pcbench.geometry.stated_system import convert_unit, scale_coordinates, shift_coordinates, state_crs, state_unit
    from pcbench.io import check_cloud_output, write_cloud
    from pcbench.io.files import errors_named
    from pcbench.io.las_records import NO_FILTERS, parse_filters
    from pcbench.io.outputs import check_output
    from pcbench.io.polygons import left_out_surface
    from pcbench.io.source import Source
    from pcbench.measure.wording import pluralize
    from pcbench.progress import ProgressPlan

    if accuracy is not None and to_crs is None:
        raise click.UsageError("--accuracy needs --to-crs, the new coordinate system")
    wanted_classes = None if classes is None else parse_integers("--classes", classes)
    wanted_returns = None if returns is None else parse_returns("--returns", returns)
    offset = None if shift is None else parse_lengths("--shift", shift)
    with errors_named(cloud):
        filters = parse_filters(wanted_classes, wanted_returns)
    source = Source.open(cloud, filters)
    check_output(out, source.files)
    check_cloud_output(out)
    options: dict[str, Any] = {"min_opacity": min_opacity, "max_axis": max_axis, "color_depth": color_depth}
    filters_points = drop_nodata or filters != NO_FILTERS or any(value is not None for value in options.values())
    if sample is not None and not source.holds_mesh:
        raise InputError(f"{cloud}: --sample needs a mesh, and this file has none")
    if (sample is not None or source.is_mesh_only) and filters_points:
        raise InputError(
            f"{cloud}: a mesh has no classes, returns, splats, 16-bit colours or missing data: omit these options"
        )
    given = [
        option
        for option, values in (("--to-crs", (to_crs, crs)), ("--to-unit", (to_unit, unit, z_unit, crs)))
        if any(value is not None for value in values)
    ]

    def warn_of_file(line: str) -> None:
        if not any(option in line for option in given):  # no advice to do what is being done
            warn_unless(quiet)(line)

    def warn_of_system(line: str) -> None:
        warn_of_file(f"{cloud}: {line}")

    lines: list[str] = []
    with steps(quiet) as show:
        step = ProgressPlan(show, [source.reading_seconds, source.reading_seconds])
        step(f"reading {cloud}")
        if sample is not None:
            data = source.read_mesh(warn_of_file).sample(sample)
        elif source.is_mesh_only:
            mesh = source.read_mesh(warn_of_file)
            data = vertex_cloud(mesh)
            warn_unless(quiet)(f"{cloud}: {left_out_surface(len(data), pluralize(len(mesh), 'face'))}")
        else:
            data = source.read_cloud(warn_of_file, drop_nodata=drop_nodata, **options)
        with errors_named(cloud):
            if drop_zero:
                count = len(data)
                data = without_zeros(data)
                lines.append(f"removed {pluralize(count - len(data), 'point')} at x = y = z = 0")
            if drop_duplicates:
                count = len(data)
                data = without_duplicates(data)
                lines.append(f"removed {pluralize(count - len(data), 'point')} with the coordinates of an earlier one")
            if mirror is not None:
                data = data.transformed(reflection(mirror))
            if scale is not None:
                data = scale_coordinates(data, scale, warn_of_system if crs is None else lambda _: None)
            if crs is not None:
                data = state_crs(data, crs, warn_of_system)
            if unit is not None or z_unit is not None:
                data = state_unit(data, unit, z_unit, warn_of_system)
            if to_crs is not None:
                data, operation, operation_accuracy = project(data, to_crs, warn_of_system, accuracy=accuracy)
                stated = "accuracy not stated" if operation_accuracy is None else f"accuracy {operation_accuracy:.3g} m"
                lines.append(f"transformed by {operation}, {stated}")
            if to_unit is not None:
                data = convert_unit(data, to_unit)
            if offset is not None:
                data = shift_coordinates(data, offset, warn_of_system)
        step(f"writing {out}")
        write_cloud(out, data, on_warning=warn_unless(quiet))
    if not quiet:
        click.echo(f"{out}: {len(data):,} points")
        for line in lines:
            click.echo(f"  {line}")
