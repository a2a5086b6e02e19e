"""Commands that run many reconstructions or comparisons: demo, bench, views."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pcbench.cli.completion import bench_method_names, reconstructor_names
from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.messages import name_files, steps, warn_of_missing, warn_unless
from pcbench.cli.options import (
    FILE,
    POSITIVE,
    cameras_option,
    crop_option,
    image_scale_option,
    key_value,
    masks_option,
    no_figures_option,
    quiet_option,
    register_option,
    seed_option,
)
from pcbench.cli.reports import compare_and_print
from pcbench.cli.workers import chosen_workers, workers_options
from pcbench.errors import ReconstructionError
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.studies.bench.runs import BenchJob
    from pcbench.tasks import Workers


@command(short_help="Compare clouds of a synthetic city, and reconstructors on another.")
@option(
    "--out",
    type=FILE,
    metavar="FOLDER",
    default=Path("demo"),
    show_default=True,
    help="Folder for clouds and report.",
)
@option(
    "--points",
    default=1_270_820,
    show_default=True,
    type=click.IntRange(20_000, 100_000_000),
    help="Number of points of the reference; the candidates have 1 % and 19 % of it.",
)
@seed_option("Random seed of the cities and their noise.")
@no_figures_option()
@option("--no-bench", is_flag=True, help="Do not run the reconstructors.")
@option("--no-clouds", is_flag=True, help="Run only the reconstructors.")
@quiet_option
def demo(out: Path, points: int, seed: int, no_figures: bool, no_bench: bool, no_clouds: bool, quiet: bool) -> None:
    """Compare clouds of a synthetic city, then compare reconstructors on another.

    The first city has a dense reference, and a sparse and a densified candidate with noise, outliers and a rigid
    offset; the second candidate is also slightly deformed. Photographs of the other city are reconstructed by sparse
    SfM and dense MVS at two image scales each, and by Gaussian splatting, as centres and as surface (extras plot, sfm,
    mvs, splat).
    """
    from pcbench.scenes.synthetic.files import claim_demo_folder
    from pcbench.scratch import lock_output

    if no_bench and no_clouds:
        raise click.UsageError("--no-bench and --no-clouds leave nothing to do: omit one of them")
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    click.get_current_context().with_resource(lock_output(out))
    claim_demo_folder(out)
    if not no_clouds:
        _demo_clouds(out, points, seed, figures=not no_figures, quiet=quiet)
    if not no_bench:
        _demo_bench(out, seed, figures=not no_figures, quiet=quiet)


def _demo_clouds(out: Path, points: int, seed: int, *, figures: bool, quiet: bool) -> None:
    from pcbench.comparison.request import Request
    from pcbench.measure.settings import Settings
    from pcbench.scenes.synthetic import demo as make_demo
    from pcbench.scenes.synthetic.files import write_demo

    with steps(quiet) as step:
        step("building the city")
        scene = make_demo(points, seed)
        files = write_demo(out, scene)
    request = Request.of(files.reference, files.candidates, Settings(seed=seed))
    comparison = compare_and_print(request, out / "report", None, figures=figures, quiet=quiet)
    if not quiet:
        for candidate in comparison.candidates:
            error = scene.registration_error(candidate.name, candidate.registration.T_reference_candidate)
            bend = scene.bend_rms[candidate.name]
            note = f", including its deformation of {1000 * bend:.0f} mm RMS" if bend else ""
            click.echo(f"truth: the pose of {candidate.name} is right to {1000 * error:.1f} mm RMS{note}")
        clouds = " ".join(map(str, (files.reference, *files.candidates.values())))
        click.echo(f"repeat with: pcbench compare {clouds} --out REPORT")


def _demo_bench(out: Path, seed: int, *, figures: bool, quiet: bool) -> None:
    from pcbench.studies.bench.demo import demo_job, why_not

    if reason := why_not():
        if not quiet:
            click.echo(f"bench skipped: {reason}")
        return
    with steps(quiet) as step:
        bench_job = demo_job(out / "city", seed, step)
    if not quiet:
        click.echo(f"\nbench: sparse SfM, dense MVS and Gaussian splatting on {out / 'city'}, with exact truth")
    _bench_and_print(bench_job, out / "bench", JsonOutput(None), figures=figures, quiet=quiet)


@command(short_help="Compare reconstructors: time and memory against accuracy.")
@click.argument("scene", type=FILE)
@option(
    "--reference",
    type=FILE,
    metavar="FILE",
    required=True,
    help="Reference cloud or mesh, in the frame of the scene's cameras.",
)
@option(
    "--method",
    "methods",
    multiple=True,
    metavar="NAME",
    help="Reconstructor, as in `reconstruct`; repeat to compare several.",
    values=reconstructor_names,
)
@option(
    "--sweep",
    "sweeps",
    multiple=True,
    metavar="[METHOD.]KEY=V,V,...",
    help="Run with each of these values; several sweeps give all combinations.",
)
@option(
    "--set",
    "settings",
    multiple=True,
    metavar="[METHOD.]KEY=VALUE",
    help="Setting of all methods that have it; may be repeated.",
)
@option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(1, 1000),
    help="Run each configuration with seeds 0 to N-1.",
    group=OptionGroup.LARGE_DATA,
)
@option("--out", type=FILE, metavar="FOLDER", required=True, help="Folder for the bench; a later run resumes from it.")
@option("--time-limit", type=POSITIVE, metavar="SECONDS", help="Time limit for each run.", group=OptionGroup.LARGE_DATA)
@cameras_option(
    "Cameras for the methods: auto, none, or a file or folder. The scene's cameras register the clouds in any case."
)
@masks_option
@option(
    "--truth-mesh",
    type=FILE,
    metavar="FILE",
    help="Mesh of the true surface, to which accuracy is measured.  [default: the scene's truth/mesh.ply]",
    group=OptionGroup.INPUT,
)
@register_option(
    "gauge",
    "Registration method: gauge (none if the cloud is georeferenced, else by its cameras), or as in `compare`.",
    OptionGroup.REGISTRATION,
    bench_method_names,
)
@crop_option
@option(
    "--threshold",
    metavar="LENGTH,...",
    help="Distance thresholds of precision, recall and F-score; `2px` is two pixels on the ground. Charts show the"
    " last.  [default: 1px,2px,5px]",
    group=OptionGroup.METRICS,
)
@workers_options("one run after another, each with all CPUs")
@no_figures_option("charts")
@json_option("bench.json")
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
    threshold: str | None,
    workers: int | None,
    cluster: str | None,
    no_figures: bool,
    json_file: str | None,
    quiet: bool,
) -> None:
    """Run each method with each combination of settings, and compare its cloud with the reference.

    KEY is image_scale or a setting of the methods. Each run is a child process. A failed run is recorded as a row with
    its reason. Finished runs are kept, so that the same command resumes after an interruption.

    \b
    Example: pcbench bench photos/ --reference truth.ply --method sfm --method mine.py:Mine
             --sweep image_scale=0.25,0.5,1 --seeds 3 --out bench/
    """
    from pcbench.geometry.region_text import region_file
    from pcbench.registration.given import method_files
    from pcbench.studies.bench.plan import Axis
    from pcbench.studies.bench.runs import BenchJob
    from pcbench.studies.bench.score import Rules

    axes = [*map(Axis.setting, settings), *map(Axis.sweep, sweeps)]
    rules = Rules(register, crop, threshold)
    job = BenchJob(scene, reference, methods, axes, seeds, cameras, masks, truth_mesh, time_limit, rules)
    output = JsonOutput(json_file)
    named = filter(None, [masks, truth_mesh, *method_files(register), region_file(crop)])
    output.check([scene, reference, *named], folder=out)
    chosen = chosen_workers(workers, cluster)
    _bench_and_print(job, out, output, workers=chosen, figures=not no_figures, quiet=quiet)


def _bench_and_print(
    job: BenchJob, out: Path, output: JsonOutput, *, workers: Workers | None = None, figures: bool, quiet: bool
) -> None:
    from pcbench.studies.bench.results import KIND
    from pcbench.studies.bench.runs import FinishedRun
    from pcbench.studies.bench.runs import bench as run_bench
    from pcbench.studies.bench.table import print_bench

    def say(done: FinishedRun) -> None:
        if not quiet:
            click.echo(f"{done.number}/{done.of} {done.summary}", err=output.on_stdout)

    with steps(quiet) as step:
        outcome = run_bench(
            job, out, workers=workers, figures=figures, on_row=say, on_step=step, on_warning=warn_unless(quiet)
        )
    study = outcome.study
    output.write(KIND.values(study))
    if not quiet and not output.on_stdout:
        click.echo()
        print_bench(study)
        click.echo(name_files("bench", out, "bench.md", "bench.csv", "bench.json"))
    warn_of_missing(outcome)
    if not study.scores:
        raise ReconstructionError(f"{out}: none of {len(study.rows)} runs could be measured: see the messages there")


@command(short_help="Measure rendered views of scenes against their photographs.")
@click.argument("scenes", nargs=-1, required=True, type=FILE, metavar="SCENE...")
@option(
    "--out",
    type=FILE,
    metavar="FOLDER",
    required=True,
    help="Folder for scores and pictures; a later run resumes from it.",
)
@option(
    "--method",
    default="splat",
    show_default=True,
    metavar="NAME",
    help="Reconstructor that renders the views.",
    values=reconstructor_names,
)
@option(
    "--hold-out",
    default="every",
    show_default=True,
    type=click.Choice(["every", "blocks"]),
    help="Held-out images: every 8th, or 8 blocks of images.",
)
@option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Setting of the method; may be repeated.",
)
@cameras_option()
@image_scale_option
@option(
    "--time-limit", type=POSITIVE, metavar="SECONDS", help="Time limit for each scene.", group=OptionGroup.LARGE_DATA
)
@no_figures_option()
@quiet_option
def views(
    scenes: tuple[Path, ...],
    out: Path,
    method: str,
    hold_out: str,
    settings: tuple[str, ...],
    cameras: str,
    image_scale: float,
    time_limit: float | None,
    no_figures: bool,
    quiet: bool,
) -> None:
    """Compare rendered views with their photographs: PSNR, SSIM, and LPIPS and FLIP if installed.

    Prints one row per SCENE, for training views and for held-out views. SCENE is a folder of photographs, which the
    method reconstructs and renders first; or a folder of rendered views; or a workspace that contains one (OUT.work of
    `pcbench reconstruct`). Pictures show the worst, the median and the best view.

    \b
    Example: pcbench views city_a/ city_b/ cloud.work/ --out views/
    """
    from pcbench.report import print_columns
    from pcbench.studies.views.runs import ViewsJob, run_views
    from pcbench.studies.views.table import sentences, table

    values = {"hold_out": hold_out, **dict(key_value(text) for text in settings)}
    job = ViewsJob(scenes, method, values, cameras, image_scale, time_limit)
    with steps(quiet) as step:
        outcome = run_views(job, out, figures=not no_figures, step=step)
    if not quiet:
        print_columns(table(outcome.study))
        for sentence in sentences(outcome.study):
            click.echo(sentence)
        click.echo(name_files("views", out, "views.md", "scores.csv", "scores.json"))
    warn_of_missing(outcome)
