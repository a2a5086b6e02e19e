"""The command line: arguments become calls, errors become one line. Heavy imports stand inside the commands."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pcbench import __version__
from pcbench.errors import InputError, PcbenchError

if TYPE_CHECKING:
    from pcbench.cloud import Cloud
    from pcbench.comparison import Comparison, Settings
    from pcbench.mesh import Mesh
    from pcbench.report import Inputs

_Number = TypeVar("_Number", int, float)

_FILE = click.Path(path_type=Path)
_REGISTER_HELP = "icp, icp-point, similarity (ICP with scale), points:FILE, matrix:FILE or none."
_CROP_HELP = "none, box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, polygon:FILE, reference or quantile:0.99."

register_option = click.option("--register", default="icp", show_default=True, metavar="HOW", help=_REGISTER_HELP)
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
@click.option("--seed", default=0, show_default=True, help="Of the bootstrap.")
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
    from pcbench.comparison import Settings
    from pcbench.report.folder import read_settings

    if settings_file is not None:
        given = [
            name
            for name in ("register", "crop", "thresholds", "presets", "maps", "classes", "returns", "seed")
            if _given(context, name)
        ]
        if reference is not None or given:
            raise click.UsageError("--settings already names the files and the settings: give nothing else but outputs")
        settings, recorded = read_settings(settings_file)
        reference = Path(recorded.reference["path"])
        named = {name: Path(values["path"]) for name, values in recorded.candidates.items()}
        expected = {name: values["sha256"] for name, values in recorded.by_name().items()}
    else:
        if reference is None or not candidates:
            raise click.UsageError("expected a reference and at least one candidate: pcbench compare ref.ply a.ply")
        settings = Settings(
            register=register,
            crop=crop,
            thresholds=_numbers("--thresholds", thresholds, float),
            presets=presets,
            maps=maps,
            seed=seed,
            classes=_numbers("--classes", classes, int),
            returns=returns,
        )
        named, expected = _names(candidates), {}
    outputs = _Outputs(out, json_file, figures=not no_figures, quiet=quiet)
    _compare_files(reference, named, settings, outputs, expected)


@app.command(short_help="Make a small city with exact truth and compare two clouds of it.")
@click.option("--out", type=_FILE, default=Path("demo"), show_default=True, help="Folder for clouds and report.")
@click.option("--points", default=1_270_820, show_default=True, help="Of the reference; candidates in proportion.")
@click.option("--seed", default=0, show_default=True, help="Of the city and its noise.")
@click.option("--no-figures", is_flag=True, help="Leave the pictures out.")
@quiet_option
def demo(out: Path, points: int, seed: int, no_figures: bool, quiet: bool) -> None:
    """Make a small city whose geometry is known exactly, a dense reference of it, a sparse and a densified candidate
    with noise, outliers and a rigid offset (the second also gently bent), and compare them.
    """
    from pcbench.comparison import Settings
    from pcbench.synthetic import demo as make_demo

    if points < 1000:
        raise InputError(f"expected at least 1000 points for the demo's reference, got {points}")
    with _steps(quiet) as step:
        step("making the city")
        scene = make_demo(points, seed)
        clouds = out / "clouds"
        clouds.mkdir(parents=True, exist_ok=True)
        paths = {name: clouds / f"{name}.ply" for name in ("reference", *scene.candidates)}
        from pcbench.io import write_cloud

        for name, path in paths.items():
            write_cloud(path, scene.reference if name == "reference" else scene.candidates[name])
    reference = paths.pop("reference")
    outputs = _Outputs(out / "report", None, figures=not no_figures, quiet=quiet)
    comparison = _compare_files(reference, paths, Settings(seed=seed), outputs)
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


@app.command(short_help="Cut a cloud to a region.")
@click.argument("cloud", type=_FILE)
@click.argument("out", type=_FILE)
@click.option("--crop", required=True, metavar="REGION", help=_CROP_HELP)
@quiet_option
def crop(cloud: Path, out: Path, crop: str, quiet: bool) -> None:
    """Write the points of CLOUD inside a region to OUT, with all their attributes."""
    from pcbench.crop import parse_region
    from pcbench.io import write_cloud

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
    from pcbench.io import write_cloud
    from pcbench.io.files import atomic_write
    from pcbench.registration import register as register_clouds
    from pcbench.transform import format_matrix

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
        _warn(warning)
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


@app.command(short_help="Draw a report's pictures again.")
@click.argument("report", type=_FILE)
@click.argument("names", nargs=-1)
@quiet_option
def plot(report: Path, names: tuple[str, ...], quiet: bool) -> None:
    """Draw the pictures of the folder REPORT into REPORT/figures, or those of NAMES (such as reference, distribution,
    a_distance, a_plane_distance). Needs no display.
    """
    from pcbench.plot import draw

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

    warn = (lambda _: None) if quiet else _warn
    data = read_cloud(cloud, on_warning=warn, classes=_numbers("--classes", classes, int), returns=returns)
    write_cloud(out, data)
    if not quiet:
        click.echo(f"{out}: {len(data):,} points")


@app.command(short_help="Say what is in a cloud.")
@click.argument("clouds", type=_FILE, nargs=-1, required=True)
def info(clouds: tuple[Path, ...]) -> None:
    """Say what is in each of CLOUDS: points, extent, spacing, normals, colours, attributes."""
    import numpy as np

    from pcbench.neighbors import Index

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


@dataclass(frozen=True)
class _Outputs:
    """Where results go."""

    folder: Path | None
    json_file: str | None
    figures: bool
    quiet: bool


def _compare_files(
    reference: Path,
    candidates: dict[str, Path],
    settings: Settings,
    outputs: _Outputs,
    expected: dict[str, str] | None = None,
) -> Comparison:
    """Read, compare, write: nothing is written unless everything went well."""
    from pcbench.comparison import compare as compare_clouds
    from pcbench.report import Inputs, document, print_table, report_folder, to_json, write_report

    def run(step: Callable[[str], None]) -> tuple[Comparison, dict[str, Any], Inputs]:
        clouds, files = {}, {}
        for name, path in {"reference": reference, **candidates}.items():
            step(f"reading {path}")
            clouds[name], files[name] = _read_input(path, settings, may_be_mesh=name == "reference")
            if expected and expected.get(name) not in (None, files[name]["sha256"]):
                files[name]["warnings"].append(f"{path}: the file has changed since the settings were written")
        truth = clouds.pop("reference")
        comparison = compare_clouds(truth, clouds, settings, on_step=step)
        inputs = Inputs(files["reference"], {name: files[name] for name in clouds})
        return comparison, document(comparison, inputs.by_name()), inputs

    without_figures = None
    with _steps(outputs.quiet) as step:
        if outputs.folder is None:
            comparison, doc, _ = run(step)
        else:
            with report_folder(outputs.folder) as folder:
                comparison, doc, inputs = run(step)
                step("writing the report")
                write_report(folder, comparison, doc, inputs)
                if outputs.figures:
                    step("drawing the pictures")
                    without_figures = _draw(folder)
    if outputs.json_file == "-":
        click.echo(to_json(doc), nl=False)
    elif outputs.json_file is not None:
        from pcbench.io.files import atomic_write

        with atomic_write(Path(outputs.json_file)) as file:
            file.write(to_json(doc).encode())
    if not outputs.quiet and outputs.json_file != "-":
        print_table(doc)
        if outputs.folder is not None:
            click.echo(f"report: {outputs.folder}")
    if without_figures:
        _warn(without_figures)
    return comparison


def _draw(folder: Path) -> str | None:
    """Draw a report's pictures; what stands in the way is returned, because the numbers are delivered all the same."""
    from pcbench.plot import draw

    try:
        draw(folder)
    except PcbenchError as error:
        return str(error)
    return None


