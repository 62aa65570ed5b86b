"""A check of a calibration in words and as JSON."""

from typing import Any

from fpcal_bayes.analysis.traces import CheckNumbers
from fpcal_bayes.fringes.path_check import PathCheck


def check_sentences(check: PathCheck, tolerance: float | None) -> list[str]:
    """What a check says, one sentence per line; `tolerance` of the peak to peak in um."""
    found = CheckNumbers.of(check, tolerance)
    size = f"{found.peak_to_peak:.1f} +- {found.peak_to_peak_sd:.1f} nm"
    lines = [
        f"Measured: the cavity length goes {size} peak to peak beside what the estimate expects along the path.",
        f"Predicted by the estimate: {found.low:.1f} to {found.high:.1f} nm (95 %); with the noise of this recording "
        f"up to {found.noisy:.1f} nm.",
    ]
    chance = f"probability of so much if the calibration holds: {_shown_probability(check, found)}"
    if check.verdict == "confirmed":
        lines.append(f"The calibration is confirmed on the cell ({chance}).")
    elif check.verdict == "refuted":
        lines.append(f"The calibration is refuted on the cell ({chance}): it does not hold any more, or never did.")
    else:
        lines.append(f"Not evaluated: {_reason(check)}.")
    if found.within is not None and check.verdict != "not evaluated":
        within = found.within
        verdict = "within" if within > 0.975 else "beyond" if within < 0.025 else "neither clearly within nor beyond"
        chance = f"probability of within: {within:.3f}"
        lines.append(f"The path is {verdict} {found.tolerance:g} nm peak to peak ({chance}).")
    return lines


def check_warnings(check: PathCheck) -> list[str]:
    """Sentences about what weakens a check."""
    found, warnings = CheckNumbers.of(check), []
    if found.height is not None:
        warnings.append(
            f"the path starts at {found.height:.0f} % of the way to a fringe's extreme, where 20 nm change the signal "
            "by 0.7 % of a fringe's height only; start at half height (quadrature), where they change it by 8 %"
        )
    if found.rival is not None:
        warnings.append(
            "the signal passes an extreme of the fringe, where it does not tell whether the cavity length went on or "
            f"turned: {found.rival:.1f} nm peak to peak fit as well"
        )
    return warnings


def check_content(check: PathCheck, tolerance: float | None) -> dict[str, Any]:
    """A check as JSON: lengths in nm, `tolerance` in um."""
    measured, found = check.measured, CheckNumbers.of(check, tolerance)
    content = {
        "verdict": check.verdict,
        "probability": check.probability,
        "level": check.level,
        "peak_to_peak_nm": found.peak_to_peak,
        "peak_to_peak_sd_nm": found.peak_to_peak_sd,
        "predicted_nm": {"median": found.median, "low": found.low, "high": found.high},
        "expected_high_nm": found.noisy,
        "share": 0.95,
        "start_sine": measured.start_sine,
        "followed": measured.followed,
        "alternative_nm": found.rival,
        "along": found.along.tolist(),
        "error_nm": found.error.tolist(),
        "error_sd_nm": found.error_sd.tolist(),
    }
    if tolerance is not None:
        content["tolerance_nm"] = found.tolerance
        content["within_tolerance_probability"] = found.within
    return content


def _shown_probability(check: PathCheck, found: CheckNumbers) -> str:
    """The probability, or that it is below what the draws can tell."""
    least = found.least_probability
    return f"below {2 * least:.1g}" if check.probability < 1.5 * least else f"{check.probability:.2g}"


def _reason(check: PathCheck) -> str:
    if not check.measured.followed:
        return (
            f"no smooth change of the cavity length makes this signal (it is off by {check.measured.residual:.3g} V, "
            f"the noise is {check.measured.noise:.3g} V)"
        )
    if check.measured.rival is not None:
        return "two changes of the cavity length make this signal, and one of them would confirm the calibration"
    return "the recording is too uncertain to confirm so small an error: its gain or offset drifted, or it is noisy"
