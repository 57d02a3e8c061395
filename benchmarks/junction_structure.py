"""How often the structure of a junction is right: every arm within 10 degrees, no further arm, every E and O."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import fmean, median

from benchmarks.figure import Figure, Measurement, Value, Values, share
from benchmarks.junction import ANNEALED, DEFAULT, Effort, Scores, Setting, attempt, configured, m20, paper_lanes, score
from benchmarks.timing import p95
from experiments.scenarios.junction import DATA_ROOT, junction, names
from experiments.scenarios.protocol import protocol
from models.intersection.state import Junction
from models.program import InputError

ROOT = Path(__file__).resolve().parents[1]
DATA = str(ROOT / DATA_ROOT)
STEPS = (500, 1000, 2000, 5000, 10000)
MOST_FEW = 5  # vehicles on each lane
RIGHT = "share of protocol scenes with the structure right, as structure_5000 counts it"


def on_protocol(
    setting: Setting,
    num: int,
    what: str,
    show: bool,
    heading_std: float | None = None,
    occlusion: bool = False,
    tracks: int | None = None,
) -> Scores:
    """Scores on the frozen scenes 0 .. num - 1 after one untimed scene."""
    attempt(setting, protocol(0, heading_std=heading_std).data, 0)
    scenes = (protocol(i, heading_std=heading_std, occlusion=occlusion, tracks=tracks) for i in range(num))
    return score(setting, scenes, what, num, show)


def with_steps(setting: Setting, steps: int) -> Setting:
    """`steps` in all, shared by the chains."""
    each = steps // setting.knobs["num_chains"]
    return setting._replace(knobs=setting.knobs | {"num_steps": each, "warmup": each})


def main_job(effort: Effort) -> Values:
    """The default job, its wall time and the parts of it, from the same runs."""
    scores = on_protocol(DEFAULT, effort.scenes, "structure_5000", effort.show)
    parts = {
        "ms_structure_5000": [t.total for t in scores.trials],
        "ms_prepare": [t.prepare for t in scores.trials],
        "ms_chain": [t.chain for t in scores.trials],
        "ms_polish": [t.polish for t in scores.trials],
    }
    medians = {key: Value(1e3 * median(seconds), f"n = {len(seconds)}") for key, seconds in parts.items()}
    slowest = Value(1e3 * p95(parts["ms_structure_5000"]), f"n = {len(scores.trials)}")
    return {"structure_5000": share(scores.right, scores.refused), "ms_structure_5000_p95": slowest} | medians


MAIN_JOB = Measurement(
    (
        Figure(
            "structure_5000",
            "share",
            "share of protocol scenes with every arm within 10 deg of its own true arm, no other arm, and every E and "
            "O right: Junction(), positions only, two chains of 2500 steps annealed from T0 = 10, start=data, polish",
            ".999 topology [M19]",
            at_least=0.995,
        ),
        Figure(
            "ms_structure_5000",
            "ms",
            "wall time of structure_5000 from tracks to posterior (prepare and run), warm, median over scenes",
            "49",
            at_most=12.0,
        ),
        Figure("ms_structure_5000_p95", "ms", "the same, exceeded by one scene in twenty"),
        Figure("ms_prepare", "ms", "of it: tracks to evidence, first state and kernel, median"),
        Figure("ms_chain", "ms", "of it: 5000 steps with random numbers and snapshots, median", "49"),
        Figure("ms_polish", "ms", "of it: greedy search over edits, median"),
    ),
    main_job,
)


def one_share(
    effort: Effort, key: str, setting: Setting, few: bool, heading_std: float | None, occlusion: bool
) -> Values:
    num = min(effort.few if few else effort.scenes, effort.scenes)
    scores = on_protocol(setting, num, key, effort.show, heading_std, occlusion)
    return {key: share(scores.right, scores.refused)}


def variant(
    key: str,
    how: str,
    setting: Setting,
    paper: str = "",
    few: bool = False,
    heading_std: float | None = None,
    occlusion: bool = False,
) -> Measurement:
    """The share of right structures under one change to the default job."""
    measure = partial(one_share, key=key, setting=setting, few=few, heading_std=heading_std, occlusion=occlusion)
    return Measurement((Figure(key, "share", f"{RIGHT}: {how}", paper),), measure)


def few_tracks(effort: Effort) -> Values:
    values = {}
    for tracks in range(1, MOST_FEW + 1):
        key = f"structure_tracks_{tracks}"
        scores = on_protocol(DEFAULT, min(effort.few, effort.scenes), key, effort.show, tracks=tracks)
        values[key] = share(scores.right, scores.refused)
    return values


FEW_TRACKS = Measurement(
    tuple(
        Figure(f"structure_tracks_{n}", "share", f"{RIGHT}: as structure_5000, {n} vehicle{'s' * (n > 1)} on each lane")
        for n in range(1, MOST_FEW + 1)
    ),
    few_tracks,
)


def anytime(effort: Effort) -> Values:
    """Separate runs, each annealed within its own number of steps."""
    num, values, times = min(effort.few, effort.scenes), {}, []
    for steps in STEPS:
        scores = on_protocol(with_steps(DEFAULT, steps), num, f"anytime, {steps} steps", effort.show)
        values[str(steps)] = fmean(scores.right)
        times.append(f"{1e3 * median(t.total for t in scores.trials):.1f}")
    return {"anytime": Value(values, f"n = {num}; ms: {', '.join(times)}")}


ANYTIME = Measurement(
    (
        Figure(
            "anytime",
            "share",
            f"{RIGHT}, by number of steps: as structure_5000, every run annealed within its own steps, then polished",
        ),
    ),
    anytime,
)


def real(effort: Effort) -> Values:
    keys = [figure.key for figure in REAL.figures]
    try:
        clean = names("clean", DATA)
    except InputError as absent:
        return {key: Value(None, f"skipped: {absent}") for key in keys}
    setting, seeds = DEFAULT._replace(model=configured("junction_real")), range(effort.real_seeds)
    by_name: dict[str, float] = {}
    right: list[float] = []
    lanes: list[float] = []
    refused = 0
    for name in clean:
        scenes = (junction(name, seed, DATA) for seed in seeds)
        scores = score(setting, scenes, name, len(seeds), effort.show)
        by_name[name] = fmean(scores.right)
        right, lanes, refused = right + scores.right, lanes + scores.lanes, refused + scores.refused
    return {
        "structure_real": Value(fmean(right), f"{len(clean)} junctions, {len(seeds)} seeds each, {refused} refused"),
        "lanes_real": Value(fmean(lanes), f"n = {len(lanes)}"),
        "structure_real_names": Value(by_name, f"{len(seeds)} seeds each"),
    }


REAL = Measurement(
    (
        Figure(
            "structure_real",
            "share",
            "share of drives with every arm and lane count right: vehicles simulated on the real centre lines of the "
            "junctions marked clean, positions only, config model=junction_real, else as structure_5000",
        ),
        Figure("lanes_real", "share", "share of the entry and exit counts of all arms right, same runs"),
        Figure("structure_real_names", "share", "structure_real junction by junction"),
    ),
    real,
)

CHAIN = Setting(Junction(), ANNEALED)
MEASUREMENTS = (
    MAIN_JOB,
    variant("structure_chain_5000", "as structure_5000, the chain alone, not polished", CHAIN),
    variant("structure_heading_5000", "as structure_5000, headings measured with sd .1 rad", DEFAULT, heading_std=0.1),
    variant(
        "structure_w27_5000",
        "as structure_5000, lane width known to be 2.7 m and straight arms through one centre, as in [M20]",
        DEFAULT._replace(model=paper_lanes()),
    ),
    variant("structure_10000", "as structure_5000, 10000 steps", with_steps(DEFAULT, 10000)),
    variant(
        "structure_m20",
        "[M20] as printed but for the slip in its eq. 2: its moves, closest lane of half tracks, ratio "
        "(posterior)^(1/T) q/q without Jacobian, T 50 -> 1 in 5000 steps, three arms 120 deg apart at the centroid",
        m20(),
        ".999 topology [M19]",
        few=True,
    ),
    variant("structure_m20_printed", "as structure_m20, with eq. 2 as printed", m20(acceptance="printed"), few=True),
    variant(
        "structure_occlusion",
        "as structure_5000, seen from one standing vehicle behind three vans; lanes that nobody saw count as wrong",
        DEFAULT,
        few=True,
        occlusion=True,
    ),
    FEW_TRACKS,
    ANYTIME,
    REAL,
)