def _read_input(path: Path, settings: Settings, *, may_be_mesh: bool) -> tuple[Cloud | Mesh, dict[str, Any]]:
    from pcbench.io import read_cloud
    from pcbench.io.files import digest
    from pcbench.io.meshes import holds_mesh, read_mesh

    warnings: list[str] = []
    data: Cloud | Mesh
    if may_be_mesh and holds_mesh(path):
        data = read_mesh(path, on_warning=warnings.append)
    else:
        data = read_cloud(path, on_warning=warnings.append)
    return data, {"path": str(path), "sha256": digest(path), "warnings": warnings}


def _read(path: Path, quiet: bool) -> Cloud:
    from pcbench.io import read_cloud

    return read_cloud(path, on_warning=(lambda _: None) if quiet else _warn)


def _names(paths: Sequence[Path]) -> dict[str, Path]:
    """Each candidate's name: its file's stem, with a number where stems are equal."""
    named: dict[str, Path] = {}
    taken = {path.stem for path in paths} | {"reference"}
    for path in paths:
        name, number = path.stem, 2
        if name in named or name == "reference":
            while f"{path.stem}_{number}" in taken:
                number += 1
            name = f"{path.stem}_{number}"
            taken.add(name)
        named[name] = path
    return named


def _numbers(option: str, text: str | None, kind: type[_Number]) -> tuple[_Number, ...] | None:
    if text is None:
        return None
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"expected {option} as numbers with commas, got {text!r}") from None


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
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda text: progress.update(task, description=text)


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2; anything else keeps its traceback."""
    try:
        app(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.UsageError as error:
        error.show()
        sys.exit(2)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
    except OSError as error:
        what = f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
        click.echo(f"error: {what}", err=True)
        sys.exit(2)
    except (PcbenchError, click.ClickException) as error:
        click.echo(f"error: {' '.join(str(error).split())}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
