"""The pairs of an evaluation: from patterns with placeholders, or from a CSV file."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from glob import escape, glob
from pathlib import Path

from pcbench.errors import InputError
from pcbench.io.files import errors_named
from pcbench.io.paths import natural_key
from pcbench.regular_files import read_text

_PLACEHOLDER = re.compile(r"\{(scene|method)\}")
_ANY_BRACES = re.compile(r"\{[^{}]*\}")
_NAMED_PATTERN = re.compile(r"([^=/\\{}]+)=(.+)")
_COLUMNS = ("reference", "candidate", "scene", "method", "pose", "crop", "seconds")
_MAX_LISTED = 5


@dataclass(frozen=True)
class PlannedPair:
    """A candidate to evaluate.

    Attributes:
        scene: name of the scene.
        method: name of the method.
        reference: path of the ground truth.
        candidate: path of the reconstruction.
        register: how its pose is determined, as on the command line; `none`: it is in the reference's coordinates.
        crop: region to which the evaluation is limited, as on the command line.
        seconds: time that the method took, if it is given.
        missing: why it cannot be evaluated, such as that there is no file; empty if it can be.
    """

    scene: str
    method: str
    reference: str
    candidate: str
    register: str = "none"
    crop: str = "none"
    seconds: float | None = None
    missing: str = ""


@dataclass(frozen=True)
class EvaluationPlan:
    """The pairs of an evaluation, and what a reader has to know about their choice.

    Attributes:
        pairs: the pairs of all scenes and methods, by scene.
        notes: remarks about what is not among them.
        matched_methods: the methods that the placeholder {method} stood for.
    """

    pairs: tuple[PlannedPair, ...]
    notes: tuple[str, ...] = ()
    matched_methods: tuple[str, ...] = ()


class _Pattern:
    """A path with placeholders; `*` stands for any text inside a name."""

    def __init__(self, text: str) -> None:
        self.text = text.replace("\\", "/") if Path("\\").parts != ("\\",) else text
        if not text:
            raise InputError("expected the path of a file, with placeholders if there are several, got an empty text")
        if wrong := [part for part in _ANY_BRACES.findall(text) if not _PLACEHOLDER.fullmatch(part)]:
            raise InputError(f"{text}: expected the placeholders {{scene}} and {{method}}, got {wrong[0]}")
        if "}{" in text:
            raise InputError(
                f"{text}: expected text between {{scene}} and {{method}}, which nothing else separates: name the"
                " methods, as in points=points{scene}.ply"
            )
        self.placeholders = frozenset(_PLACEHOLDER.findall(text))

    def files(self) -> Iterator[tuple[dict[str, str], str]]:
        """Yield the values of the placeholders and the path of each match, by path."""
        seen: set[str] = set()
        expression = globbed = ""
        for number, part in enumerate(_PLACEHOLDER.split(self.text)):
            if number % 2 == 0:
                globbed += "*".join(map(escape, part.split("*")))
                expression += "[^/]*".join(map(re.escape, part.split("*")))
            else:
                globbed += "*"
                expression += f"(?P={part})" if part in seen else f"(?P<{part}>[^/]+?)"
                seen.add(part)
        for path in sorted(glob(globbed), key=natural_key):  # noqa: PTH207 (Path.glob takes no root)
            if match := re.fullmatch(expression, path.replace("\\", "/")):
                yield match.groupdict(), path

    def filled(self, scene: str, method: str) -> str:
        """Return the path of a scene and a method."""
        return fill(self.text, scene, method)

    def method_name(self) -> str:
        """Return a name for the only method of this pattern: its last folder without placeholder, or its file."""
        *folders, file = self.text.split("/")
        names = [name for name in folders if name not in ("", ".", "..") and not _PLACEHOLDER.search(name)]
        return names[-1] if names and "*" not in names[-1] else Path(file).stem


def fill(text: str, scene: str, method: str) -> str:
    """Return a text with the placeholders {scene} and {method} replaced."""
    return text.replace("{scene}", scene).replace("{method}", method)


def plan_patterns(
    reference: str, candidates: Sequence[str], *, register: str = "none", crop: str = "none"
) -> EvaluationPlan:
    """Return the pairs of all files that match patterns.

    Scenes whose names are numbers match by their value, such as 024 and 24. A scene for which no method has a file is
    not evaluated, and noted.

    Args:
        reference: path of the references, with {scene} if there are several.
        candidates: paths of the candidates, with {scene} and {method}, or one for each method as `PATTERN` or
            `NAME=PATTERN`.
        register: how poses are determined; {scene} and {method} are replaced.
        crop: region of each scene; {scene} and {method} are replaced.

    Raises:
        InputError: a pattern is not usable, no file matches, or two files belong to one scene and method.
    """
    truth = _Pattern(reference)
    if "method" in truth.placeholders:
        raise InputError(f"{reference}: expected references without {{method}}: all methods have the same reference")
    references = _references(truth)
    paths: dict[tuple[str, str], str] = {}
    methods: dict[str, _Pattern] = {}
    matched: dict[str, None] = {}  # methods that {method} stood for
    for text in candidates:
        name, pattern = _method_of(text, truth)
        if name is not None:
            if name in methods:
                raise InputError(f"{text}: two patterns belong to the method {name!r}: name them as NAME=PATTERN")
            methods[name] = pattern
        for values, path in pattern.files():
            method = name if name is not None else values["method"]
            key = (_scene_key(values.get("scene", "")), method)
            if name is None and _is_same_file(path, references.get(key[0])):
                continue  # {method} also matches the folder of the references
            methods.setdefault(method, pattern)
            if name is None:
                matched[method] = None
            if key in paths:
                raise InputError(
                    f"{path}: expected one candidate for each scene and method, got also {paths[key]}: make the"
                    " pattern more specific"
                )
            paths[key] = path
    if not paths:
        raise InputError(f"no file matches {' or '.join(candidates)}: check the folder and the placeholders")
    plan = _planned(references, methods, paths, register, crop)
    return replace(plan, notes=(*plan.notes, *_rare(matched, paths)), matched_methods=tuple(matched))


def _rare(methods: Iterable[str], paths: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield a note on each method with files for less than half of the scenes, which may be no method at all."""
    scenes = {scene for scene, _ in paths}
    counts = Counter(method for _, method in paths)
    for method in methods:
        if 2 * counts[method] < len(scenes):
            yield (
                f"{{method}} also matched {method}, which has files for {counts[method]} of {len(scenes)} scenes: if it"
                " is no method, name the methods as NAME=PATTERN"
            )


