"""False alarms and power of the deformation verdict: python tests/bench/deformation.py [--runs 500] [--power-runs 100]

Pairs of one inner piece of the synthetic city (exact tangent planes) with white and correlated noise; every row is
its noise. Beside our verdict, on the same data: the model that the BIC of all pairs picks, and the minimum of
tile-blocked cross-validation. `--times` measures two whole clouds instead.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from measure import limit_threads, setting

sys.path.insert(0, str(Path(__file__).parents[1]))

from bends import HARDLY_SHOWN, POINTS, SIZE, Cell, Halves, Judged, Scene, bends
from data_folder import data_folder

from pcbench import read_cloud
from pcbench.deformation.polynomials import PARAMETERS
from pcbench.deformation.verdict import climb

NULL = (
    Cell("gauss", 0),
    *(Cell(kernel, ratio) for kernel in ("gauss", "exp") for ratio in (100, 40, 20, 10)),
    Cell("gauss", 40, 2.0),
    Cell("gauss", 20, 2.0),
    Cell("gauss", 25, 1.0, 200_000),
)
POWER = tuple(Cell("gauss", ratio) for ratio in (100, 40, 20, 10))
# p without and with a dome, and the shares of non-affine verdicts of both.
Curves = dict[tuple[Cell, float], tuple[np.ndarray, np.ndarray, float, float]]
DOMES = (0.1, 0.25, 0.5, 1.0, 2.0)  # RMS, times the total noise
HEAD = f"{'N':>8}{'L m':>6}{'l m':>7}  {'noise':12}{'ratio':>5}"


def rivals(scene: Scene, judged: Judged, count: int) -> tuple[str, str]:
    """The models that naive BIC and minimum cross-validation pick."""
    g, scores = scene.geometry, judged.scores
    bic = {
        m: count * np.log(scores.energy.sum() - scores.total @ g.fit(m, scores.total)) + p * np.log(count)
        for m, p in PARAMETERS.items()
    }
    rungs = climb(g, scores, judged.noise, 0)
    return min(bic, key=lambda m: bic[m]), min(rungs, key=lambda rung: rung.cv_score).model


def null(scenes: dict[int, Scene], runs: int, which: list[int] | None) -> None:
    print(f"\nundeformed, {runs} runs a row: share of verdicts; wrong is any non-affine one")
    print(f"{HEAD}{'tiles':>6}{'none':>8}{'undecided':>10}{'affine':>8}{'wrong':>8}  {'naive BIC':>10}{'min CV':>8}")
    for cell in NULL if which is None else [NULL[number] for number in which]:
        if cell.points not in scenes:
            scenes[cell.points] = Scene(cell.points)
        scene = scenes[cell.points]
        waves = scene.waves(cell)
        rows = [scene.judge(scene.noise(cell, waves, 1000 + run)) for run in range(runs)]
        others = [rivals(scene, row, cell.points) for row in rows]
        tiles = len(scene.geometry.tile_matrices)
        verdicts = [row.finding.verdict for row in rows]
        share = {v: verdicts.count(v) / runs for v in ("none", "undecided", "affine", "similarity", "non-affine")}
        bent = [np.mean([other[k] in ("quadratic", "cubic") for other in others]) for k in (0, 1)]
        print(
            f"{cell}{tiles:6}{share['none']:8.3f}{share['undecided']:10.3f}"
            f"{share['affine'] + share['similarity']:8.3f}{share['non-affine']:8.3f}  {bent[0]:10.3f}{bent[1]:8.3f}",
            flush=True,
        )


def p_noise(judged: Judged) -> float:
    return judged.finding.evidence.p_noise


def power(scene: Scene, runs: int) -> Curves:
    tiles = len(scene.geometry.tile_matrices)
    dome = scene.beyond_affine(bends(scene.places, SIZE)["dome"])
    print(f"\na dome, {runs} runs a row; its RMS along the normals beyond affine, times the total noise")
    print(f"{HEAD}{'tiles':>6}{'RMS':>6}{'found':>8}{'undecided':>10}  {'ROC: at 1 % false':>18}{'5 %':>7}{'area':>7}")
    curves: Curves = {}
    for cell in POWER:
        waves = scene.waves(cell)
        flat = [scene.judge(scene.noise(cell, waves, 50_000 + run)) for run in range(runs)]
        without = np.array([p_noise(row) for row in flat])
        wrong = sum(row.finding.verdict == "non-affine" for row in flat) / runs
        for size in DOMES:
            bend = size * cell.total * dome
            rows = [scene.judge(scene.noise(cell, waves, 90_000 + run) + bend) for run in range(runs)]
            verdicts, p = [row.finding.verdict for row in rows], np.array([p_noise(row) for row in rows])
            at = [float(np.mean(p < np.quantile(without, share))) for share in (0.01, 0.05)]
            area = float(np.mean(p[:, None] < without[None]) + 0.5 * np.mean(p[:, None] == without[None]))
            curves[cell, size] = without, p, wrong, verdicts.count("non-affine") / runs
            print(
                f"{cell}{tiles:6}{size:6.2f}{verdicts.count('non-affine') / runs:8.2f}"
                f"{verdicts.count('undecided') / runs:10.2f}  {at[0]:18.2f}{at[1]:7.2f}{area:7.3f}",
                flush=True,
            )
    return curves


def draw(curves: Curves, file: str) -> None:
    """ROC curves of the test under the estimated noise, a panel for each noise; dots are the verdict's own."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(POWER), figsize=(12, 3.6), sharey=True, constrained_layout=True)
    colors = plt.colormaps["viridis"](np.linspace(0.85, 0.1, len(DOMES)))
    for axis, cell in zip(axes, POWER, strict=True):
        for size, color in zip(DOMES, colors, strict=True):
            without, p, wrong, found = curves[cell, size]
            limits = np.sort(np.concatenate([without, p]))
            false, right = (np.searchsorted(np.sort(x), limits, side="right") / len(x) for x in (without, p))
            line = np.concatenate([[0], false]), np.concatenate([[0], right])
            axis.step(*line, where="post", color=color, lw=1.6, label=f"{size:g} x the noise")
            axis.plot(wrong, found, marker="o", color=color, markersize=6, clip_on=False, zorder=3)
        axis.plot([0, 1], [0, 1], color="#A9ADB3", lw=0.8, zorder=0)
        axis.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="undeformed pairs called bent")
        axis.set_title(f"correlated over L/{cell.ratio}", fontsize=10, loc="left")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("domes found")
    axes[-1].legend(frameon=False, fontsize=8.5, loc="lower right", title="RMS of the dome", title_fontsize=8.5)
    figure.savefig(file, dpi=110)
    print(f"wrote {file}")


