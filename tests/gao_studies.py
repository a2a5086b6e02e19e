"""Results of `pcbench experiment gao` with known values, without any run."""

import math
from dataclasses import replace

import numpy as np

from pcbench.deformation import Amplitude, Bin, Deformation, Growth, Trend
from pcbench.measure.images import ViewScores
from pcbench.measure.presets import Gao2025
from pcbench.report import to_json
from pcbench.studies.gao.plan import FIELD, MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import (
    KIND,
    TRUTH,
    CameraErrors,
    CloudResult,
    GaoStudy,
    NewViews,
    ReferenceEvaluation,
    SceneResult,
    SurfaceDeformation,
)
from pcbench.studies.gao.sentences import sentences


def deformation(verdict, rms=0.01, slope=0.0):
    rows = tuple(Bin(10.0 * k, slope * 10 * k, (-0.01, 0.01), 0.02) for k in range(5))
    trend = Trend(slope, (slope - 1e-3, slope + 1e-3), rows)
    model = "cubic" if verdict == "non-affine" else "rigid"
    return Deformation(
        verdict, model, amplitude=Amplitude(rms, 2 * rms, 3 * rms, (0.9 * rms, 1.1 * rms)), growth=Growth(trend, trend)
    )


def evaluation(reference, c2r, r2c, known_deformation=None):
    """Evaluation with given RMS distances in both directions."""
    d2_poisson = 0.4 * c2r**2 if reference == MVS else None
    measures = Gao2025(c2r**2, 0.5 * c2r**2, d2_poisson, 3.0, c2r**2 + r2c**2, r2c**2)
    return ReferenceEvaluation(reference, 900, measures, 0.001, known_deformation or deformation("none"))


def scene(name="city_1", bends=(), truth=True, factor=1.0, **changes):
    """Results of a scene: sparse is incomplete, means are inaccurate, the surface is good.

    `bends` has deformations by cloud and reference.
    """
    bends = dict(bends)

    def cloud(cloud_name, c2r, r2c, error, seconds, **options):
        distances = [] if cloud_name == MVS else [(MVS, c2r, r2c)]
        distances += [(TRUTH, math.hypot(c2r, error), math.hypot(r2c, error))] if truth else []
        evaluations = tuple(evaluation(r, factor * f, factor * b, bends.get((cloud_name, r))) for r, f, b in distances)
        points = 11_000 if cloud_name == MEANS else 1000
        return CloudResult(cloud_name, points, seconds, False, 2**28, against=evaluations, **options)

    clouds = (
        cloud(SPARSE, 0.1, 2.0, 0.1, 30.0),
        cloud(MVS, 0.1, 0.2, 0.1, 100.0),
        cloud(MEANS, 0.4, 0.5, 0.1, 300.0),
        cloud(SURFACE, 0.2, 0.3, 0.1, 10.0, extra=True),
        cloud(FIELD, 0.6, 0.7, 0.1, 200.0),
    )
    views = NewViews(ViewScores(30.0, 0.9), ViewScores(25.0, 0.8), 35, 5, 0.5)
    references = {MVS: (5000, 4000), **({TRUTH: (9000, 8000)} if truth else {})}
    rings = tuple((10 * math.cos(a), 10 * math.sin(a), 5.0 + a) for a in np.linspace(0, 6, 12))
    surface_deformation = SurfaceDeformation(0.5, 0.25, ((5.0, 0.01), (30.0, -0.01)), ((1.0, 0.0), (9.0, 0.02)))
    errors = CameraErrors(40, 40, 0.1, 0.3, 1.001, 0, surface_deformation)
    result = SceneResult(
        name, f"/x/{name}", "m", 40, rings, (0.0, 0.0, 2.0), "sphere:0,0,2,50", errors, references, clouds, views
    )
    return replace(result, **changes)


def study(*scenes, poses="solve"):
    result = GaoStudy(poses, {"steps": "2000", "density": "classic"}, scenes, provenance={})
    return replace(result, sentences=tuple(sentences(result)))


def write_study(folder, results):
    """Write the files of a study and return their folder."""
    folder.mkdir(exist_ok=True)
    (folder / "experiment.json").write_text(to_json(KIND.values(results)))
    return folder