def _is_same_file(path: str, reference: tuple[str, str] | None) -> bool:
    return reference is not None and Path(path).resolve() == Path(reference[1]).resolve()


def _references(truth: _Pattern) -> dict[str, tuple[str, str]]:
    """Return the name and the path of each scene by its key."""
    if "scene" not in truth.placeholders:
        if not _exists(truth.text):
            raise InputError(f"{truth.text}: no such file: check the name and the folder")
        return {"": (_stem(truth.text), truth.text)}
    references: dict[str, tuple[str, str]] = {}
    for values, path in truth.files():
        key = _scene_key(values["scene"])
        if key in references:
            raise InputError(f"{path}: expected one reference for each scene, got also {references[key][1]}")
        references[key] = (values["scene"], path)
    if not references:
        raise InputError(f"no file matches {truth.text}: check the folder and the placeholder")
    return references


def _method_of(text: str, truth: _Pattern) -> tuple[str | None, _Pattern]:
    """Return the name of the method of a candidate pattern, or None if the pattern has {method}, and the pattern."""
    named = _NAMED_PATTERN.fullmatch(text)
    pattern = _Pattern(named[2] if named else text)
    if ("scene" in pattern.placeholders) != ("scene" in truth.placeholders):
        with_scene, without = (truth, pattern) if "scene" in truth.placeholders else (pattern, truth)
        raise InputError(f"{without.text}: expected {{scene}} as in {with_scene.text}, or in neither of them")
    if "method" not in pattern.placeholders:
        return (named[1] if named else pattern.method_name() if pattern.placeholders else _stem(pattern.text)), pattern
    if named:
        raise InputError(f"{text}: expected a name or {{method}}, got both")
    return None, pattern


def _planned(
    references: Mapping[str, tuple[str, str]],
    methods: Mapping[str, _Pattern],
    paths: Mapping[tuple[str, str], str],
    register: str,
    crop: str,
) -> EvaluationPlan:
    pairs: list[PlannedPair] = []
    evaluated = {key for key, _ in paths}
    without_candidates = [name for key, (name, _) in references.items() if key not in evaluated]
    for key, (scene, reference) in references.items():
        for method, pattern in methods.items() if key in evaluated else ():
            candidate = paths.get((key, method))
            missing = "" if candidate is not None else f"no file {pattern.filled(scene, method)}"
            pairs.append(
                PlannedPair(
                    scene,
                    method,
                    reference,
                    candidate or pattern.filled(scene, method),
                    fill(register, scene, method),
                    fill(crop, scene, method),
                    missing=missing,
                )
            )
    for (key, method), path in paths.items():
        if key not in references:
            pairs.append(PlannedPair(key, method, "", path, missing=f"no reference for the scene {key}"))
    return EvaluationPlan(tuple(pairs), tuple(_left_out(without_candidates, len(references))))


