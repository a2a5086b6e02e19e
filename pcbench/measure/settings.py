"""User settings of a comparison, stored with every result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.mesh_samples import MAX_SAMPLES
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.region_text import region_file
from pcbench.geometry.regions import Region
from pcbench.geometry.splats import check_limits
from pcbench.geometry.transform import Similarity
from pcbench.io.check_points import read_check_points
from pcbench.io.named_code import code_file
from pcbench.measure import presets
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.own_metrics import MetricFunction, OwnMetric, check_metrics, installed_metrics, split_metrics
from pcbench.options import (
    CLASSES_HELP,
    CROP_HELP,
    MAX_AXIS_HELP,
    METRIC_HELP,
    MIN_OPACITY_HELP,
    REGIONS,
    REGISTER_HELP,
    RETURNS_HELP,
    VERTICES_HELP,
    Bounds,
    OptionGroup,
    parse_integers,
    parse_lengths,
    parse_returns,
    parse_share,
    setting,
)
from pcbench.registration import ControlPoints, GivenPose, Method, as_method, as_similarity
from pcbench.registration.control_points import fit_pairs
from pcbench.registration.given import absolute_text, method_files
from pcbench.registration.methods import METHODS

MAPS = ("poisson", "poisson-meshlab", "m3c2")
_RARE_SETTINGS = ("tolerance", "vertices", "samples", "mpeg_peak", "checkpoints", "metrics", "deformation")
_THRESHOLD_SPACINGS = (1.0, 2.0, 5.0)  # of the default thresholds of the F-score


@dataclass(frozen=True)
class Settings:
    """User settings of a comparison, stored with every result.

    Attributes:
        register: registration method: an `IcpSettings`, `FeatureSettings`, `ControlPoints`, `TrajectorySettings` or
            `GivenPose`, a `Similarity` or 4x4 array as the pose itself, or the text of one, see
            `pcbench.registration.parse_method`.
        crop: measured region in the reference's coordinates, such as `pcbench.Box`, or its text, see
            `pcbench.geometry.region_text.parse_region`.
        thresholds: distance thresholds of the F-score, in the clouds' unit; None: 1, 2 and 5 times the reference's
            median spacing.
        presets: definitions of other tools and papers to report besides `gao2025` and `mpeg`, see `measured_presets`.
        maps: further deviation maps: `poisson` (to a Poisson mesh of the reference, by Open3D), `poisson-meshlab`
            (by pymeshlab) and `m3c2`.
        m3c2: settings of M3C2: an `M3C2Settings`, or its text such as `radius=0.5,depth=2`; implies the map `m3c2`.
        seed: random seed: for points sampled on meshes, for the sample behind the floor of D2 from
            reference to candidate, and for the folds of the cross-validation of deformation models.
        normal_neighbors: number of points for estimating a normal of the reference, if its file has none.
        classes, returns: LAS classes and returns to keep, see `pcbench.read_cloud`.
        min_opacity, max_axis: limits for keeping Gaussian splats, see `pcbench.read_cloud`.
        vertices: whether candidate meshes are measured at their vertices rather than at points sampled on their faces.
        samples: number of points sampled on each mesh; None: see `pcbench.geometry.mesh_samples`.
        mpeg_peak: peak of MPEG's PSNR in the clouds' unit, the `--resolution` of pc_error; None: the largest distance
            between nearest neighbours in the reference.
        tolerance: for large clouds: estimate D2 from a random sample that is large enough for a 95 % confidence
            interval of each mean square within this share of it, such as 0.01. Distances to points are exact. None:
            measure D2 at all points.
        initial: initial pose candidate -> reference for ICP, a `Similarity` or 4x4 array; None: the identity.
        checkpoints: file of check points, in the coordinates of the reference, by which the accuracy of all clouds is
            tested, see `pcbench.io.check_points`.
        metrics: user-defined metrics: functions of a `pcbench.measure.own_metrics.MeasuredPair`, or their texts such as
            `FILE.py:function`; `fscore@0.05` adds 0.05 to `thresholds` instead.
        deformation: whether to test the candidates for deformation, which takes up to a third of the time in large
            clouds and more than half of it in small ones.
    """

    register: Method | Similarity | ArrayLike | str = setting(
        "icp", "--register", REGISTER_HELP, metavar="HOW", shows_default=True, values=METHODS
    )
    crop: Region | str = setting("none", "--crop", CROP_HELP, metavar="REGION", shows_default=True, values=REGIONS)
    thresholds: tuple[float, ...] | None = setting(
        None,
        "--thresholds",
        "Distance thresholds of the F-score.  [default: 1, 2 and 5 times the reference's point spacing]",
        metavar="T,T,...",
        parse=parse_lengths,
    )
    presets: tuple[str, ...] = setting(
        (),
        "--preset",
        "Besides gao2025 and mpeg, compute metrics as open3d, pytorch3d, kaolin, point-cloud-utils, pdal or tnt define"
        " them (repeatable).",
        metavar="NAME",
        is_repeatable=True,
        group=OptionGroup.METRICS,
        values=presets.NAMES,
    )
    maps: tuple[str, ...] = setting(
        (),
        "--map",
        "Also compute this deviation map: poisson, poisson-meshlab or m3c2 (repeatable).",
        metavar="NAME",
        is_repeatable=True,
        group=OptionGroup.METRICS,
        values=MAPS,
    )
    seed: int = setting(
        0,
        "--seed",
        "Random seed.",
        bounds=Bounds(int, 0),
        shows_default=True,
        group=OptionGroup.METRICS,
    )
    normal_neighbors: int = 20
    classes: tuple[int, ...] | None = setting(
        None, "--classes", CLASSES_HELP, metavar="N,N,...", parse=parse_integers, group=OptionGroup.INPUT
    )
    returns: str | tuple[int, ...] | None = setting(
        None,
        "--returns",
        RETURNS_HELP,
        metavar="WHICH",
        parse=parse_returns,
        group=OptionGroup.INPUT,
    )
    min_opacity: float | None = setting(
        None,
        "--min-opacity",
        MIN_OPACITY_HELP,
        metavar="OPACITY",
        bounds=Bounds(float, 0, 1),
        group=OptionGroup.INPUT,
    )
    max_axis: float | None = setting(
        None,
        "--max-axis",
        MAX_AXIS_HELP,
        metavar="LENGTH",
        bounds=Bounds(float, 0, is_open=True),
        group=OptionGroup.INPUT,
    )
    initial: Similarity | ArrayLike | None = None
    m3c2: M3C2Settings | str | None = setting(
        None,
        "--m3c2",
        "Settings of --map m3c2, which they imply: radius, depth, normal_radius, registration_error, cores=FILE.",
        metavar="NAME=VALUE,...",
        group=OptionGroup.METRICS,
    )
    tolerance: float | None = setting(
        None,
        "--tolerance",
        "Estimate D2 from a sample that is large enough for a 95 % confidence interval within this tolerance, such as"
        " 1%.",
        metavar="PERCENT",
        parse=parse_share,
        group=OptionGroup.LARGE_DATA,
    )
    vertices: bool = setting(
        False,
        "--vertices",
        VERTICES_HELP,
        group=OptionGroup.INPUT,
    )
    samples: int | None = setting(
        None,
        "--sample",
        "Points sampled on each mesh, by area.  [default: a million on a reference; on a candidate ten per point of the"
        " reference, 100,000 to 5 million]",
        bounds=Bounds(int, 1, MAX_SAMPLES),
        group=OptionGroup.INPUT,
    )
    mpeg_peak: float | None = setting(
        None,
        "--mpeg-peak",
        "Peak of MPEG's PSNR, such as 1023.  [default: the largest distance between nearest neighbours in the"
        " reference]",
        metavar="LENGTH",
        bounds=Bounds(float, 0, is_open=True),
        group=OptionGroup.METRICS,
    )
    checkpoints: str | None = setting(
        None,
        "--checkpoints",
        "Also test all clouds by the check points in this file.",
        metavar="FILE",
        group=OptionGroup.METRICS,
    )

    metrics: tuple[str | MetricFunction | OwnMetric, ...] = setting(
        (),
        "--metric",
        METRIC_HELP,
        metavar="WHICH",
        is_repeatable=True,
        group=OptionGroup.METRICS,
        values=installed_metrics,
    )
    deformation: bool = setting(
        True,
        "--no-deformation",
        "Do not test for deformation, which takes up to half of the time.",
        parse=lambda flag, is_given: not is_given,
        group=OptionGroup.METRICS,
    )

    def __post_init__(self) -> None:
        metrics, thresholds = split_metrics(self.metrics)
        if self.checkpoints is not None:
            object.__setattr__(self, "checkpoints", str(self.checkpoints))
        if not isinstance(self.register, str):  # a text is parsed when it is used
            object.__setattr__(self, "register", as_method(self.register))
        if self.initial is not None:
            object.__setattr__(self, "initial", as_similarity(self.initial))
        if not isinstance(self.crop, Region | str):
            raise InputError(f"expected crop as a region or as text, got {self.crop!r}")
        if self.thresholds is not None:
            thresholds = (*_positive(self.thresholds), *thresholds)
        object.__setattr__(self, "metrics", metrics)
        object.__setattr__(self, "thresholds", tuple(dict.fromkeys(thresholds)) or None)
        if not _is_integer(self.seed) or self.seed < 0:
            raise InputError(f"expected the seed as a whole number >= 0, got {self.seed!r}")
        if not _is_integer(self.normal_neighbors) or not 3 <= self.normal_neighbors <= 1000:
            raise InputError(f"expected 3 to 1000 neighbours for a normal, got {self.normal_neighbors!r}")
        if not isinstance(self.vertices, bool):
            raise InputError(f"expected vertices as True or False, got {self.vertices!r}")
        if not isinstance(self.deformation, bool):
            raise InputError(f"expected deformation as True or False, got {self.deformation!r}")
        if self.samples is not None and not (_is_integer(self.samples) and 1 <= self.samples <= MAX_SAMPLES):
            raise InputError(f"expected 1 to {MAX_SAMPLES:,} samples on a mesh, got {self.samples!r}")
        if self.mpeg_peak is not None and not (_is_number(self.mpeg_peak) and 0 < self.mpeg_peak < np.inf):
            raise InputError(f"expected the peak of MPEG's PSNR as a length above 0, got {self.mpeg_peak!r}")
        check_limits(self.min_opacity, self.max_axis)
        wanted, maps = _names("presets", self.presets), _names("maps", self.maps)
        if unknown := [name for name in wanted if name not in presets.NAMES]:
            raise InputError(_unknown_preset(unknown[0]))
        if unknown := [name for name in maps if name not in MAPS]:
            hint = did_you_mean(unknown[0], MAPS)
            raise InputError(f"unknown map {unknown[0]!r}: expected one of {', '.join(MAPS)}{hint}")
        if self.tolerance is not None:
            object.__setattr__(self, "tolerance", _check_tolerance(self.tolerance))
        object.__setattr__(self, "presets", tuple(dict.fromkeys(wanted)))
        if isinstance(self.m3c2, str):
            object.__setattr__(self, "m3c2", M3C2Settings.parse(self.m3c2))
        if not isinstance(self.m3c2, M3C2Settings | None):
            raise InputError(f"expected m3c2 as M3C2Settings or as text, got {type(self.m3c2).__name__}")
        if self.m3c2 is not None and "m3c2" not in maps:
            maps = (*maps, "m3c2")
        object.__setattr__(self, "maps", maps)

    def with_files_read(self) -> Settings:
        """Return the settings with the method, the region and the metrics that files describe; paths become absolute.

        Raises:
            InputError: there is no such method, or a file cannot be read.
        """
        register, crop, m3c2, checkpoints = self.register, self.crop, self.m3c2, self.checkpoints
        if isinstance(register, str) and method_files(register):
            register = as_method(absolute_text(register))
        if isinstance(crop, str) and (file := region_file(crop)) is not None:
            crop = read_polygon(file.absolute())
        if isinstance(m3c2, M3C2Settings):
            m3c2 = m3c2.absolute()
        if checkpoints is not None:
            read_check_points(checkpoints)  # a mistake ends the comparison before it begins
            checkpoints = str(Path(checkpoints).absolute())
        metrics = tuple(map(OwnMetric.of, self.metrics))
        return replace(self, register=register, crop=crop, m3c2=m3c2, checkpoints=checkpoints, metrics=metrics)

    @property
    def files(self) -> list[Path]:
        """Files that settings name, each once: of registration, region, core points of M3C2, check points, metrics."""
        named = self.register if isinstance(self.register, str) else None
        method = as_method(self.register).files if named is None else method_files(named)
        cores = self.m3c2.file if isinstance(self.m3c2, M3C2Settings) else None
        check_points = None if self.checkpoints is None else Path(self.checkpoints)
        code = [code_file(metric) if isinstance(metric, str) else metric.path for metric in self.own_metrics]
        files = [*method, *filter(None, (region_file(self.crop), cores, check_points, *code))]
        return list(dict.fromkeys(files))

    @property
    def unset(self) -> tuple[str, ...]:
        """Names of the settings that are stored only if they are set, and are not."""
        return tuple(name for name in _RARE_SETTINGS if getattr(self, name) == getattr(Settings, name))

    @property
    def own_metrics(self) -> tuple[str | OwnMetric, ...]:
        """User-defined metrics, of which only texts are not yet imported."""
        return check_metrics(self.metrics)

    @property
    def known_pose(self) -> Similarity | None:
        """Pose candidate -> reference that the settings give or start from; None: the identity."""
        method = as_method(self.register)
        if isinstance(method, GivenPose):
            return method.T_reference_candidate
        if isinstance(method, ControlPoints):
            return fit_pairs(method)[0]
        return None if self.initial is None else as_similarity(self.initial)

    @property
    def measured_presets(self) -> tuple[str, ...]:
        """The presets that are computed: those that are always reported, and the given ones."""
        return (*(name for name in presets.ALWAYS if name not in self.presets), *self.presets)

    def thresholds_for(self, spacing: float) -> tuple[float, ...]:
        """Return the thresholds of the F-score for a reference of this spacing."""
        if self.thresholds is not None:
            return self.thresholds
        return tuple(factor * spacing for factor in _THRESHOLD_SPACINGS if spacing > 0)

    def with_cores_read(self) -> Settings:
        """Return the settings with the core points of M3C2 read from their file, if they name one.

        Raises:
            InputError: the file cannot be read.
        """
        return replace(self, m3c2=self.m3c2.read()) if isinstance(self.m3c2, M3C2Settings) else self

    def plain(self) -> dict[str, Any]:
        """Return the settings as JSON values: methods and regions as text; rare ones only if they are set."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in ("initial", "m3c2")}
        for name in self.unset:
            del values[name]
        if self.metrics:
            values["metrics"] = [metric if isinstance(metric, str) else metric.text for metric in self.own_metrics]
        if isinstance(self.m3c2, M3C2Settings):
            values["m3c2"] = self.m3c2.text
        values["presets"] = self.measured_presets
        for name in ("register", "crop"):
            values[name] = getattr(values[name], "text", values[name])
        return values if self.initial is None else {**values, "initial": as_similarity(self.initial).matrix}