def halves(runs: int) -> None:
    """Real geometry: a verdict on halves of a LiDAR cloud, undeformed and with each bend."""
    cloud = read_cloud(data_folder("autzen") / "autzen_trim.las")
    print(
        f"\nhalves of autzen_trim.las ({len(cloud):,} points, feet), {runs} runs a row; error of the field over its RMS"
    )
    print("shown: share of the bend's RMS along normals; where that is little, RMS is of all of it, and none is right")
    print(
        f"{'bend':24}{'shown':>6}{'RMS':>6}{'found':>8}{'undecided':>10}{'affine':>8}{'none':>8}{'error':>8}{'largest':>9}"
    )
    scenes = [Halves(cloud, 0.1, 100 + run) for run in range(runs)]
    for kind in (None, *bends(np.zeros((1, 3)), SIZE)):
        shown = np.divide(*scenes[0].shown(kind)) if kind else 0.0
        for size in (1.0, 2.0, 5.0) if kind else (0.0,):
            rows = [scene.judge(kind, size) for scene in scenes]
            verdicts = [found.verdict for found, _ in rows]
            shares = [verdicts.count(v) / runs for v in ("non-affine", "undecided", "affine", "none")]
            errors = [error for found, error in rows if found.verdict == "non-affine" and shown >= HARDLY_SHOWN]
            print(
                f"{kind or 'none':24}{shown:6.2f}{size:6.1f}{shares[0]:8.2f}{shares[1]:10.2f}"
                f"{shares[2]:8.2f}{shares[3]:8.2f}" + (f"{np.median(errors):8.2f}{max(errors):9.2f}" if errors else ""),
                flush=True,
            )


def times(sizes: list[int]) -> None:
    """Seconds for two whole clouds that are registered and indexed, and whose normals are known, as in `compare`."""
    from pcbench.deformation import Side, residual_deformation
    from pcbench.geometry.neighbors import Index
    from pcbench.geometry.normals import Surface
    from pcbench.registration import Target, local_origin, register
    from pcbench.scenes.synthetic import demo

    print(f"\n{'reference':>10}{'candidate':>11}{'seconds':>9}  verdict")
    for size in sizes:
        scene = demo(size)
        origin = local_origin(scene.reference)
        surface = Surface(Index(scene.reference.points - origin))
        surface.normals(np.arange(len(surface)))
        truth = Side(surface, np.ones(len(surface), bool), scene.reference)
        for cloud in scene.candidates.values():
            found = register(scene.reference, cloud, target=Target(surface))
            index = Index(found.T_local.apply(cloud.points - origin))
            seconds = []
            for _ in range(5):
                start = time.perf_counter()
                side = Side(Surface(index), np.ones(len(index), bool), cloud)
                answer = residual_deformation(truth, side, found, origin)
                seconds.append(time.perf_counter() - start)
            print(f"{size:10,}{len(cloud):11,}{np.median(seconds):9.2f}  {answer.verdict}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--cells", type=int, nargs="*", help="which rows of the undeformed, from 0 (default: all)")
    parser.add_argument("--power-runs", type=int, default=100)
    parser.add_argument("--chart", metavar="FILE", help="draw the ROC curves of the domes")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--times", action="store_true", help="nothing but seconds for whole clouds")
    parser.add_argument("--halves", type=int, metavar="RUNS", help="nothing but halves of a LiDAR cloud")
    options = parser.parse_args()
    limit_threads(options.threads)
    print(setting())
    if options.halves:
        return halves(options.halves)
    if options.times:
        return times([100_000, 1_270_820, 5_000_000])
    scenes = {POINTS: Scene(POINTS)}
    if options.power_runs:
        curves = power(scenes[POINTS], options.power_runs)
        if options.chart:
            draw(curves, options.chart)
    if options.runs:
        null(scenes, options.runs, options.cells)


if __name__ == "__main__":
    main()
