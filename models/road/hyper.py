"""Settings of the road course that data can teach, [T17] section 4: "substitute manual-defined hyperparameters by
data-trained counterparts".

    clutter                                 share of clutter; logit
    KIND.std, KIND.flow_std                 how far single cues stray across the road and from its direction; log
    KIND.right.mean, KIND.right.std         prior of the offset on one side (`left`: oncoming traffic); plain and log
    beta_static, beta_vehicle, beta_flow    weights of the paper's likelihood, in place of clutter and strays; log
    prior.curvature_std and others          of the course (`OF_COURSE`); log

Only what some scene shows can be learnt; the end of the sight and changes of lanes are held as configured. The density
of a scene's draws z = (course, offset) under other settings is

    log p(z, y | h) = log p(course | h) + sum_g [log N(offset_g; mean_g, std_g^2) + log p(cues of g | z, h)] + const

where the sample of the course that is nearest to a cue does not depend on h and is found once.

What learning means for the paper's likelihood, which is no density of positions: it is taken as printed. Its position
error holds what sigma leaves out, the measured covariance and the way along the road to the nearest sample, up to half
the spacing, so beta_static falls below std^2 / (std^2 + spacing^2 / 12): it learns how coarse the samples are. Its flow
error 1 - cos is about angle^2 / 2. As a density of the angle its normaliser goes with beta^(1/4), not with the printed
beta^(1/2), so beta_flow comes out twice as large as that of a density. Only sigma^2 / beta matters, so the kinds' std
stay as they are. Its evidence compares settings of this likelihood with each other, not with those of `exact`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import expit, logit

from models.capability import Hyper
from models.clothoid_kernel import COLUMNS, LENGTH, hermite_one, sample_one
from models.program import InputError
from models.road.along_road import cue_arrays
from models.road.cue_kernel import nearest_sample, score_groups
from models.road.cues import KINDS, CueKind, Cues
from models.road.prior import course_moments

if TYPE_CHECKING:
    from models.road.course import RoadCourse

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
SHARED = ("clutter", "beta_static", "beta_vehicle", "beta_flow")
OF_COURSE = ("lateral_std", "heading_std", "curvature_std", "rate_std")  # of models.road.prior that all scenes teach
FACTOR_WIDTH = 1.0  # of the hyper-prior of logarithms: two of three within a factor of e
SHARE_WIDTH = 1.5  # of logits
MEAN_WIDTH = 3.0  # of means of offsets, in their configured standard deviations


class Setting(NamedTuple):
    """One number: its name, its configured value, how it is made unconstrained, the width of its hyper-prior."""

    name: str
    value: float
    scale: str  # plain, log or logit
    width: float


class Places(NamedTuple):
    """Where a scene's numbers stand among the settings, -1 for those that are not learnt.

    std, flow_std       (N,) of the cues
    mean, offset_std    (G,) of the offsets
    """

    std: Indices
    flow_std: Indices
    mean: Indices
    offset_std: Indices


def hyper(model: RoadCourse, scenes: Sequence[Cues], names: Sequence[str] = ()) -> Hyper:
    """The settings by these names, or by all of `learnable`; "delineator" stands for all that begin with it.

    Raises InputError for a name that is none and for a kind or side that no scene has."""
    settings = [setting(model, name) for name in chosen(model, scenes, names)]
    order = tuple(s.name for s in settings)
    scale = np.array([s.scale for s in settings])

    def natural(h: Floats) -> Floats:
        return np.where(
            scale == "plain", h, np.where(scale == "logit", expit(h), np.exp(np.where(scale == "log", h, 0)))
        )

    def with_settings(h: Floats) -> RoadCourse:
        return changed(model, dict(zip(order, natural(h).tolist(), strict=True)))

    def complete(cues: Cues, draws: dict[str, Floats]) -> Callable[[Floats], Floats]:
        density = scene_density(model, order, cues, draws)
        return lambda h: density(natural(h))

    start = [{"plain": float, "log": math.log, "logit": logit}[s.scale](s.value) for s in settings]
    return Hyper(order, np.array(start), np.array([s.width for s in settings]), natural, with_settings, complete)


def known_kinds(model: RoadCourse) -> dict[str, CueKind]:
    """All kinds of cues of a model by name."""
    return {kind.name: kind for kind in (*KINDS, *model.extra_kinds)}


def learnable(model: RoadCourse, scenes: Sequence[Cues]) -> list[str]:
    """Names of all settings that these scenes say something about."""
    sides = {(str(k), bool(left)) for cues in scenes for k, left in zip(cues.kind, cues.left, strict=True)}
    flows = {str(k) for cues in scenes for k in cues.kind[~np.isnan(cues.flow)]}
    kinds = [kind for name, kind in known_kinds(model).items() if {(name, False), (name, True)} & sides]
    exact, names = model.likelihood == "exact", []
    if exact and model.clutter > 0:
        names.append("clutter")
    if not exact:
        there = (any(not k.moves for k in kinds), any(k.moves for k in kinds), any(k.name in flows for k in kinds))
        names += [name for name, is_there in zip(SHARED[1:], there, strict=True) if is_there]
    for kind in kinds:
        if exact:
            names.append(f"{kind.name}.std")
            names += [f"{kind.name}.flow_std"] if kind.moves and kind.name in flows else []
        for side, left in (("right", False), ("left", True)):
            names += [f"{kind.name}.{side}.{what}" for what in ("mean", "std") if (kind.name, left) in sides]
    return names + [f"prior.{what}" for what in OF_COURSE]


def chosen(model: RoadCourse, scenes: Sequence[Cues], names: Sequence[str]) -> list[str]:
    """The learnable settings that are meant, in their own order."""
    for i, cues in enumerate(scenes):
        if len(cues.kind) == 0:
            raise InputError(f"scene {i} has no cues, so it teaches nothing; leave it out")
    there, meant = learnable(model, scenes), set[str]()
    for name in names:
        found = {each for each in there if each == name or each.startswith(f"{name}.")}
        if not found:
            raise InputError(_refusal(model, there, name))
        meant |= found
    return [each for each in there if each in meant or not names]


def _refusal(model: RoadCourse, there: list[str], name: str) -> str:
    kind, _, rest = name.partition(".")
    if name == "clutter" and model.likelihood == "exact":
        return "clutter is 0, from where no share can be learnt; begin with a little, such as model.clutter=0.02"
    if name in SHARED:
        return f"'{name}' has no part in these scenes under likelihood={model.likelihood}; there are {', '.join(there)}"
    if rest in ("std", "flow_std") and model.likelihood == "paper":
        return f"'{name}' and beta are one number to likelihood=paper; learn beta_static, beta_vehicle or beta_flow"
    if kind in known_kinds(model) and not any(each.startswith(f"{kind}.") for each in there):
        return f"'{name}' cannot be learnt: no scene has a {kind}; there are {', '.join(there)}"
    close = difflib.get_close_matches(name, there, n=1)
    hint = f"did you mean '{close[0]}'?" if close else f"there are {', '.join(there)}"
    return f"these scenes teach nothing called '{name}'; {hint}"


def setting(model: RoadCourse, name: str) -> Setting:
    """A setting as configured."""
    if name in SHARED:
        value = float(getattr(model, name))
        return Setting(name, value, *(("logit", SHARE_WIDTH) if name == "clutter" else ("log", FACTOR_WIDTH)))
    kind, *rest = name.split(".")
    if kind == "prior":
        return Setting(name, float(getattr(model.prior, rest[0])), "log", FACTOR_WIDTH)
    known = known_kinds(model)[kind]
    if len(rest) == 1:
        return Setting(name, float(getattr(known, rest[0])), "log", FACTOR_WIDTH)
    mean, std = known.left if rest[0] == "left" else known.right
    if rest[1] == "mean":
        return Setting(name, mean, "plain", MEAN_WIDTH * std)
    return Setting(name, std, "log", FACTOR_WIDTH)


def changed(model: RoadCourse, values: dict[str, float]) -> RoadCourse:
    """The model with other settings, by name."""
    own = {kind.name for kind in model.extra_kinds} | {name.partition(".")[0] for name in values if "." in name}
    kinds = []
    for name, kind in known_kinds(model).items():
        if name in own:
            pick = lambda what, value, name=name: values.get(f"{name}.{what}", value)  # noqa: E731
            sides = {
                side: (pick(f"{side}.mean", prior[0]), pick(f"{side}.std", prior[1]))
                for side, prior in (("right", kind.right), ("left", kind.left))
            }
            flow_std = pick("flow_std", kind.flow_std)
            kinds.append(replace(kind, **sides, std=pick("std", kind.std), flow_std=flow_std))  # type: ignore[arg-type]
    shared = {name: value for name, value in values.items() if name in SHARED}
    of_course = {name: values[f"prior.{name}"] for name in OF_COURSE if f"prior.{name}" in values}
    return replace(model, **shared, prior=replace(model.prior, **of_course), extra_kinds=tuple(kinds))  # type: ignore[arg-type]


def scene_density(
    model: RoadCourse, names: tuple[str, ...], cues: Cues, draws: dict[str, Floats]
) -> Callable[[Floats], Floats]:
    """The function that takes settings (H,) to log p(z, y | settings) (n,) at draws of course (n, 6) and offset (n, G),
    but for a constant."""
    evidence = model.prepare(cues)
    seen = evidence.cues.numpy()  # type: ignore[union-attr]
    course, offset = (np.ascontiguousarray(draws[site]) for site in ("course", "offset"))
    where, paper = places(names, cues, evidence.group), model.likelihood == "paper"
    configured = np.array([setting(model, name).value for name in names])
    shared = [i for i, name in enumerate(names) if name in SHARED]
    course_names = [i for i, name in enumerate(names) if name.startswith("prior.")]
    read = [i for i in np.unique([*shared, *where.std, *where.flow_std]).astype(int) if i >= 0]  # by the cues
    nearest = np.empty((len(course), len(seen), COLUMNS))
    near_samples(course, model.num_samples, cue_arrays(model, evidence, seen)[0], nearest)  # type: ignore[call-arg]

    def factors(values: Floats) -> Floats:
        out = np.ones(len(names) + 1)  # the last one for what is not learnt
        np.divide(values, configured, out=out[:-1], where=configured != 0)
        return out

    @lru_cache(maxsize=4)
    def of_cues(few: tuple[float, ...]) -> Floats:
        values = configured.copy()
        values[read] = few
        factor = factors(values)
        new = evidence._replace(
            spread=evidence.spread * factor[where.std], flow_spread=evidence.flow_spread * factor[where.flow_std]
        )
        settings = replace(model, **{names[i]: float(values[i]) for i in shared})  # type: ignore[arg-type]
        rows, group = cue_arrays(settings, new, seen)
        out = np.zeros(len(course))
        score_draws(paper, rows, group, offset, nearest, out)  # type: ignore[call-arg]
        return out

    @lru_cache(maxsize=4)
    def of_course(few: tuple[float, ...]) -> Floats:
        own = {names[i].partition(".")[2]: value for i, value in zip(course_names, few, strict=True)}
        mean, tril = course_moments(replace(model.prior, **own))
        apart = solve_triangular(tril, (course - mean).T, lower=True)
        return np.asarray(-0.5 * (apart**2).sum(0) - np.log(tril.diagonal()).sum())

    def density(values: Floats) -> Floats:
        loc = np.where(where.mean >= 0, values[where.mean], evidence.offset_loc)
        std = evidence.offset_std * factors(values)[where.offset_std]
        of_offsets = (-0.5 * ((offset - loc) / std) ** 2 - np.log(std)).sum(1)
        first, second = (tuple(values[few].tolist()) for few in (course_names, read))
        return np.asarray(of_course(first) + of_offsets + of_cues(second))

    return density


def places(names: tuple[str, ...], cues: Cues, group: Indices) -> Places:
    """Where the numbers of a scene stand among the settings."""
    index = {name: i for i, name in enumerate(names)}
    at = lambda heads, what: np.array([index.get(f"{head}.{what}", -1) for head in heads])  # noqa: E731
    first = np.unique(group, return_index=True)[1]  # a cue of each group
    sides = [f"{cues.kind[n]}.{'left' if cues.left[n] else 'right'}" for n in first]
    return Places(at(cues.kind, "std"), at(cues.kind, "flow_std"), at(sides, "mean"), at(sides, "std"))


@nb.njit(cache=True, error_model="numpy")
def near_samples(courses, num, cues, out):  # type: ignore[no-untyped-def]
    """Of `num` samples of each course (n, 6) the one nearest to each cue (N, WIDTH), out (n, N, COLUMNS); nan where no
    clothoid joins the ends."""
    clothoid, table = np.empty(6), np.empty((num, COLUMNS))
    for s in range(len(courses)):
        c = courses[s]
        hermite_one(c[0], c[1], c[2], c[3], c[4], c[5], clothoid)
        if clothoid[LENGTH] == np.inf:
            out[s] = np.nan
            continue
        step = sample_one(clothoid, table)
        for n in range(len(cues)):
            out[s, n] = table[nearest_sample(cues, n, table, step)]


@nb.njit(cache=True, error_model="numpy")
def score_draws(paper, cues, group, offset, nearest, out):  # type: ignore[no-untyped-def]
    """Adds the log density of all cues (N, WIDTH) at offsets (n, G) [m] and samples (n, N, COLUMNS) to out (n,)."""
    near, height, changes = np.arange(len(cues)), np.empty(offset.shape[1]), np.empty(offset.shape[1])
    for s in range(len(offset)):
        score_groups(paper, cues, group, near, offset[s], nearest[s], height, changes)
        out[s] += height.sum()
