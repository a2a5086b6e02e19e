"""Commands that take a cloud and give one: info, crop, register, convert."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pcbench.cli.messages import steps, warn, warn_unless
from pcbench.cli.options import (
    FILE,
    las_options,
    las_returns,
    numbers,
    quiet_option,
    register_option,
    required_crop_option,
)


@click.command(short_help="Cut a cloud to a region.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@required_crop_option
@quiet_option
def crop(cloud: Path, out: Path, crop: str, quiet: bool) -> None:
    """Write the points of CLOUD inside a region to OUT, with normals, colours and attributes."""
    from pcbench.errors import InputError
    from pcbench.geometry.crop import crop as crop_cloud
    from pcbench.io import read_cloud, write_cloud
    from pcbench.io.files import check_output, named_file

    check_output(out, [cloud, *filter(None, [named_file(crop)])])
    data = read_cloud(cloud, on_warning=warn_unless(quiet))
    try:
        inside = crop_cloud(data, crop)
    except InputError as error:
        raise InputError(f"{cloud}: {error}") from error
    write_cloud(out, inside)
    if not quiet:
        click.echo(f"{out}: {len(inside):,} of {len(data):,} points")


@click.command(short_help="Align a cloud to a reference.")
@click.argument("reference", type=FILE)
@click.argument("candidate", type=FILE)
@click.option("--out", type=FILE, help="Write the aligned candidate.")
@click.option("--matrix", type=FILE, help="Write the 4x4 matrix candidate -> reference.")
@register_option()
@quiet_option
def register(
    reference: Path, candidate: Path, out: Path | None, matrix: Path | None, register: str, quiet: bool
) -> None:
    """Align CANDIDATE to REFERENCE and say how well that is determined. Prints the 4x4 matrix."""
    from pcbench.geometry.transform import format_matrix
    from pcbench.io import read_cloud, write_cloud
    from pcbench.io.files import atomic_write, check_output, named_file, reading_seconds
    from pcbench.progress import Plan
    from pcbench.registration import register as register_clouds

    for path in filter(None, (out, matrix)):
        check_output(path, [reference, candidate, *filter(None, [named_file(register)])])
    with steps(quiet) as tell:
        reading = [reading_seconds(path) for path in (reference, candidate)]
        step = Plan(tell, [*reading, 0.5 + 15 * sum(reading)])
        clouds = []
        for path in (reference, candidate):
            step(f"reading {path}")
            clouds.append(read_cloud(path, on_warning=warn_unless(quiet)))
        reference_cloud, cloud = clouds
        step("registering")
        result = register_clouds(reference_cloud, cloud, register)
    text = format_matrix(result.T_reference_candidate)
    if out is not None:
        aligned = cloud.transformed(result.T_reference_candidate)
        if lost := set(cloud.attributes) - set(aligned.attributes):
            warn(f"{out}: left out {len(lost)} attributes that a change of frame makes wrong, such as {min(lost)!r}")
        write_cloud(out, aligned)
    if matrix is not None:
        with atomic_write(matrix) as file:
            file.write(text.encode())
    for warning in result.warnings:
        warn(str(warning))
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


@click.command(short_help="Write a cloud in another format.")
@click.argument("cloud", type=FILE)
@click.argument("out", type=FILE)
@las_options("a LAS file")
@quiet_option
def convert(cloud: Path, out: Path, classes: str | None, returns: str | None, quiet: bool) -> None:
    """Write CLOUD to OUT in the format that OUT's ending names, with normals, colours and attributes."""
    from pcbench.io import read_cloud, write_cloud
    from pcbench.io.files import check_output

    check_output(out, (cloud,))
    data = read_cloud(
        cloud, on_warning=warn_unless(quiet), classes=numbers("--classes", classes, int), returns=las_returns(returns)
    )
    write_cloud(out, data)
    if not quiet:
        click.echo(f"{out}: {len(data):,} points")


@click.command(short_help="Say what is in a cloud.")
@click.argument("clouds", type=FILE, nargs=-1, required=True)
def info(clouds: tuple[Path, ...]) -> None:
    """Say what is in each of CLOUDS: points, extent, spacing, normals, colours, attributes."""
    from pcbench.geometry.neighbors import Index, median_spacing
    from pcbench.io import read_cloud

    for path in clouds:
        cloud = read_cloud(path, on_warning=warn)
        lower, upper = cloud.bounds
        click.echo(f"{path}: {len(cloud):,} points")
        click.echo(f"  from   {_triple(lower)}")
        click.echo(f"  to     {_triple(upper)}")
        click.echo(f"  size   {_triple(upper - lower)} {cloud.unit or ''}".rstrip())
        if len(cloud) > 1:
            index = Index(cloud.points - lower)  # small numbers search more exactly
            spacing = median_spacing(index, index.nearest_other())  # of all points, as a comparison says it
            click.echo(f"  median distance to the nearest other point {spacing:.4g}")
        click.echo(f"  normals {'yes' if cloud.normals is not None else 'no'}", nl=False)
        click.echo(f", colours {'yes' if cloud.colors is not None else 'no'}, crs {cloud.crs or 'unknown'}")
        if cloud.attributes:
            click.echo(f"  attributes {', '.join(cloud.attributes)}")


def _triple(values: Any) -> str:
    return "  ".join(f"{v:.3f}" for v in values)
