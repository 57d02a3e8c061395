"""How far ahead the course is right, how far off it is, and whether its bands say so."""

from __future__ import annotations

from statistics import fmean, median

import numpy as np

from benchmarks.figure import Figure, Measurement, Value, Values, share
from benchmarks.road_trials import Effort, best_checks, drive, frozen, paired_loss, reference, shares
from experiments.road_metrics import CUT, LEAST_RANGE, PRICE, TOLD, RoadCheck

SCENES = "frozen scenes of night_road, engine=importance"


def reached(check: RoadCheck) -> float:
    """How far the estimate is offered [m]: an abstention offers nothing."""
    return 0.0 if check.outcome == "none" else check.reach


def calibrated(effort: Effort) -> Values:
    checks = best_checks(effort)
    outcomes = [check.outcome for check in checks]
    return {
        f"{key}_mid": share(shares(outcome == name for outcome in outcomes))
        for key, name in (("tpr", "true"), ("fpr", "false"), ("abstain", "none"))
    } | {"range_m": Value(fmean(map(reached, checks)), f"median {median(map(reached, checks)):.0f} m")}


CALIBRATED = Measurement(
    (
        Figure(
            "tpr_mid",
            "share",
            f"{SCENES}: course wholly inside the mid tube (.6 + .010 r) from 5 m to its calibrated range, the "
            f"r worth most, r - {PRICE:.0f} m (1 - P), where the posterior probability P of staying inside is {CUT} or "
            "more; of all scenes",
            ".922",
            at_least=0.95,
        ),
        Figure("fpr_mid", "share", "the same: not inside up to there", ".047", at_most=0.04),
        Figure(
            "abstain_mid", "share", f"the same: calibrated range below {LEAST_RANGE:.0f} m, nothing offered", ".031"
        ),
        Figure("range_m", "m", "the same: mean calibrated range, 0 for an abstention", "140", at_least=125.0),
    ),
    calibrated,
)


def fixed(effort: Effort) -> Values:
    checks = best_checks(effort)
    values = {"tpr_wide_140": share(shares(check.inside("wide") for check in checks))}
    values["tpr_mid_140"] = share(shares(check.inside("mid") for check in checks))
    for distance in TOLD:
        i = checks[0].at(distance)
        errors = [abs(check.error[i]) for check in checks]
        tail = f"n = {len(errors)}, 95 % below {np.quantile(errors, 0.95):.2f} m"
        values[f"lat_m_{distance:.0f}"] = Value(float(median(errors)), tail)
        values[f"cover90_{distance:.0f}"] = share(shares(check.covered[i] for check in checks))
    return values


FIXED = Measurement(
    (
        Figure(
            "tpr_wide_140",
            "share",
            f"{SCENES}: course wholly inside the wide tube (.8 + .015 r), 5 to 140 m; of all scenes",
            ".922",
            at_least=0.94,
        ),
        Figure("tpr_mid_140", "share", "the same, mid tube"),
        *(
            Figure(f"lat_m_{distance:.0f}", "m", f"{SCENES}: median distance of the true course {distance:.0f} m ahead "
                   "from the posterior mean", at_most=most)
            for distance, most in zip(TOLD, (0.2, 0.25, 0.8), strict=True)
        ),
        *(
            Figure(f"cover90_{distance:.0f}", "share", f"{SCENES}: true course inside the central 90 % of the draws "
                   f"{distance:.0f} m ahead", at_least=0.87, at_most=0.93)
            for distance in TOLD
        ),
    ),
    fixed,
)  # fmt: skip


def against_reference(effort: Effort) -> Values:
    scenes = frozen(effort.scenes)[: effort.some]
    own = best_checks(effort)[: effort.some]
    trials = drive(reference(), scenes, "reference posterior", effort.some, effort.show)
    checks = [trial.check for trial in trials]
    gap, detail = paired_loss((c.inside("wide") for c in checks), (c.inside("wide") for c in own))
    last = own[0].at(TOLD[-1])
    ratio = np.array([a.spread[last] / b.spread[last] for a, b in zip(own, checks, strict=True)])
    poor = sum(trial.posterior.info["pareto_k"] > 0.7 for trial in trials)
    return {
        "reference_tpr_wide_140": share(shares(c.inside("wide") for c in checks)),
        "reference_gap_wide_140": Value(gap, detail),
        "reference_cover90_140": share(shares(c.covered[last] for c in checks)),
        "reference_lat_m_140": Value(float(median(abs(c.error[last]) for c in checks)), f"n = {len(checks)}"),
        "sd_ratio_140": Value(float(np.exp(np.log(ratio).mean())), f"n = {len(ratio)}"),
        "reference_poor": Value(poor / len(trials), f"n = {len(trials)}"),
    }


REFERENCE = Measurement(
    (
        Figure(
            "reference_tpr_wide_140",
            "share",
            "as tpr_wide_140, on the first frozen scenes, by the reference posterior: importance sampling from the "
            "prior, 24 rounds of 512 draws",
        ),
        Figure(
            "reference_gap_wide_140",
            "share",
            "reference_tpr_wide_140 less tpr_wide_140 on the same scenes",
            at_most=0.02,
        ),
        Figure("reference_cover90_140", "share", "cover90_140 of the reference posterior"),
        Figure("reference_lat_m_140", "m", "lat_m_140 of the reference posterior"),
        Figure("sd_ratio_140", "", "standard deviation 140 m ahead over that of the reference, geometric mean"),
        Figure("reference_poor", "share", "reference runs whose weights have a Pareto shape above .7"),
    ),
    against_reference,
)

MEASUREMENTS = (CALIBRATED, FIXED, REFERENCE)