def with_changes(settings: Settings | None, changed: Mapping[str, Any]) -> Settings:
    """Return settings, or the defaults, with some of them changed by name.

    Raises:
        InputError: the setting does not exist or its value is not usable, or `settings` has the wrong type.
    """
    settings = Settings() if settings is None else settings
    if not isinstance(settings, Settings):
        raise InputError(f"expected settings as pcbench.Settings, got {type(settings).__name__}")
    names = [item.name for item in fields(Settings)]
    if unknown := [name for name in changed if name not in names]:
        hint = did_you_mean(unknown[0], names)
        raise InputError(f"unknown setting {unknown[0]!r}: expected one of {', '.join(names)}{hint}")
    return replace(settings, **changed)


def _unknown_preset(name: Any) -> str:
    from pcbench.measure.protocols.registry import PROTOCOLS

    text = f"unknown preset {name!r}: expected one of {', '.join(presets.NAMES)}"
    if name not in PROTOCOLS:
        text += did_you_mean(name, presets.NAMES)
    else:
        text += f"; {name} evaluates files of a benchmark: pcbench evaluate REFERENCE CANDIDATE --protocol {name}"
    return text


def _check_tolerance(value: Any) -> float:
    try:
        share = float(value)
    except (TypeError, ValueError, OverflowError):
        share = np.nan
    if isinstance(value, bool) or not 0 < share < 1:
        raise InputError(f"expected a tolerance above 0 and below 1 (100 %), such as 0.01 (1 %), got {value!r}")
    return share


def _names(what: str, given: Any) -> tuple[Any, ...]:
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise InputError(f"expected {what} as several names, in a tuple or list, got {given!r}")
    return tuple(given)


def _positive(values: Any) -> list[float]:
    try:
        numbers = [] if isinstance(values, str) else [float(v) for v in values]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if not numbers or not all(np.isfinite(v) and v > 0 for v in numbers):
        got = ", ".join(map(str, values)) if isinstance(values, tuple | list) and values else repr(values)
        raise InputError(f"expected thresholds as one or more lengths above 0, such as 0.1 and 0.5; got {got}")
    return numbers


def _is_number(value: Any) -> bool:
    return _is_integer(value) or isinstance(value, float | np.floating)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