def _left_out(names: Sequence[str], total: int) -> Iterator[str]:
    """Yield a note on scenes without candidates, if there are any."""
    if names:
        verbs = ("have", "are") if len(names) > 1 else ("has", "is")
        shown = ", ".join(names[:_MAX_LISTED])
        rest = f" and {len(names) - _MAX_LISTED} others" if len(names) > _MAX_LISTED else ""
        yield f"{len(names)} of {total} scenes {verbs[0]} no candidate and {verbs[1]} left out: {shown}{rest}"


def plan_csv(file: Path, *, register: str = "none", crop: str = "none") -> EvaluationPlan:
    """Return the pairs of a CSV file.

    Its columns are reference, candidate, scene, method, pose (a text file with a 4x4 matrix), crop and seconds, in any
    order; only the first two are required. Paths are relative to the folder of the file.

    Args:
        file: CSV file with a header.
        register: how the poses are determined of pairs without one.
        crop: region of pairs without one.

    Raises:
        InputError: a column is unknown or missing, a value is not usable, or a scene and method occurs twice.
    """
    with errors_named(file):
        text = read_text(file)
    first_line = text.partition("\n")[0]
    separator = ";" if ";" in first_line and "," not in first_line else ","  # spreadsheets of some languages write ;
    rows = csv.DictReader(io.StringIO(text), delimiter=separator, skipinitialspace=True)
    header = [name.strip() for name in rows.fieldnames or ()]
    rows.fieldnames = header
    if unknown := [name for name in header if name not in _COLUMNS]:
        raise InputError(f"{file}: expected the columns {', '.join(_COLUMNS)}, got {unknown[0]!r}")
    if repeated := [name for name in _COLUMNS if header.count(name) > 1]:
        raise InputError(f"{file}: expected one column {repeated[0]!r}, got {header.count(repeated[0])}")
    if absent := [name for name in _COLUMNS[:2] if name not in header]:
        raise InputError(f"{file}: expected a column {absent[0]!r}, got {', '.join(header) or 'none'}")
    pairs = []
    for number, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise InputError(f"{file}, line {number}: expected {len(header)} columns as in its header")
        values = {name: (value or "").strip() for name, value in row.items()}
        if separator == ";":
            values["seconds"] = values.get("seconds", "").replace(",", ".")
        pairs.append(_row_pair(file, number, values, register, crop))
    if not pairs:
        raise InputError(f"{file}: expected a line for each pair, got none")
    check_pairs(pairs, str(file))
    return EvaluationPlan(tuple(pairs))


def _row_pair(file: Path, number: int, values: Mapping[str, str], register: str, crop: str) -> PlannedPair:
    for name in ("reference", "candidate"):
        if not values[name]:
            raise InputError(f"{file}, line {number}: expected a path in the column {name!r}, got none")
    reference, candidate = (str(file.parent / values[name]) for name in ("reference", "candidate"))
    scene, method = values.get("scene") or _stem(reference), values.get("method") or _stem(candidate)
    pose, region = values.get("pose", ""), values.get("crop", "")
    kind, colon, path = region.partition(":")
    if colon and kind == "polygon":
        region = f"polygon:{file.parent / path}"
    missing = [path for path in (reference, candidate) if not _exists(path)]
    return PlannedPair(
        scene,
        method,
        reference,
        candidate,
        f"matrix:{file.parent / pose}" if pose else fill(register, scene, method),
        region or fill(crop, scene, method),
        _seconds(file, number, values.get("seconds", "")),
        f"no file {missing[0]}" if missing else "",
    )


def _exists(path: str) -> bool:
    return Path(path).exists() or bool(glob(path))  # noqa: PTH207 (Path.glob takes no root)


def _seconds(file: Path, number: int, text: str) -> float | None:
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(f"{file}, line {number}: expected seconds as a positive number or nothing, got {text!r}")
    return value


def check_pairs(pairs: Iterable[PlannedPair], source: str) -> None:
    """Check that there is at most one pair for each scene and method.

    Raises:
        InputError: there are two; the message starts with `source`.
    """
    seen: set[tuple[str, str]] = set()
    for pair in pairs:
        if (pair.scene, pair.method) in seen:
            raise InputError(
                f"{source}: expected one pair for each scene and method, got two of {pair.scene} and {pair.method}:"
                " name them in the columns scene and method"
            )
        seen.add((pair.scene, pair.method))


def _stem(path: str) -> str:
    return Path(path).stem or path


def _scene_key(scene: str) -> str:
    return str(int(scene)) if scene.isascii() and scene.isdecimal() else scene
