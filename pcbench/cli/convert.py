"""Command that writes a cloud in another format: convert."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pcbench.cli.messages import steps, warn_unless
from pcbench.cli.options import FILE, color_depth_option, las_options, quiet_option, splat_options
from pcbench.options import parse_integers, parse_returns


@click.command(short_help="Write a cloud in another format.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@las_options
@splat_options
@color_depth_option
@click.option("--crs", metavar="CRS", help="Project x and y to this coordinate system, such as EPSG:32617.")
@click.option("--from-crs", metavar="CRS", help="Coordinate system of CLOUD, if its file states none.")
@click.option("--unit", metavar="UNIT", help="Convert x, y and z to this unit of length, such as m or US-ft.")
@click.option("--drop-nodata", is_flag=True, help="Remove points that stand for missing data, such as z = -9999.")
@click.option("--sample", type=click.IntRange(min=1), metavar="N", help="Sample N points on a mesh, uniformly by area.")
@click.option(
    "--mirror",
    type=click.Choice(("x", "y", "z", "xy", "xz", "yz")),
    help="Undo a mirrored export: negate one axis (x, y, z), or exchange two (xy, xz, yz).",
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
    from_crs: str | None,
    unit: str | None,
    drop_nodata: bool,
    sample: int | None,
    mirror: str | None,
    quiet: bool,
) -> None:
    """Write CLOUD to OUT in the format of OUT's extension, with normals, colours and attributes.

    A mesh is written as its vertices, or as points sampled on its surface (--sample). Heights keep their datum when x
    and y are projected (--crs).
    """
    from pcbench.errors import InputError
    from pcbench.geometry.mesh_samples import vertex_cloud
    from pcbench.geometry.reflections import reflection
    from pcbench.geometry.reprojection import convert_unit, project
    from pcbench.io import check_cloud_output, write_cloud
    from pcbench.io.files import errors_named
    from pcbench.io.las_records import NO_FILTERS, parse_filters
    from pcbench.io.outputs import check_output
    from pcbench.io.polygons import left_out_surface
    from pcbench.io.source import Source
    from pcbench.measure.wording import pluralize
    from pcbench.progress import ProgressPlan

    if from_crs is not None and crs is None:
        raise click.UsageError("--from-crs needs --crs, the new coordinate system")
    wanted_classes = None if classes is None else parse_integers("--classes", classes)
    wanted_returns = None if returns is None else parse_returns("--returns", returns)
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
    with steps(quiet) as show:
        step = ProgressPlan(show, [source.reading_seconds, source.reading_seconds])
        step(f"reading {cloud}")
        if sample is not None:
            data = source.read_mesh(warn_unless(quiet)).sample(sample)
        elif source.is_mesh_only:
            mesh = source.read_mesh(warn_unless(quiet))
            data = vertex_cloud(mesh)
            warn_unless(quiet)(f"{cloud}: {left_out_surface(len(data), pluralize(len(mesh), 'face'))}")
        else:
            data = source.read_cloud(warn_unless(quiet), drop_nodata=drop_nodata, **options)
        if mirror is not None:
            data = data.transformed(reflection(mirror))
        with errors_named(cloud):
            if crs is not None:
                data = project(data, crs, from_crs, lambda line: warn_unless(quiet)(f"{cloud}: {line}"))
            if unit is not None:
                data = convert_unit(data, unit)
        step(f"writing {out}")
        write_cloud(out, data, on_warning=warn_unless(quiet))
    if not quiet:
        click.echo(f"{out}: {len(data):,} points")
